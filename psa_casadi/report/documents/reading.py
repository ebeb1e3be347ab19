"""A diagnosis read back from the JSON file that `psa diagnose` or `to_json` wrote."""

import os
import types
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from psa_casadi.errors import InputError
from psa_casadi.report.documents.files import DiagnosisFile, OwnModelFile
from psa_casadi.strict_json import parse_json, read_json_text, shown

Record = TypeVar("Record")
_SIMPLE: dict[Any, tuple[type, ...]] = {
    str: (str,),
    float: (int, float),
    int: (int,),
    bool: (bool,),
    type(None): (type(None),),
}


def read_document(kind: type[Record], content: Any, source: str) -> Record:
    """Return the record of a file's content; what this version does not know is left out.

    Raises:
        InputError: something is missing or of another type; the sentence says where.
    """
    try:
        return cast("Record", _read(kind, content, ""))
    except ValueError as error:
        raise InputError(
            f"{source}: {error}; give a file that this version of psa_casadi wrote, or write it"
            " again."
        ) from error


def _read(kind: Any, content: Any, place: str) -> Any:
    if kind in _SIMPLE:
        if not isinstance(content, _SIMPLE[kind]) or (
            isinstance(content, bool) and kind in (int, float)
        ):
            raise _unlike(content, place)
        return float(cast("float", content)) if kind is float else content
    if is_dataclass(kind) and isinstance(kind, type):
        return _record(kind, content, place)
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        if content not in inner:
            raise _unlike(content, place)
        return content
    if origin in (Union, types.UnionType):
        return _first(inner, content, place)
    if origin is tuple:
        return _several(inner, content, place)
    if not isinstance(content, dict):
        raise _unlike(content, place)
    return {name: _read(inner[1], value, f"{place}.{name}") for name, value in content.items()}


def _record(kind: type, content: Any, place: str) -> Any:
    if not isinstance(content, dict):
        raise _unlike(content, place)
    kinds, found = get_type_hints(kind), {}
    for f in fields(kind):
        if f.name in content:
            found[f.name] = _read(kinds[f.name], content[f.name], f"{place}.{f.name}")
        elif f.default is MISSING and f.default_factory is MISSING:
            raise ValueError(f"'{f'{place}.{f.name}'.lstrip('.')}' is missing")
    return kind(**found)


def _first(kinds: tuple[Any, ...], content: Any, place: str) -> Any:
    for kind in kinds:
        try:
            return _read(kind, content, place)
        except ValueError as error:
            told = error
    raise told if len(kinds) == 2 and content is not None else _unlike(content, place)


def _several(inner: tuple[Any, ...], content: Any, place: str) -> tuple[Any, ...]:
    if not isinstance(content, list):
        raise _unlike(content, place)
    open_end = inner[-1] is Ellipsis
    if not open_end and len(content) != len(inner):
        raise _unlike(content, place)
    kinds = [inner[0]] * len(content) if open_end else list(inner)
    pairs = zip(kinds, content, strict=True)
    return tuple(_read(k, v, f"{place}[{i}]") for i, (k, v) in enumerate(pairs))


def _unlike(content: Any, place: str) -> ValueError:
    where = f"'{place.lstrip('.')}'" if place else "the file"
    return ValueError(f"{where} is {shown(content)}, which does not belong there")


_ADVICE = "give a file that `psa diagnose --json` or `Diagnosis.to_json` wrote"
_KINDS: dict[str, type[DiagnosisFile | OwnModelFile]] = {
    "psa_casadi.diagnosis/1": DiagnosisFile,
    "psa_casadi.own_model_diagnosis/1": OwnModelFile,
}


def load_diagnosis(path: str | os.PathLike[str]) -> DiagnosisFile | OwnModelFile:
    """Return what DIAGNOSIS.json holds: verdict, causes, errors by the names of a `Diagnosis`.

    The file has no samples and no model (`load_model` reads that); to keep a whole result, pickle
    it. A diagnosis of an own model gives what `OdeDiagnosis` names so.

    Raises InputError for a file that cannot be read, is none of a diagnosis, or lacks something.
    """
    source = os.fspath(path)
    try:
        content = parse_json(read_json_text(source), source, f"{_ADVICE}.")
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{source}: cannot be read ({error}); {_ADVICE}.") from error
    found = content.get("format") if isinstance(content, dict) else None
    if found not in _KINDS:
        raise InputError(f"{source}: its format is {shown(found)}, no diagnosis; {_ADVICE}.")
    return read_document(_KINDS[found], content, source)
