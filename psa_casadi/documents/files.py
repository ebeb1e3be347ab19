"""What the JSON files hold: models, diagnoses, identifications, posteriors, checks, devices."""

import hashlib
import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from psa_casadi.common.display import Lined
from psa_casadi.common.errors import InputError
from psa_casadi.common.notes import Note
from psa_casadi.common.strict_json import brief, decode, read_json
from psa_casadi.diagnosis.corrections import Estimate, Family
from psa_casadi.diagnosis.held_out import Budget, Errors, Gain, StackBudget
from psa_casadi.diagnosis.result import (
    ANY_MODEL,
    FORMAT,
    Candidate,
    Cause,
    OutputError,
    Verdict,
    unnamed_causes,
)
from psa_casadi.export.check.check import CheckReport
from psa_casadi.identification.grades import Degree, grade
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.profile import Profile
from psa_casadi.identification.result import Identification
from psa_casadi.posterior.sample import Posterior
from psa_casadi.records.noise_kinds import NoiseFound
from psa_casadi.version import __version__

Part = TypeVar("Part")


def copied(kind: type[Part], source: Any, /, **others: Any) -> Part:
    """Return a part of a file: the fields of `source` that have its names, and all `others`."""
    names = [f.name for f in fields(kind) if f.name not in others]  # type: ignore[arg-type]
    return kind(**{n: getattr(source, n) for n in names if hasattr(source, n)}, **others)


CHECK_FORMAT: Literal["psa_casadi.check/1"] = "psa_casadi.check/1"


@dataclass(frozen=True)
class CheckedRow:
    """One check: the computed figure (null: the check broke down), the largest allowed, a remark.

    Of a foreign FMU also the clause of the standard, and whether the remark is to be noted.
    """

    name: str
    found: float | None
    allowed: float
    passed: bool
    remark: str
    clause: str = ""
    noted: bool = False


@dataclass(frozen=True)
class CheckFile:
    """The checks of an FMU; `compared` is true if there was a model to compare with.

    `left_out` names the checks that this kind of FMU has nothing for.
    """

    format: Literal["psa_casadi.check/1"]
    package_version: str
    fmu: str
    passed: bool
    compared: bool
    rows: tuple[CheckedRow, ...]
    left_out: tuple[str, ...] = ()


def check_file(report: CheckReport) -> dict[str, Any]:
    """Return what `--json` writes of the checks of an FMU."""
    rows = tuple(
        copied(CheckedRow, r, found=_finite(r.figure), allowed=r.limit) for r in report.rows
    )
    head = {"format": CHECK_FORMAT, "package_version": __version__, "fmu": str(report.path)}
    return asdict(copied(CheckFile, report, rows=rows, **head))


DEVICE_FORMAT: Literal["psa_casadi.device/1"] = "psa_casadi.device/1"
Work = Literal["identify", "diagnose"]
Status = Literal["done", "refused", "failed"]


@dataclass(frozen=True)
class RecordUsed:
    """A record that was used, with the SHA-256 of its file."""

    name: str
    sha256: str


@dataclass(frozen=True)
class DeviceFile:
    """A device of a batch run: how its work ended, and the hash of files and options it is for.

    `refused` means that the records cannot be used, `failed` that something else went wrong; it is
    tried again by the next run. `sha256` are those of `files`, as they were written.
    """

    format: Literal["psa_casadi.device/1"]
    device: str
    batch: str
    date: str
    work: Work
    status: Status
    problems: tuple[str, ...]
    seconds: float
    key: str
    package_version: str
    records: tuple[RecordUsed, ...]
    files: tuple[str, ...]
    sha256: tuple[str, ...] = ()


def damage(folder: Path, device_file: DeviceFile) -> str:
    """Return what is wrong with the files in a device's folder; "" where they are as written."""
    for name, sha256 in zip(device_file.files, device_file.sha256, strict=False):
        path = folder / name
        try:
            digest = hash_of(path.read_bytes())
        except OSError as error:
            return f"{path}: cannot be read ({error.strerror}); run `psa batch` again."
        if digest != sha256:
            return f"{path}: is damaged, as it is not what was written; run `psa batch` again."
    return ""


def hash_of(content: bytes) -> str:
    """Return the SHA-256 by which the content of a file is known again."""
    return hashlib.sha256(content).hexdigest()


