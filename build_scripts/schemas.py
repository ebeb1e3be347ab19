"""Write the JSON schemas that the package ships: python -m build_scripts.schemas."""

from inspect import cleandoc
from pathlib import Path
from typing import Any

import msgspec

from psa_casadi.common.strict_json import json_text
from psa_casadi.documents.files import (
    CheckFile,
    DeviceFile,
    DiagnosisFile,
    IdentificationFile,
    OwnModelFile,
    PosteriorFile,
)
from psa_casadi.model.model_file import ModelFile

FOLDER = Path(__file__).resolve().parents[1] / "psa_casadi" / "data" / "schemas"

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
    """Return the shipped schemas by file name."""
    return {f"{name}.schema.json": json_text(json_schema(file)) for name, file in FILES.items()}


def json_schema(record: type) -> dict[str, Any]:
    """Return the schema (draft 2020-12) of a dataclass; fields with a default may be missing."""
    _, defined = msgspec.json.schema_components([record], ref_template="#/$defs/{name}")
    for schema in defined.values():
        schema["description"] = cleandoc(schema["description"])
        if "properties" in schema:
            schema["additionalProperties"] = False
        for name, rules in schema.get("properties", {}).items():
            if rules.get("type") == "object" and name not in schema.get("required", ()):
                rules.setdefault("default", {})  # msgspec states it from 0.23 on
    root = defined.pop(record.__name__)
    table = {"$schema": "https://json-schema.org/draft/2020-12/schema", **root}
    return {**table, "$defs": dict(sorted(defined.items()))} if defined else table


def main() -> None:
    """Write every schema whose text has changed."""
    for name, text in schema_texts().items():
        (FOLDER / name).write_text(text, encoding="utf-8", newline="\n")
        print(FOLDER / name)


if __name__ == "__main__":
    main()
