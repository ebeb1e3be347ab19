"""A population of devices: what is common, what spreads, who stands out, batches and drift."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from psa_casadi.errors import InputError
from psa_casadi.population.finding import Finding
from psa_casadi.population.parameters import Estimates, estimates, names_of
from psa_casadi.population.statistics import (
    FEWEST,
    LIMIT,
    Adjustment,
    BatchTest,
    Drift,
    MixedFit,
    Outliers,
    adjusted,
    batch_test,
    drift,
    mixed_regression,
    outliers,
)

#: Days in a year, the unit of time of drifts.
YEAR = 365.25


@dataclass(frozen=True, eq=False)
class Outlier:
    """A device that does not belong to the others in a parameter: z and the adjusted p value."""

    device: str
    parameter: str
    z: float
    p_adjusted: float


@dataclass(frozen=True, eq=False)
class Spread:
    """One parameter over the devices: mean and spread of those that belong together.

    `common` is the random-effects mean without outliers; `far` are z and p of every device of
    `estimates`. `batches` and `drift` are None where there is one batch, or one date.
    """

    estimates: Estimates
    common: MixedFit
    far: Outliers
    batches: BatchTest | None
    drift: Drift | None


@dataclass(frozen=True)
class Frequency:
    """How often something was found: count, of how many, and Wilson's 95 % interval."""

    what: str
    count: int
    of: int
    interval: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Population:
    """What a population shows.

    `outliers`, `batch_p` and `drift_p` are adjusted over all parameters (and devices); the latter
    two are by parameter. `left_out` says which parameters too few devices tell.
    """

    findings: tuple[Finding, ...]
    spreads: tuple[Spread, ...]
    outliers: tuple[Outlier, ...]
    batch_p: dict[str, float]
    drift_p: dict[str, float]
    verdicts: tuple[Frequency, ...]
    causes: tuple[Frequency, ...]
    left_out: tuple[str, ...]

    @property
    def batches_differ(self) -> tuple[str, ...]:
        """Parameters in which batches differ beyond noise and spread."""
        return tuple(n for n, p in self.batch_p.items() if p < LIMIT)

    @property
    def drifting(self) -> tuple[str, ...]:
        """Parameters that change with the date beyond noise and spread."""
        return tuple(n for n, p in self.drift_p.items() if p < LIMIT)


def population(findings: Sequence[Finding], how: Adjustment = "benjamini-hochberg") -> Population:
    """Return what a population of devices shows.

    Every parameter is tested by itself (`outliers`, `batch_test`, `drift`); p values are adjusted
    over all tests of one kind.

    Raises:
        InputError: no parameter is told by more than three devices.
    """
    spreads: list[Spread] = []
    few: list[str] = []
    for name in names_of(findings):
        found = estimates(findings, name)
        if len(found.places) <= FEWEST:
            few.append(name)
        else:
            spreads.append(_spread(findings, found, how))
    if not spreads:
        raise InputError(
            f"No parameter is told by more than {FEWEST} of the {len(findings)} devices, so there"
            " is no population to speak of; give more devices, or compare these side by side."
        )
    return Population(
        findings=tuple(findings),
        spreads=tuple(spreads),
        outliers=_told(findings, spreads, how),
        batch_p=_over_parameters(
            {s.estimates.name: s.batches.p_value for s in spreads if s.batches}, how
        ),
        drift_p=_over_parameters(
            {s.estimates.name: s.drift.p_value for s in spreads if s.drift}, how
        ),
        verdicts=frequencies([f.verdict for f in findings if f.verdict]),
        causes=_causes(findings),
        left_out=tuple(few),
    )


def _spread(findings: Sequence[Finding], found: Estimates, how: Adjustment) -> Spread:
    far = outliers(found.theta, found.errors, how)
    kept = ~far.found
    theta, errors = found.theta[kept], found.errors[kept]
    those = [findings[k] for k, keep in zip(found.places, kept, strict=True) if keep]
    batches = [f.batch for f in those]
    tested = None
    if all(batches) and 1 < len(set(batches)) < len(batches) - 1:
        tested = batch_test(theta, errors, batches)
    days = [f.day.toordinal() / YEAR for f in those if f.day is not None]
    moved = None
    if len(days) == len(those) and len(days) > FEWEST and np.ptp(days) > 0.0:
        moved = drift(theta, errors, days)
    return Spread(found, mixed_regression(theta, errors), far, tested, moved)


def _told(
    findings: Sequence[Finding], spreads: Sequence[Spread], how: Adjustment
) -> tuple[Outlier, ...]:
    """Return the outliers of all parameters, their p values adjusted over all tests together."""
    tests = [
        (findings[k].device, s.estimates.name, float(z), float(p))
        for s in spreads
        for k, z, p in zip(s.estimates.places, s.far.z, s.far.p, strict=True)
    ]
    corrected = adjusted([p for *_, p in tests], how)
    found = [
        Outlier(device, name, z, float(c))
        for (device, name, z, _), c in zip(tests, corrected, strict=True)
        if c < LIMIT
    ]
    return tuple(sorted(found, key=lambda o: -abs(o.z)))


def _over_parameters(p_values: dict[str, float], how: Adjustment) -> dict[str, float]:
    corrected = adjusted(list(p_values.values()), how)
    return dict(zip(p_values, corrected.tolist(), strict=True))


def frequencies(words: Sequence[str], of: int | None = None) -> tuple[Frequency, ...]:
    """Count words, the most frequent first; intervals of the share are Wilson's."""
    total = len(words) if of is None else of
    counted = Counter(words).most_common()
    return tuple(Frequency(word, n, total, _wilson(n, total)) for word, n in counted)


def _wilson(count: int, of: int) -> tuple[float, float]:
    found = scipy.stats.binomtest(count, of).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def _causes(findings: Sequence[Finding]) -> tuple[Frequency, ...]:
    """Count the named causes over the diagnosed devices; rivals are one cause, joined by "or"."""
    diagnosed = [f for f in findings if f.verdict]
    words = [" or ".join((c.effect, *c.or_else)) for f in diagnosed for c in f.causes]
    return frequencies(words, len(diagnosed)) if words else ()
