"""A population of devices: common values, their spread, outliers, batches and drift.

Parameters that differ between two or more findings by more than their noise.

Cochran's Q: with weights w_i = 1/s_i^2 and the weighted mean m,

    Q = sum_i w_i (theta_i - m)^2  ~  chi^2(k - 1)

where all k devices have one value; for two it is the square of the z test. (W. G. Cochran,
Biometrics 10 (1954) 101.) p values are adjusted over the parameters (Holm).

What is known of one device: its parameters with intervals, verdict, causes and errors.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from functools import cache
from typing import Literal

import numpy as np
import scipy

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.model.components import COMPONENTS
from psa_casadi.model.compose import Model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.variables import NORMAL_95
from psa_casadi.population.statistics import (
    FEWEST,
    LIMIT,
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
from psa_casadi.simulation.simulate import input_samples, output_of
from psa_casadi.simulation.stepper import run


@dataclass(frozen=True)
class Estimate:
    """A parameter of one device in its SI unit: value and 95 % interval.

    `determined` is False if the records do not determine the parameter or it sits on a bound.
    """

    value: float
    unit: str
    interval: tuple[float, float] | None
    determined: bool = True
    meaning: str = ""


@dataclass(frozen=True)
class NamedCause:
    """A cause with its confidence, the share of the error that it explains, and its rivals."""

    effect: str
    confidence: float
    share: float
    or_else: tuple[str, ...] = ()


@dataclass(frozen=True)
class BudgetShare:
    """A share of the base model's held-out error above the noise, with its 95 % interval."""

    what: str
    share: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class HeldOutErrors:
    """Held-out rms of an output in its unit: base and extended model, and the noise.

    Of a stack's displacement the extended model's in % of the range, too.
    """

    base: float
    extended: float
    noise: float
    extended_percent: float | None = None
    output: str = "displacement"
    unit: str = "m"


@dataclass(frozen=True)
class Trace:
    """The first part of a record and its model: (n,) in SI units, nan where not measured."""

    record: str
    time: tuple[float, ...]
    voltage: tuple[float, ...]
    measured: tuple[float, ...]
    model: tuple[float, ...]


@dataclass(frozen=True)
class Finding:
    """The result for one device.

    `kind` is that of the result. `rms_m` and `rms_percent` are the rms residual of an
    identification, [m] and in % of the range; `warnings` are its doubts in words, and `noise_ratio`
    is the residual over the noise, None where the fit reaches the noise. `records` are the names
    and SHA-256 of the files. What a file does not hold is empty or None.
    """

    device: str
    kind: Literal["identification", "diagnosis", "model"]
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    records: tuple[tuple[str, str], ...] = ()
    batch: str = ""
    day: date | None = None
    verdict: str = ""
    doubt: str = ""
    causes: tuple[NamedCause, ...] = ()
    errors: tuple[HeldOutErrors, ...] = ()
    budget: tuple[BudgetShare, ...] = ()
    rms_m: float | None = None
    rms_percent: float | None = None
    force_scale: str = ""
    trace: Trace | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    noise_ratio: float | None = None


