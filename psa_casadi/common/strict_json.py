"""JSON files: read strictly, checked against the records that declare them, written back the same.

A file's form is a frozen dataclass; msgspec converts the content to it and makes its schema. JSON
that is read is unambiguous: no name twice, no number or text that cannot be written again.
"""

import json
import math
import os
import re
import types
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from psa_casadi.common.characters import barred
from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.files import why_not_read

Record = TypeVar("Record")

#: The most bytes of a file.
MOST_BYTES = 2**24
#: A list of numbers only, over several lines; no text of JSON has a line end.
_NUMBERS = re.compile(r"\[\n((?:\s*(?:-?\d[\d.eE+-]*|null),?\n)+)\s*\]")
_WANTED = {
    float: "a number",
    int: "a whole number",
    str: "a text",
    bool: "true or false",
    type(None): "null",
}
#: The value of what a content lacks, of no type that JSON has.
_LACKING = object()


def read_json(path: str | os.PathLike[str], advice: str, source: str = "") -> Any:
    """Return the content of a JSON file, which messages call `source`, by default its path.

    Raises:
        InputError: it cannot be read, is no UTF-8 text, has more than `MOST_BYTES`, or is not what
            `parse_json` takes.
    """
    source = source or os.fspath(path)
    try:
        with Path(path).open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES / 2**20:g} MiB")  # noqa: TRY301
        text = data.decode("utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(f"{source}: cannot be read ({why_not_read(error)}); {advice}") from error
    return parse_json(text, source, advice)


def parse_json(text: str, source: str, advice: str) -> Any:
    """Return the content of a JSON text; `advice` ends the sentence that refuses it.

    Raises:
        InputError: the text is no JSON or nests too deeply; it has a name twice in one object, a
            number that is no finite double, or a character that no document can carry.
    """
    try:
        content = json.loads(
            text, object_pairs_hook=_object, parse_constant=_constant, parse_float=_number
        )
        check_texts(content)
    except (ValueError, RecursionError) as error:
        why = "its lists nest too deep" if isinstance(error, RecursionError) else error
        raise InputError(f"{source} is not JSON that can be used ({why}); {advice}") from error
    return content


def decode(kind: type[Record], content: Any, source: str) -> Record:
    """Return a file's content as the record that declares it; unknown names are left out.

    Raises:
        InputError: every part that is missing or of another type, at most 20 of them.
    """
    problems = Problems()
    problems.extend(f"{source}: {sentence}" for sentence in mistakes(kind, content))
    problems.raise_if_any()
    return msgspec.convert(content, kind)


def part(kind: Any, content: Any) -> Any:
    """Return what a part of a content is, None where it is nothing of the kind."""
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError:
        return None


def mistakes(kind: Any, content: Any, place: str = "") -> Iterator[str]:
    """Yield a sentence for each part of a content that its declared type does not allow."""
    try:
        msgspec.convert(content, kind)
    except msgspec.ValidationError:
        inside = [m for p, k, value in _parts(kind, content, place) for m in mistakes(k, value, p)]
        name = f"'{place}'" if place else "the file"
        result = "missing" if content is _LACKING else brief(content)
        yield from inside or [f"{name} is {result}; give {_wanted(kind)}."]


def _parts(kind: Any, content: Any, place: str) -> Iterable[tuple[str, Any, Any]]:
    """Return place, type and value of each part of what may be a record, a mapping or a list."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return next((p for k in inner if (p := list(_parts(k, content, place)))), ())
    if isinstance(content, dict):
        before = f"{place}." if place else ""
        if is_dataclass(kind) and isinstance(kind, type):
            kinds = get_type_hints(kind)
            needed = [f for f in fields(kind) if f.name in content or _has_no_default(f)]
            return [(before + f.name, kinds[f.name], content.get(f.name, _LACKING)) for f in needed]
        if isinstance(origin, type) and issubclass(origin, Mapping):
            return [(before + name[:80], inner[1], value) for name, value in content.items()]
    if isinstance(content, list) and origin is tuple:
        kinds_in = [inner[0]] * len(content) if inner[-1] is ... else inner
        if len(kinds_in) == len(content):
            pairs = enumerate(zip(kinds_in, content, strict=True))
            return [(f"{place}[{i}]", k, value) for i, (k, value) in pairs]
    return ()


def _has_no_default(field: Any) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _default(field: Any) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def _wanted(kind: Any) -> str:
    """Return what a message asks for where a type is declared."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(_wanted(k) for k in inner)
    if origin is Literal:
        return f"one of {', '.join(repr(v) for v in inner)}" if inner[1:] else repr(inner[0])
    if origin is tuple:
        return "a list" if inner[-1] is ... else f"a list of {len(inner)} values"
    if isinstance(kind, type) and issubclass(kind, tuple):
        return f"[{', '.join(get_type_hints(kind))}]"
    return _WANTED.get(kind, "names with values")


def plain(value: Any) -> Any:
    """Return what a file has of a record: the names with values that are not the defaults."""
    if is_dataclass(value):
        items = [(f, getattr(value, f.name)) for f in fields(value)]
        return {f.name: plain(v) for f, v in items if _has_no_default(f) or v != _default(f)}
    if isinstance(value, Mapping):
        return {name: plain(v) for name, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, tuple) else value


def json_text(content: Any) -> str:
    """Return the text of a JSON file that `parse_json` reads back as the same content.

    A list of numbers takes one line.

    Raises:
        ValueError: a number is not finite, or a text has a character that no document can carry.
    """
    check_texts(content)
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return _NUMBERS.sub(lambda result: f"[{' '.join(result[1].split())}]", text)


def check_texts(content: Any) -> None:
    """Raise ValueError for a text with a character that no document can carry."""
    for text in _texts(content):
        if result := barred(text):
            raise ValueError(f"the text {brief(text)} has the character {result}")


def brief(value: object) -> str:
    """Return a value as a sentence quotes it, cut off where it is long."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"the name {brief(twice)} occurs twice in one object")
    return table


def _constant(word: str) -> Any:
    raise ValueError(f"{word} is no number of JSON")


def _number(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"the number {brief(digits)} is too large")
    return value


def _texts(content: Any) -> Iterator[str]:
    if isinstance(content, str):
        yield content
    elif isinstance(content, dict):
        for name, value in content.items():
            yield name
            yield from _texts(value)
    elif isinstance(content, list):
        for value in content:
            yield from _texts(value)
