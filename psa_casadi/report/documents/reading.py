"""A diagnosis read back from the JSON file that `psa diagnose` or `to_json` wrote."""

import os

from psa_casadi.errors import InputError
from psa_casadi.report.documents.files import DiagnosisFile, OwnModelFile
from psa_casadi.strict_json import decode, read_json, shown

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
    content = read_json(source, f"{_ADVICE}.")
    found = content.get("format") if isinstance(content, dict) else None
    if found not in _KINDS:
        raise InputError(f"{source}: its format is {shown(found)}, no diagnosis; {_ADVICE}.")
    return decode(_KINDS[found], content, source)
