"""JSON that says one thing only: no name twice, no number or text that cannot be written again."""

import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from psa_casadi.characters import barred
from psa_casadi.errors import InputError

#: The most bytes of a file, and the deepest that lists and objects may lie in each other.
MOST_BYTES = 2**24
DEEPEST = 64
#: A text, whose brackets do not count, or a bracket.
_BRACKETS = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"?|[\[{]|[\]}]', re.DOTALL)
#: A list of numbers only, over several lines; no text of JSON has a line end.
_NUMBERS = re.compile(r"\[\n((?:\s*(?:-?\d[\d.eE+-]*|null),?\n)+)\s*\]")


def read_json_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a file that is meant to hold JSON.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no UTF-8 text, or has more than `MOST_BYTES`.
    """
    with Path(path).open("rb") as stream:
        data = stream.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise ValueError(f"it has more than {MOST_BYTES / 2**20:g} MiB")
    return data.decode("utf-8-sig")


def parse_json(text: str, source: str, advice: str) -> Any:
    """Return the content of a JSON text; `advice` ends the sentence that refuses it.

    Raises:
        InputError: the text is no JSON or nests deeper than `DEEPEST`; it has a name twice in one
            object, a number that is no finite double, or a character that no document can carry.
    """
    try:
        _check_depth(text)
        content = json.loads(
            text,
            object_pairs_hook=_object,
            parse_constant=_constant,
            parse_float=_number,
            parse_int=_integer,
        )
        check_texts(content)
    except ValueError as error:
        raise InputError(f"{source} is not JSON that can be used ({error}); {advice}") from error
    return content


def json_text(content: Any) -> str:
    """Return the text of a JSON file that `parse_json` reads back as the same content.

    A list of numbers stands on one line.

    Raises:
        ValueError: a number is not finite, or a text has a character that no document can carry.
    """
    check_texts(content)
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return _NUMBERS.sub(lambda found: f"[{' '.join(found[1].split())}]", text)


def check_texts(content: Any) -> None:
    """Raise ValueError for a text with a character that no document can carry."""
    for text in _texts(content):
        if found := barred(text):
            raise ValueError(f"the text {shown(text)} has the character {found}")


def shown(value: object) -> str:
    """Return a value as a sentence quotes it, cut off where it is long."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


def _check_depth(text: str) -> None:
    depth = 0
    for found in _BRACKETS.finditer(text):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(found[0], 0)
        if depth > DEEPEST:
            line = text.count("\n", 0, found.start()) + 1
            raise ValueError(f"line {line}: lists and objects lie more than {DEEPEST} deep")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f"the name {shown(twice)} stands twice in one object")
    return found


def _constant(word: str) -> Any:
    raise ValueError(f"{word} is no number of JSON")


def _number(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"the number {shown(digits)} is too large")
    return value


def _integer(digits: str) -> int:
    _number(digits)  # what a double cannot hold is refused
    return int(digits)


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
