"""The schemas that the package ships (`psa_casadi/data/schemas`), made of the files' records."""

from psa_casadi.report.documents.files import (
    CheckFile,
    DeviceFile,
    DiagnosisFile,
    IdentificationFile,
    ModelFile,
    OwnModelFile,
    PosteriorFile,
)
from psa_casadi.report.documents.schema import json_schema
from psa_casadi.strict_json import json_text

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