def replayed(model: Model) -> Trace | None:
    """Return the first part of the record and the model with the sensor's offset, else None.

    Raises SimulationError.
    """
    part = model.evidence.reference if model.evidence else None
    if model.evidence is None or part is None or "voltage" not in part.inputs:
        return None
    known = model.evidence.run_of(part.record)
    start, offset = (known.start, known.offset_m) if known is not None else ({}, 0.0)
    time = np.array(part.time)
    inputs = {n: np.array(v) for n, v in part.inputs.items() if n in model.input_names}
    u = input_samples(model, time.size, inputs)
    x0 = np.array([start.get(s.name, s.start) for s in model.structure.states])
    sensor = model.output_names.index(output_of(model) or "displacement")  # with its errors
    y = run(model, time, u, x0, rtol=1e-6).y[:, sensor]
    measured = tuple(math.nan if v is None else v for v in part.displacement)
    modelled = tuple((y + offset).tolist())
    return Trace(part.record, part.time, part.inputs["voltage"], measured, modelled)


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates (n,) and standard errors (n,) of a parameter, `places` of the devices that have it.

    On a logarithmic scale theta is ln(value/unit); else both are in the SI unit.
    """

    name: str
    unit: str
    meaning: str
    log: bool
    places: tuple[int, ...]
    theta: FloatArray
    errors: FloatArray

    def value(self, theta: float) -> float:
        """Return a theta as a value in the SI unit."""
        return math.exp(theta) if self.log else theta


def estimates(findings: Sequence[Finding], name: str) -> Estimates:
    """Return the estimates of a parameter; devices that do not determine it are left out.

    A 95 % interval [low, high] has the standard error ln(high/low)/3.92 on a logarithmic scale,
    else (high - low)/3.92, as the intervals of a fit are made.
    """
    every = [(k, f.parameters[name]) for k, f in enumerate(findings) if name in f.parameters]
    rows = [(k, p.value, *p.interval) for k, p in every if _is_determined(p) and p.interval]
    log = name in _declared()[0] and all(min(value, low) > 0.0 for _, value, low, _ in rows)
    theta = [math.log(value) if log else value for _, value, *_ in rows]
    widths = [math.log(high / low) if log else high - low for *_, low, high in rows]
    first = every[0][1] if every else Estimate(0.0, "", None)
    places, errors = tuple(k for k, *_ in rows), np.array(widths) / (2.0 * NORMAL_95)
    return Estimates(name, first.unit, first.meaning, log, places, np.array(theta), errors)


def names_of(findings: Sequence[Finding]) -> tuple[str, ...]:
    """Return the parameters that a device determines, in the order of the first files."""
    names = (n for f in findings for n, p in f.parameters.items() if _is_determined(p))
    return tuple(dict.fromkeys(names))


def _is_determined(p: Estimate) -> bool:
    return p.determined and p.interval is not None and p.interval[1] > p.interval[0]


@cache
def _declared() -> tuple[frozenset[str], dict[str, str]]:
    """Return the parameters that are fitted on a logarithmic scale, and units of display."""
    every = [p for c in (*COMPONENTS.values(), *EFFECTS.values()) for p in c.parameters]
    return (
        frozenset(p.name for p in every if p.log),
        {p.name: p.display_unit for p in every if p.display_unit},
    )


def display_unit(name: str, unit: str) -> str:
    """Return the unit in which a parameter is displayed."""
    return _declared()[1].get(name, unit)


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
    """How often a verdict or a cause occurs: count, of how many, and Wilson's 95 % interval."""

    what: str
    count: int
    of: int
    interval: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Population:
    """What a population shows.

    `outliers`, `batch_p` and `drift_p` are adjusted over all parameters (and devices); the latter
    two are by parameter. `left_out` are the parameters that too few devices determine.
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


def population(findings: Sequence[Finding]) -> Population:
    """Return what a population of devices shows.

    Every parameter is tested by itself (`outliers`, `batch_test`, `drift`); p values are adjusted
    over all tests of one kind.

    Raises:
        InputError: no parameter is determined by more than three devices.
    """
    every = [estimates(findings, name) for name in names_of(findings)]
    spreads = [_spread(findings, e) for e in every if len(e.places) > FEWEST]
    if not spreads:
        raise InputError(
            f"No parameter is determined by more than {FEWEST} of the {len(findings)} devices, so"
            " there is no population; give more devices, or compare these side by side."
        )
    diagnosed = [f for f in findings if f.verdict]  # rivals are one cause
    causes = [" or ".join((c.effect, *c.or_else)) for f in diagnosed for c in f.causes]
    batch_p = {s.estimates.name: s.batches.p_value for s in spreads if s.batches}
    drift_p = {s.estimates.name: s.drift.p_value for s in spreads if s.drift}
    return Population(
        findings=tuple(findings),
        spreads=tuple(spreads),
        outliers=_outliers(findings, spreads),
        batch_p=_over_parameters(batch_p),
        drift_p=_over_parameters(drift_p),
        verdicts=frequencies([f.verdict for f in diagnosed]),
        causes=frequencies(causes, len(diagnosed)) if causes else (),
        left_out=tuple(e.name for e in every if len(e.places) <= FEWEST),
    )


def _spread(findings: Sequence[Finding], result: Estimates) -> Spread:
    far = outliers(result.theta, result.errors)
    kept = ~far.outlying
    theta, errors = result.theta[kept], result.errors[kept]
    those = [findings[k] for k, keep in zip(result.places, kept, strict=True) if keep]
    batches = [f.batch for f in those]
    days = [f.day.toordinal() / YEAR for f in those if f.day is not None]
    several = all(batches) and 1 < len(set(batches)) < len(batches) - 1
    dated = len(days) == len(those) and len(days) > FEWEST and np.ptp(days) > 0.0
    return Spread(
        result,
        mixed_regression(theta, errors),
        far,
        batch_test(theta, errors, batches) if several else None,
        drift(theta, errors, days) if dated else None,
    )


def _outliers(findings: Sequence[Finding], spreads: Sequence[Spread]) -> tuple[Outlier, ...]:
    """Return the outliers of all parameters, their p values adjusted over all tests together."""
    tests = [
        (findings[k].device, s.estimates.name, float(z), float(p))
        for s in spreads
        for k, z, p in zip(s.estimates.places, s.far.z, s.far.p, strict=True)
    ]
    corrected = adjusted([p for *_, p in tests])
    result = [
        Outlier(device, name, z, float(c))
        for (device, name, z, _), c in zip(tests, corrected, strict=True)
        if c < LIMIT
    ]
    return tuple(sorted(result, key=lambda o: -abs(o.z)))


def _over_parameters(p_values: dict[str, float]) -> dict[str, float]:
    return dict(zip(p_values, adjusted(list(p_values.values())).tolist(), strict=True))


def frequencies(words: Sequence[str], of: int | None = None) -> tuple[Frequency, ...]:
    """Count words, the most frequent first; intervals of the share are Wilson's."""
    total, result = len(words) if of is None else of, []
    for word, count in Counter(words).most_common():
        share = scipy.stats.binomtest(count, total).proportion_ci(method="wilson")
        result.append(Frequency(word, count, total, (float(share.low), float(share.high))))
    return tuple(result)


@dataclass(frozen=True, eq=False)
class Difference:
    """A parameter that two findings or more determine; p values of "all have one value"."""

    estimates: Estimates
    p_value: float
    p_adjusted: float

    @property
    def differs(self) -> bool:
        """Whether the values differ beyond noise."""
        return self.p_adjusted < LIMIT


def differences(findings: Sequence[Finding]) -> tuple[Difference, ...]:
    """Return the parameters that two findings or more determine, in the order of the files."""
    shared = [e for n in names_of(findings) if len((e := estimates(findings, n)).places) > 1]
    p_values = [mixed_regression(e.theta, e.errors).p_value for e in shared]
    corrected = adjusted(p_values, "bonferroni")
    return tuple(
        Difference(e, p, float(c)) for e, p, c in zip(shared, p_values, corrected, strict=True)
    )
