"""The schemas that the package ships (`psa_casadi/data/schemas`), made of the files' records."""

import types
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from psa_casadi.report.documents.files import (
    CheckFile,
    DeviceFile,
    DiagnosisFile,
    IdentificationFile,
    ModelFile,
    OwnModelFile,
    PosteriorFile,
)
from psa_casadi.strict_json import json_text
from psa_casadi.variables import Interval

DRAFT = "https://json-schema.org/draft/2020-12/schema"
_SIMPLE = {str: "string", float: "number", int: "integer", bool: "boolean", type(None): "null"}


def json_schema(record: type) -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a dataclass; fields with a default may be missing."""
    defined: dict[str, Any] = {}
    root = _record(record, defined)
    found = {"$schema": DRAFT, "title": record.__name__, **root}
    return {**found, "$defs": dict(sorted(defined.items()))} if defined else found


def _record(record: type, defined: dict[str, Any]) -> dict[str, Any]:
    kinds = get_type_hints(record)
    own: tuple[Field[Any], ...] = fields(record)
    return {
        "description": (record.__doc__ or "").split("\n")[0],
        "type": "object",
        "properties": {f.name: _schema(kinds[f.name], defined) for f in own},
        "required": [f.name for f in own if f.default is MISSING and f.default_factory is MISSING],
        "additionalProperties": False,
    }


def _schema(kind: Any, defined: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of one type; records go to `defined`."""
    if kind in _SIMPLE:
        return {"type": _SIMPLE[kind]}
    if kind is Interval:
        return _container(tuple[float, float], defined)
    if is_dataclass(kind) and isinstance(kind, type):
        if kind.__name__ not in defined:
            defined[kind.__name__] = {}
            defined[kind.__name__] = _record(kind, defined)
        return {"$ref": f"#/$defs/{kind.__name__}"}
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return {"const": inner[0]} if len(inner) == 1 else {"enum": list(inner)}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_schema(i, defined) for i in inner]}
    return _container(kind, defined)


def _container(kind: Any, defined: dict[str, Any]) -> dict[str, Any]:
    origin, inner = get_origin(kind), get_args(kind)
    if origin is tuple and inner[-1] is Ellipsis:
        return {"type": "array", "items": _schema(inner[0], defined)}
    if origin is tuple:
        items = [_schema(i, defined) for i in inner]
        count = len(items)
        return {"type": "array", "prefixItems": items, "minItems": count, "maxItems": count}
    if origin is not None and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": _schema(inner[1], defined)}
    raise TypeError(f"{kind} has no form in JSON")


#: The record of each file that is written as JSON, by the name of its schema.
FILES: dict[str, type] = {
    "model": ModelFile,
    "diagnosis": DiagnosisFile,
    "own_model": OwnModelFile,
    "identification": IdentificationFile,
    "posterior": PosteriorFile,
    "check": CheckFile,
    "device": DeviceFile,
}


def schema_texts() -> dict[str, str]:
    """Return the schemas as they are shipped, by the names of their files."""
    return {f"{name}.schema.json": json_text(json_schema(file)) for name, file in FILES.items()}
