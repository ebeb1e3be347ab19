"""What DIAGNOSIS.json holds (`Diagnosis.to_dict` makes it)."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from psa_casadi.diagnosis.held_out import Budget, Errors, Gain
from psa_casadi.diagnosis.result import Candidate, Cause, Verdict, unnamed_causes
from psa_casadi.shown import Lined


class Told(Lined):
    """A diagnosis as its file tells it: shows itself, and is written again as it was read."""

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file; what this version does not know is left out."""
        found: dict[str, Any] = json.loads(json.dumps(asdict(self)))  # type: ignore[call-overload]
        return found

    def to_json(self) -> str:
        """Return the text of the file."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


@dataclass(frozen=True)
class BothErrors:
    """The noise floor [m], and the errors of the base and the extended model."""

    noise_floor_rms_m: float
    base: Errors
    extended: Errors


@dataclass(frozen=True)
class UnnamedCorrection:
    """An unnamed correction that helps: its kind and place, evidence, and what else it may be."""

    kind: str
    port: str
    sentence: str
    evidence: float
    open_to: tuple[str, ...]


@dataclass(frozen=True)
class OtherModel:
    """The extended model with another effect instead of a cause; how much the two differ."""

    cause: str
    instead: str
    rms_ratio: float
    plant_differs_m: float
    plant_differs_percent: float


@dataclass(frozen=True)
class Decision:
    """What a further column decided: what is named with it and without it, and in words.

    An `output` is fitted, with `noise` and held-out errors `base_rms` and `extended_rms` in its SI
    `unit`; an `input` drives the model, and has none. `named` and `named_without` hold the named
    sets with their probabilities, `ruled_out` what is only in the latter; `evidence` is what the
    column adds to ln of the Bayes factor of the extended model over the base.
    """

    column: str
    role: Literal["output", "input"]
    unit: str
    noise: float | None
    base_rms: float | None
    extended_rms: float | None
    named: Mapping[str, float]
    named_without: Mapping[str, float]
    ruled_out: tuple[str, ...]
    evidence: float
    sentence: str


@dataclass(frozen=True)
class BlindSpot:
    """An effect of practical size that the records could not have shown."""

    effect: str
    smallest_detectable_gain: float
    unit: str
    why: str


@dataclass(frozen=True)
class Remaining:
    """What is left: whether it is noise, and where it is not."""

    white: bool
    p_value: float
    where: str


@dataclass(frozen=True)
class NextExperiment:
    """The experiment that would distinguish the rivals.

    `voltage_csv` is the file with the voltage to play, where one was written; `chance` is for each
    rival the probability that it is then named if it is the cause.
    """

    voltage_csv: str | None
    separates: tuple[str, ...]
    why: str
    chance: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordNoise:
    """The noise of one record: its rms [m], where that is known from, and a sentence."""

    record: str
    rms: float
    source: str
    sentence: str


@dataclass(frozen=True)
class RecordMisfit:
    """What a model gets wrong in one record: rms, excess over the noise [m], shares of views."""

    record: str
    rms: float
    excess: float
    views: Mapping[str, float]
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class RecordUsed:
    """A record that was diagnosed, with the SHA-256 of its file."""

    name: str
    sha256: str


@dataclass(frozen=True, repr=False)
class DiagnosisFile(Told):
    """A diagnosis: verdict, causes, errors before and after, and what remains.

    It answers by the names of a `Diagnosis` what needs no samples and no model.
    """

    format: Literal["psa_casadi.diagnosis/1"]
    verdict: Verdict
    doubt: str
    causes: tuple[Cause, ...]
    candidates: tuple[Candidate, ...]
    errors: BothErrors
    gain: Gain
    budget: Budget | None
    patch: UnnamedCorrection | None
    alternatives: tuple[OtherModel, ...]
    columns: tuple[Decision, ...]
    blind_to: tuple[BlindSpot, ...]
    remaining: Remaining
    next_experiment: NextExperiment
    notes: tuple[str, ...]
    noise: tuple[RecordNoise, ...]
    misfit: tuple[RecordMisfit, ...]
    remainder: tuple[RecordMisfit, ...]
    records: tuple[RecordUsed, ...]

    @property
    def noise_floor_rms_m(self) -> float:
        """The noise floor [m]."""
        return self.errors.noise_floor_rms_m

    @property
    def base_errors(self) -> Errors:
        """The errors of the base model."""
        return self.errors.base

    @property
    def extended_errors(self) -> Errors:
        """The errors of the extended model."""
        return self.errors.extended

    @property
    def kept(self) -> tuple[str, ...]:
        """Effects that the extended model holds and that are not named as causes."""
        return unnamed_causes(self.budget, self.causes)
