"""What `psa sample --json` writes: the posterior of every parameter, and how it was drawn."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from psa_casadi.posterior.sample import Figures, Posterior
from psa_casadi.version import __version__

FORMAT: Literal["psa_casadi.posterior/1"] = "psa_casadi.posterior/1"


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
    """A record: SHA-256 of its file, samples used, how many count as one, residual rms [m]."""

    name: str
    sha256: str
    samples: int
    samples_as_one: float
    rms_m: float


@dataclass(frozen=True)
class PosteriorFile:
    """The posterior of a model's parameters given records, and how it was drawn."""

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


def posterior_file(found: Posterior) -> dict[str, Any]:
    """Return what `--json` writes of a posterior."""
    task = found.task
    records = tuple(
        SampledRecord(e.record.name, e.record.sha256, int(e.used.sum()), float(worth), float(rms))
        for e, worth, rms in zip(task.experiments, task.inflation, task.levels, strict=True)
    )
    content = PosteriorFile(
        FORMAT,
        __version__,
        found.model.name,
        {f.name: _parameter(found, f) for f in found.figures},
        found.chains,
        found.draws,
        found.seed,
        found.divergences,
        records,
        found.warnings,
        found.sentences,
    )
    return asdict(content)


def _parameter(found: Posterior, f: Figures) -> SampledParameter:
    return SampledParameter(
        unit=f.unit,
        mean=f.mean,
        sd=f.sd,
        interval=(f.low, f.high),
        mc_error=_finite(f.mc_error),
        ess=_finite(f.ess),
        r_hat=_finite(f.r_hat),
        prior_share=_finite(f.prior_share),
        meaning=found.model.parameter(f.name).description,
    )


def _finite(figure: float) -> float | None:
    return figure if math.isfinite(figure) else None