class ResultFile(Lined):
    """A result as its file has it: shows itself, and is written again as it was read."""

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file; what this version does not know is left out."""
        content: dict[str, Any] = json.loads(json.dumps(asdict(self)))  # type: ignore[call-overload]
        return content

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
    """An effect of practical size that the records could not have revealed."""

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
class FreeCorrection:
    """A free function of some variables at a port that would remove most of what is left.

    Its `equation`, with `parameters`, where few terms say it.
    """

    port: str
    of: str
    evidence: float
    share: float
    unit: str
    variable: str
    equation: str = ""
    parameters: Mapping[str, Estimate] = field(default_factory=dict)


@dataclass(frozen=True, repr=False, kw_only=True)
class AnyDiagnosisFile(ResultFile):
    """A diagnosis: verdict, causes, what the base misses and what remains.

    It answers by the names of a result what needs no samples and no model. `values` are the
    parameters of the extended model. Files of older versions lack what has a default.
    """

    format: str
    verdict: Verdict
    doubt: str = ""
    causes: tuple[Cause, ...]
    candidates: tuple[Candidate, ...]
    budget: Budget | None = None
    missed: Remaining | None = None
    remaining: Remaining
    unnamed: str = ""
    families: tuple[Family, ...] = ()
    notes: tuple[str, ...]
    noise_kinds: tuple[NoiseFound, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    records: tuple[RecordUsed, ...]

    @property
    def kept(self) -> tuple[str, ...]:
        """Effects that the extended model holds and that are not named as causes."""
        return unnamed_causes(self.budget, self.causes)


@dataclass(frozen=True, repr=False, kw_only=True)
class OwnModelFile(AnyDiagnosisFile):
    """A diagnosis of a user's model: with the errors of every output."""

    format: Literal["psa_casadi.own_model_diagnosis/1"]
    errors: tuple[OutputError, ...]
    correction: FreeCorrection | None


@dataclass(frozen=True, repr=False, kw_only=True)
class DiagnosisFile(AnyDiagnosisFile):
    """A diagnosis of a stack: errors before and after, blind spots, what to record next."""

    format: Literal["psa_casadi.diagnosis/1"]
    budget: StackBudget | None = None
    errors: BothErrors
    gain: Gain
    patch: UnnamedCorrection | None
    alternatives: tuple[OtherModel, ...]
    columns: tuple[Decision, ...]
    blind_to: tuple[BlindSpot, ...]
    next_experiment: NextExperiment
    noise: tuple[RecordNoise, ...]
    misfit: tuple[RecordMisfit, ...]
    remainder: tuple[RecordMisfit, ...]

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


IDENTIFICATION_FORMAT: Literal["psa_casadi.identification/1"] = "psa_casadi.identification/1"


@dataclass(frozen=True)
class FoundParameter:
    """A parameter: value and 95 % interval in its unit, and how well the records determine it."""

    value: float
    unit: str
    interval: tuple[float, float] | None
    determined: Degree
    meaning: str


@dataclass(frozen=True)
class FittedRecord:
    """A record: SHA-256 of its file, samples used, residual rms and noise level, and range.

    Those of its `output`, in the `unit`: m for a displacement, whatever the names of the fields.
    """

    name: str
    sha256: str
    samples: int
    rms_m: float
    noise_m: float
    rms_percent_of_range: float
    output: str = "displacement"
    unit: str = "m"


@dataclass(frozen=True)
class AdvisedRecord:
    """A record to measure next: how often, and the parameters that it would determine."""

    sentence: str
    parameters: tuple[str, ...]
    repeats: int


