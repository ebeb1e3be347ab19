"""The schemas that the package ships (`psa_casadi/data/schemas`), made of the files' records."""

from inspect import cleandoc
from typing import Any

import msgspec

from psa_casadi.model.model_file import ModelFile
from psa_casadi.report.documents import files
from psa_casadi.strict_json import json_text

#: The record of each file that is written as JSON, by the name of its schema.
FILES: dict[str, type] = {
    "model": ModelFile,
    "diagnosis": files.DiagnosisFile,
    "own_model": files.OwnModelFile,
    "identification": files.IdentificationFile,
    "posterior": files.PosteriorFile,
    "check": files.CheckFile,
    "device": files.DeviceFile,
}


def schema_texts() -> dict[str, str]:
    """Return the schemas as they are shipped, by the names of their files."""
    return {f"{name}.schema.json": json_text(json_schema(file)) for name, file in FILES.items()}


def json_schema(record: type) -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a dataclass; fields with a default may be missing."""
    _, defined = msgspec.json.schema_components([record], ref_template="#/$defs/{name}")
    for schema in defined.values():
        schema["description"] = cleandoc(schema["description"])
        if "properties" in schema:
            schema["additionalProperties"] = False
    root = defined.pop(record.__name__)
    found = {"$schema": "https://json-schema.org/draft/2020-12/schema", **root}
    return {**found, "$defs": dict(sorted(defined.items()))} if defined else found
