"""What the document of an own model's diagnosis holds (`OdeDiagnosis.to_dict` makes it)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from psa_casadi.any_model.result import OdeBudget, OutputError, PortCause
from psa_casadi.diagnosis.result import Candidate, Verdict
from psa_casadi.report.documents.diagnosis_file import RecordUsed, Remaining, Told


@dataclass(frozen=True)
class FreeCorrection:
    """A free function of some variables at a port that would remove most of what is left."""

    port: str
    of: str
    evidence: float
    share: float
    unit: str
    variable: str


@dataclass(frozen=True, repr=False)
class OwnModelFile(Told):
    """A diagnosis of a model of one's own: verdict, causes, errors of every output, what remains.

    `values` are the parameters of the extended model in the model's units. Files of older versions
    have no `budget`.
    """

    format: Literal["psa_casadi.own_model_diagnosis/1"]
    verdict: Verdict
    causes: tuple[PortCause, ...]
    candidates: tuple[Candidate, ...]
    errors: tuple[OutputError, ...]
    missed: Remaining
    remaining: Remaining
    unnamed: str
    correction: FreeCorrection | None
    notes: tuple[str, ...]
    values: Mapping[str, float]
    records: tuple[RecordUsed, ...]
    budget: OdeBudget | None = None
