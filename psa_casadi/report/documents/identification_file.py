"""What `psa identify --json` writes: the parameters, what determines them, the records, advice."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from psa_casadi.identification.identify import Identification
from psa_casadi.identification.profile import Profile
from psa_casadi.records.record import Record
from psa_casadi.report.words.fit_words import Degree, grade
from psa_casadi.version import __version__

FORMAT: Literal["psa_casadi.identification/1"] = "psa_casadi.identification/1"


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
    """A record: SHA-256 of its file, samples used, residual rms and noise level [m], and range."""

    name: str
    sha256: str
    samples: int
    rms_m: float
    noise_m: float
    rms_percent_of_range: float


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


def identification_file(found: Identification, profiles: Iterable[Profile] = ()) -> dict[str, Any]:
    """Return what `--json` writes of an identification."""
    intervals = found.model.provenance.intervals
    parameters = {
        p.name: FoundParameter(
            found.model.values[p.name],
            p.unit,
            (i.low, i.high) if (i := intervals.get(p.name)) is not None else None,
            grade(found, p.name).degree,
            p.description,
        )
        for p in found.model.structure.parameters
    }
    residuals = found.fit.residuals_of(found.experiments)
    records = [
        _fitted(e.record, int(e.used.sum()), r, sigma)
        for e, r, sigma in zip(found.experiments, residuals, found.fit.sigma, strict=True)
    ]
    content = IdentificationFile(
        FORMAT,
        __version__,
        found.model.name,
        parameters,
        found.fit.rms,
        found.fit.converged,
        found.interrupted,
        tuple(records),
        found.warnings,
        found.sentences,
        tuple(AdvisedRecord(a.sentence, a.parameters, a.repeats) for a in found.advice),
        {p.name: ProfileInterval(p.unit, p.estimate, p.low, p.high) for p in profiles},
    )
    return asdict(content)


def _fitted(record: Record, samples: int, residual: Any, noise: float) -> FittedRecord:
    rms = float(np.sqrt(np.mean(residual**2)))
    share = 100.0 * rms / record.range_m
    return FittedRecord(record.name, record.sha256, samples, rms, float(noise), share)