@dataclass(frozen=True)
class ProfileInterval:
    """The 95 % interval of a profile likelihood; an end is null where the cost never rises so."""

    unit: str
    estimate: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class IdentificationFile:
    """An identified model: parameters, records, residual, and the records to measure next."""

    format: Literal["psa_casadi.identification/1"]
    package_version: str
    model: str
    parameters: Mapping[str, FoundParameter]
    rms_m: float
    converged: bool
    interrupted: bool
    records: tuple[FittedRecord, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    advice: tuple[AdvisedRecord, ...]
    profiles: Mapping[str, ProfileInterval]
    #: By how many times its noise the model misses a record or an output, None where it does not.
    missed: float | None = None
    noise_kinds: tuple[NoiseFound, ...] = ()


#: The codes of the doubts that state this misfit, and the name of the figure in each.
_MISSED = {"missed": "times", "output_missed": "ratio"}


def identification_file(
    identification: Identification, profiles: Iterable[Profile] = ()
) -> dict[str, Any]:
    """Return what `--json` writes of an identification, of any model."""
    model, fit, parameters = identification.model, identification.fit, {}
    for p in model.structure.parameters:
        i, degree = model.provenance.intervals.get(p.name), grade(identification, p.name).degree
        interval = None if i is None else (i.low, i.high)
        fields = model.values[p.name], p.unit, interval, degree, p.description
        parameters[p.name] = FoundParameter(*fields)
    stack = identification if isinstance(identification, StackIdentification) else None
    records = []
    for output in fit.channels:
        j, channel = output.number, output.channel
        if channel.factors:
            continue
        for k, part in zip(output.records, output.parts, strict=True):
            e = identification.experiments[k]
            rms = float(np.sqrt(np.mean(part**2))) * e.share(j)
            sigma = fit.sigma[k] if stack else identification.noise[channel.column] * e.share(j)
            share = 100.0 * rms / float(np.ptp(e.measured(j)[e.at(j, e.record.mask)]))
            row = e.record.name, e.record.sha256, len(part), rms, float(sigma), share
            records.append(FittedRecord(*row, channel.column, channel.unit))
    doubts = [d for d in identification.doubts if isinstance(d, Note) and d.code in _MISSED]
    misses = [float(d.values[_MISSED[d.code]]) for d in doubts]
    content = copied(
        IdentificationFile, identification, format=IDENTIFICATION_FORMAT,
        package_version=__version__, model=model.name, parameters=parameters, rms_m=fit.rms,
        converged=fit.converged, records=tuple(records), notes=identification.sentences,
        advice=tuple(copied(AdvisedRecord, a) for a in (stack.advice if stack else ())),
        profiles={p.name: copied(ProfileInterval, p) for p in profiles},
        missed=max(misses, default=None),
    )  # fmt: skip
    return asdict(content)


POSTERIOR_FORMAT: Literal["psa_casadi.posterior/1"] = "psa_casadi.posterior/1"


@dataclass(frozen=True)
class SampledParameter:
    """A parameter's posterior in its unit; null where a figure cannot be had.

    `interval` holds 94 % of it at the highest density, `mc_error` is the standard error of the mean
    by the chains' length, `ess` counts effective draws, `r_hat` is above 1.01 where chains
    disagree, `prior_share` is the standard deviation over the prior's.
    """

    unit: str
    mean: float
    sd: float
    interval: tuple[float, float]
    mc_error: float | None
    ess: float | None
    r_hat: float | None
    prior_share: float | None
    meaning: str


@dataclass(frozen=True)
class SampledRecord:
    """A record: SHA-256 of its file, samples used, how many count as one, residual rms.

    That of its `output`, in the `unit`: m for a displacement, whatever the name of the field.
    """

    name: str
    sha256: str
    samples: int
    samples_as_one: float
    rms_m: float
    output: str = "displacement"
    unit: str = "m"


@dataclass(frozen=True)
class PosteriorFile:
    """The posterior of a model's parameters for its records, and how it was drawn."""

    format: Literal["psa_casadi.posterior/1"]
    package_version: str
    model: str
    parameters: Mapping[str, SampledParameter]
    chains: int
    draws: int
    seed: int
    divergences: int
    records: tuple[SampledRecord, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]


def posterior_file(posterior: Posterior) -> dict[str, Any]:
    """Return what `--json` writes of a posterior."""
    task = posterior.task
    records = []
    for b in task.density.blocks:
        e, channel = task.experiments[b.record], task.channel(b)
        samples = int(e.at(b.channel).sum())
        row = e.record.name, e.record.sha256, samples, b.correlation_time, b.level
        records.append(SampledRecord(*row, channel.column, channel.unit))
    known = ("mc_error", "ess", "r_hat", "prior_share")
    parameters = {
        f.name: copied(
            SampledParameter, f, interval=(f.low, f.high),
            meaning=posterior.model.parameter(f.name).description,
            **{name: _finite(getattr(f, name)) for name in known},
        )
        for f in posterior.figures
    }  # fmt: skip
    content = copied(
        PosteriorFile, posterior, format=POSTERIOR_FORMAT, package_version=__version__,
        model=posterior.model.name, parameters=parameters, records=tuple(records),
        notes=posterior.sentences,
    )  # fmt: skip
    return asdict(content)


def _finite(figure: float) -> float | None:
    return figure if math.isfinite(figure) else None


_READ_ADVICE = "give a file that `psa diagnose --json` or `Diagnosis.to_json` wrote"
DIAGNOSES: dict[Any, type[DiagnosisFile | OwnModelFile]] = {
    FORMAT: DiagnosisFile,
    ANY_MODEL: OwnModelFile,
}


def load_diagnosis(path: str | os.PathLike[str]) -> DiagnosisFile | OwnModelFile:
    """Return what DIAGNOSIS.json holds: verdict, causes, errors by the names of a `StackDiagnosis`.

    The file has no samples and no model (`load_model` reads that); to keep a whole result, pickle
    it. A diagnosis of another model answers by the names of `Diagnosis`.

    Raises InputError for a file that cannot be read, is none of a diagnosis, or lacks something.
    """
    source = os.fspath(path)
    content = read_json(source, f"{_READ_ADVICE}.")
    diagnosis, kind = diagnosis_in(content, source)
    if diagnosis is None:
        raise InputError(f"{source}: its format is {brief(kind)}, no diagnosis; {_READ_ADVICE}.")
    return diagnosis


def diagnosis_in(content: Any, source: str) -> tuple[DiagnosisFile | OwnModelFile | None, Any]:
    """Return the diagnosis that a file's content is, None if it is none, and its format."""
    name = content.get("format") if isinstance(content, dict) else None
    kind = DIAGNOSES.get(name) if isinstance(name, str) else None
    return None if kind is None else decode(kind, content, source), name
