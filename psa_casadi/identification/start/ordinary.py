"""Where a fit starts: a stack of the records' size, its capacitance, the form of its loop.

The capacitance from a measured current or charge, without the mechanics.

    C_p u' = i,   i = (G v - u) / R_s,   G = 1

With the voltage v linear between samples h apart the current has an exact step,

    i_(k+1) = a i_k + (1 - a) C_p (v_(k+1) - v_k) / h,   a = exp(-h / T),

linear in C_p, in the sensor's zero and in the current before the record. The time T is sought along
one line and then left alone: a loss of the ceramic's polarisation looks like a lag of the drive,
R_s C_p, so that only their sum shows. Displacements show the product R_s C_p; the capacitance is
the current's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from psa_casadi.common.errors import InputError
from psa_casadi.common.notes import note, texts
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.unknowns import static_compliance, within_bounds
from psa_casadi.identification.start.doubts import (
    doubtful_unit,
    refuse_unusable,
    static_slope,
    stray,
)
from psa_casadi.model.components import BASE
from psa_casadi.model.components.stack import bouc_wen, memory_spectrum
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.variables import Interval
from psa_casadi.records.drive import turns
from psa_casadi.records.noise import filtered, high_frequency_noise
from psa_casadi.records.record import Record

#: Forms of the hysteresis by name; `best` is the one that the records prefer.
Hysteresis = Literal["bouc-wen", "spectrum", "best"]

FORMS = {"bouc-wen": bouc_wen, "spectrum": memory_spectrum}


def forms_of(model: Model, hysteresis: Hysteresis | None) -> tuple[Model, ...]:
    """Return the model in each form that is to be fitted; as it is if `hysteresis` is None.

    Raises InputError for a model whose hysteresis has neither form.
    """
    if hysteresis is None:
        return (model,)
    known = {c.name for c in FORMS.values()}
    if not any(c.name in known for c in model.components):
        raise InputError(
            f"The model '{model.name}' has no hysteresis that could take another form; leave"
            " --hysteresis out."
        )
    models = []
    for name in FORMS if hysteresis == "best" else (hysteresis,):
        components = [FORMS[name] if c.name in known else c for c in model.components]
        names = {c.name for c in components}
        models.append(model.with_components(c for c in components if set(c.needs) <= names))
    return tuple(models)


#: Times T that are tried, over the sampling interval, and how often the grid closes in.
_TIMES, _ROUNDS = np.geomspace(0.1, 200.0, 25), 3
#: Capacitances of stacks [F], with a wide margin: what lies outside is of another unit or thing.
_ORDINARY = (1e-10, 1e-2)
#: Least share of the current's variance that the drive must explain for its figures to count.
_EXPLAINED = 0.9
#: Standard errors of half a 95 % interval; steps that differ by more are uneven; a model's
#: capacitance is the current's if it differs by less.
_NORMAL, _UNEVEN, _SAME = 1.96, 1e-2, 0.02


@dataclass(frozen=True)
class Capacitance:
    """Capacitance [F] by a measured current, or charge, with its standard error.

    `explained` is the share of the `source`'s variance.
    """

    value: float
    error: float
    explained: float
    source: str = "current"

    @property
    def interval(self) -> Interval:
        """The 95 % interval [F]."""
        half = _NORMAL * self.error
        return Interval(self.value - half, self.value + half)

    def is_that_of(self, value: float) -> bool:
        """Whether a model has this capacitance."""
        return abs(value - self.value) < _SAME * self.value

    def sentence(self, value: float) -> str:
        """The capacitance in words; `value` [F] is that of the model."""
        result = note(
            "capacitance", source=self.source, value=1e6 * self.value, low=1e6 * self.interval.low,
            high=1e6 * self.interval.high, share=100 * self.explained,
        )  # fmt: skip
        kept = () if self.is_that_of(value) else (note("capacitance_kept", value=1e6 * value),)
        return " ".join(texts((result, *kept)))


def capacitance_of(records: Sequence[Record]) -> Capacitance | None:
    """Return the capacitance from measured currents, else charges; None if neither follows one.

    A current that is limited, leaks, has its sign turned, or belongs to another voltage is
    explained badly. Records with uneven time steps are left out.
    """
    even = [
        r
        for r in records
        if r.current is not None
        and r.n > 3
        and np.ptp(np.diff(r.time)) < _UNEVEN * np.mean(np.diff(r.time))
    ]
    currents = [np.asarray(r.current, dtype=np.float64) for r in even]
    total = sum(float(np.sum((i - np.mean(i)) ** 2)) for i in currents)
    c = _by_current(even, total) if total else _by_charge(records)
    followed = c and c.explained >= _EXPLAINED and _ORDINARY[0] < c.value < _ORDINARY[1]
    return c if followed else None


def _by_current(records: Sequence[Record], total: float) -> Capacitance:
    """Return the capacitance at the best time T; `total` is the sum of squares of the currents."""
    times = min(r.sample_time for r in records) * _TIMES
    for _ in range(_ROUNDS):
        k = int(np.argmin([_solved(records, float(q))[1] for q in times]))
        best = float(times[k])
        times = np.geomspace(times[max(k - 1, 0)], times[min(k + 1, len(times) - 1)], len(_TIMES))
    value, rest, error = _solved(records, best)
    return Capacitance(value, error, 1.0 - rest / total)


def _by_charge(records: Sequence[Record]) -> Capacitance | None:
    """Return the charge per volt, every record about its mean; None without a charge."""
    columns = [(r.voltage, np.asarray(r.charge)) for r in records if r.charge is not None]
    pairs = [(v - np.mean(v), q - np.mean(q)) for v, q in columns]
    power = sum(float(v @ v) for v, _ in pairs)
    total = sum(float(q @ q) for _, q in pairs)
    if power == 0.0 or total == 0.0:
        return None
    value = sum(float(v @ q) for v, q in pairs) / power
    rest = sum(float(np.sum((q - value * v) ** 2)) for v, q in pairs)
    # what is left is a loop, not noise: its width does not average out
    return Capacitance(value, float(np.sqrt(rest / power)), 1.0 - rest / total, "charge")


def _solved(records: Sequence[Record], time: float) -> tuple[float, float, float]:
    """Return C_p at a time T [s], the sum of squares left, and C_p's standard error.

    For a residual that is an autoregression of first order.
    """
    every = []  # the current per farad, and of every record the sensor's zero and the start
    for k, record in enumerate(records):
        keep = float(np.exp(-record.sample_time / time))
        rate = np.append(0.0, np.diff(record.voltage) / np.diff(record.time))
        block = np.zeros((record.n, 1 + 2 * len(records)))
        block[:, 0] = filtered([1.0 - keep], [1.0, -keep], rate)
        block[:, 1 + 2 * k] = 1.0
        block[:, 2 + 2 * k] = np.exp(-(record.time - record.time[0]) / time)
        every.append(block)
    columns = np.vstack(every)
    scale = np.linalg.norm(columns, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    columns /= scale
    current = np.concatenate([np.asarray(r.current, dtype=np.float64) for r in records])
    weights, *_ = np.linalg.lstsq(columns, current, rcond=None)
    rest = current - columns @ weights
    power = float(rest @ rest)
    similar = min(max(float(rest[1:] @ rest[:-1]) / max(power, 1e-300), 0.0), 0.999)
    inflation = (1.0 + similar) / (1.0 - similar)
    spread = np.linalg.pinv(columns.T @ columns, hermitian=True)[0, 0]
    freedom = max(len(rest) - columns.shape[1], 1)
    error = float(np.sqrt(spread * power / freedom * inflation)) / scale[0]
    return float(weights[0] / scale[0]), power, error


#: Stiffness assumed without a data sheet's [N/m]: displacement then is right, forces are not.
ASSUMED_STIFFNESS = 5e7
#: Stiffness of the wafers over that of the bonding layers, assumed.
_WAFER_RATIO = 5.0
#: Capacitance assumed [F] where no current was measured: only R_s C_p shows in a displacement.
_CAPACITANCE = 1.6e-6
#: Typical ratio of the peak hysteresis force to the linear force.
_HYSTERESIS_SHARE = 0.1

#: Shapes of loop to start from: A, beta, gamma over k_L, and n. The second saturates early, far
#: within the range; from the others a fit of such a loop ends with a steep A and no bend.
LOOP_SHAPES: tuple[Mapping[str, float], ...] = (
    {"A": -0.3, "beta": 0.3, "gamma": 0.1, "n": 1.3},
    {"A": -0.35, "beta": 0.6, "gamma": 0.02, "n": 1.4},
    {"A": -0.15, "beta": 0.05, "gamma": 0.05, "n": 1.1},
    {"A": -0.3, "beta": 0.1, "gamma": 0.1, "n": 1.05},
)


def starting_model(records: Sequence[Record], stiffness: float | None = None) -> Model:
    """Return the base model scaled to the records' voltage span, stroke and sampling.

    In the one-way cascade a load meets the bonding layers only, so the stiffness [N/m] that a data
    sheet measures is k_B; it is `ASSUMED_STIFFNESS` if that is None, since voltage and
    displacement do not determine forces. k_P = 5 k_B is assumed; k_L (1/k_P + 1/k_B) is the
    regression slope of displacement on voltage (paper, eq. 14). C_p is that of the measured current
    (`capacitance_of`), else assumed. Raises InputError where that is
    far from what any stack does, or where no voltage or no displacement changes.
    """
    refuse_unusable(records)
    doubt = doubtful_unit(records)
    k_b = stiffness or ASSUMED_STIFFNESS
    k_p = _WAFER_RATIO * k_b
    span = max(float(np.ptp(r.voltage)) for r in records)
    top = max(float(np.max(np.abs(r.voltage))) for r in records)
    sample_time = min(r.sample_time for r in records)
    k_l = max(abs(static_slope(records)), 1e-12) / (1.0 / k_p + 1.0 / k_b)
    capacitance = capacitance_of(records)
    values = {
        "u_rated": max(span, top),
        "k_L": k_l,
        "h_ref": _HYSTERESIS_SHARE * k_l * span,
        "hold_rate": 1e-3 * span,
        "C_p": _CAPACITANCE if capacitance is None else capacitance.value,
        "k_P": k_p,
        "k_B": k_b,
        **{name: share * k_l for name, share in LOOP_SHAPES[0].items() if name != "n"},
        "n": LOOP_SHAPES[0]["n"],
    }
    try:
        return compose(BASE, {**values, **within_base(_lags(values, sample_time))})
    except InputError as error:
        raise InputError(stray(records) or [doubt]) if doubt else error from None


def within_base(values: Mapping[str, float]) -> dict[str, float]:
    """Return values of some parameters of the base model, clipped to their bounds."""
    bounds = {p.name: p.bounds for c in BASE for p in c.parameters}
    return {name: float(np.clip(value, *bounds[name])) for name, value in values.items()}


def chosen_start(
    records: Sequence[Record], model: Model | None, stiffness: float | None
) -> tuple[Model, bool]:
    """Return where a fit starts, and whether its force scale is known.

    A `model` is taken as it is, but for declared start values, which belong to its parameters; a
    `stiffness` [N/m] with it changes its force scale: all forces, stiffnesses, dampings and
    masses are multiplied by one factor, which displacements do not show.
    """
    if model is None:
        return starting_model(records, stiffness), stiffness is not None
    model = model.with_declared_starts()
    if stiffness is None:
        return model, model.provenance.force_scale == "given"
    before = next(model.values[name] for name in ("k_B", "k") if name in model.values)
    forces = [p for p in model.structure.parameters if p.unit == "kg" or p.unit[:1] == "N"]
    scaled = {p.name: model.values[p.name] * stiffness / before for p in forces}
    return model.with_values(scaled), True


def stuck_values(model: Model) -> tuple[str, ...]:
    """Return the fitted parameters that are on a bound, without gains and lags that vanish.

    A base fit that lacks an effect may leave the physical range to imitate it, as a damping of
    1e9 N.s/m imitates creep; from there the effect does not show.
    """
    stuck = []
    for name in model.provenance.free:
        parameter, value = model.parameter(name), model.values[name]
        low, high = parameter.bounds
        vanishes = parameter.log or low == 0.0
        if value >= high - 1e-9 * abs(high) or (not vanishes and value <= low + 1e-9 * abs(low)):
            stuck.append(name)
    return tuple(stuck)


def loop_starts(model: Model) -> list[dict[str, float]]:
    """Return starting values for the hysteresis, scaled to the model's k_L."""
    k_l = model.values["k_L"]
    return [
        {name: value if name == "n" else value * k_l for name, value in shape.items()}
        for shape in LOOP_SHAPES
    ]


#: A and beta over k_L, and n, of ordinary loops: one that saturates late, and one soon.
_LATE, _SOON = (-0.15, 0.1, 1.2), (-0.3, 0.5, 1.2)


def ordinary_values(
    model: Model, records: Sequence[Record], *, soon: bool = False
) -> dict[str, float]:
    """Return an ordinary loop, some 12 % wide, and lags below the sampling, to the records' size.

    A search that starts from a loop that saturates late may end near one that does so `soon`.
    k_L comes from the regression of displacement on voltage: that of a fitted model may be far off
    it, since a steep loop trades k_L for A.
    """
    k_l = max(abs(static_slope(records)), 1e-12) / static_compliance(model.values)
    a, beta, n = _SOON if soon else _LATE
    loop = {"A": a * k_l, "beta": beta * k_l, "gamma": 0.0, "delta": 0.0, "n": n}
    shape = loop if has_loop(model) else {}
    return {"k_L": k_l, **shape, **_lags(model.values, min(r.sample_time for r in records))}


def has_loop(model: Model) -> bool:
    """Whether the model's hysteresis is Bouc-Wen's, whose shapes of loop are known."""
    return "A" in model.values


def _lags(values: Mapping[str, float], sample_time: float) -> dict[str, float]:
    """Return lags somewhat below the sampling interval; much faster ones are not determined."""
    lags = {
        "tau": float(np.clip(0.7 * sample_time, 1e-6, 0.5)),
        "R_s": 0.3 * sample_time / values["C_p"],
    }
    lags |= {f"c_{m}": 0.05 * sample_time * values[f"k_{m}"] for m in "PB" if f"k_{m}" in values}
    return lags


#: Loops that take part, samples of each, and how much faster than the slowest they may be.
_LOOPS, _SAMPLES, _FASTER = 4, 2000, 5.0
#: Ranges of n, and of k over the slope of displacement on voltage.
_N, _K = (1.0, 3.0), (0.5, 3.5)
#: k over the slope, and n, from which the search starts.
_STARTS = ((1.1, 1.2), (1.6, 1.2), (2.5, 1.05))
#: How many standard deviations h_0 may be off: the noise at rest, an ordinary hysteresis elsewhere.
_DOUBT = 4.0
#: Least noise over the range: what formulas without lags miss.
_LOOP_FLOOR = 1e-3
#: A sample's voltage counts as held where it moves less than this share of the mean step.
_HELD = 1e-2


@dataclass(frozen=True, eq=False)
class _Loop:
    """Displacement x [m], voltage u [V], both (n,) from the first sample, and what is fixed."""

    x: FloatArray
    u: FloatArray
    steps: FloatArray
    skew: FloatArray
    rests: bool


def loop_start(model: Model, records: Sequence[Record]) -> dict[str, float] | None:
    """Return k_L, A, beta, gamma [N/V], delta [N/(V.s)] and n of the slowest loops, or None.

    Forces follow from the model's stiffnesses by eq. (14), beta and gamma belong to its h_ref.
    None where no record's voltage turns, or nothing moves. Only the start of a search depends on
    these values, so they may come from all samples, held-out ones too.
    """
    loops = [_loop(r) for r in _slowest(records)]
    slope = abs(static_slope(records))
    level = max((float(np.ptp(loop.x)) for loop in loops), default=0.0)
    if level == 0.0 or slope == 0.0:
        return None
    compliance = static_compliance(model.values)
    size = compliance * model.values["h_ref"]
    noise = max(_LOOP_FLOOR * level, *(high_frequency_noise(loop.x) for loop in loops))
    doubt = np.array([noise if loop.rests else size for loop in loops])

    def parts(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _eliminated(loops, theta[0] * slope, theta[1], theta[2:] * doubt, size)

    def weighted(theta: FloatArray) -> FloatArray:
        return np.concatenate([parts(theta)[1] / noise, theta[2:]])

    low = np.array([_K[0], _N[0], *[-_DOUBT] * len(loops)])
    high = np.array([_K[1], _N[1], *[_DOUBT] * len(loops)])
    none = [0.0] * len(loops)
    fits = [
        scipy.optimize.least_squares(weighted, [*start, *none], bounds=(low, high), max_nfev=30)
        for start in _STARTS
    ]
    best = min(fits, key=lambda f: float(f.cost)).x
    s, beta, gamma, delta = parts(best)[0]
    k = best[0] * slope
    values = {"k_L": k, "A": s - k, "beta": beta, "gamma": gamma, "delta": delta}
    forces = {n: float(v) / compliance for n, v in values.items()} | {"n": float(best[1])}
    return within_bounds(model, forces)


def _eliminated(
    loops: Sequence[_Loop], k: float, n: float, starts: FloatArray, size: float
) -> tuple[FloatArray, FloatArray]:
    """Return s, beta, gamma, delta [m/V, m/(V.s)] and the residual [m] of all loops, stacked."""
    blocks, targets = [], []
    for loop, start in zip(loops, starts, strict=True):
        ratio = (start + loop.x - k * loop.u) / size
        middle = 0.5 * (ratio[1:] + ratio[:-1])
        bend = np.abs(middle) ** n
        turning = np.sign(middle) * bend * np.abs(loop.steps)
        columns = [loop.u, -_integral(turning), -_integral(bend * loop.steps), _integral(loop.skew)]
        blocks.append(np.column_stack([c - np.mean(c) for c in columns]))
        targets.append(loop.x - np.mean(loop.x))
    matrix, target = np.vstack(blocks), np.concatenate(targets)
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0.0] = 1.0
    weights = np.linalg.lstsq(matrix / scale, target, rcond=1e-6)[0] / scale
    return weights, target - matrix @ weights


def _integral(steps: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(steps)])


def _slowest(records: Sequence[Record]) -> list[Record]:
    """Return the records whose voltage turns, the slowest and those that are not much faster."""
    turning = [r for r in records if r.mask.sum() > 20 and turns(r.voltage)]
    turning.sort(key=_rate)
    return [r for r in turning if _rate(r) <= _FASTER * _rate(turning[0])][:_LOOPS]


def _rate(record: Record) -> float:
    """Mean speed of the voltage [1/s], over its range."""
    travelled = float(np.sum(np.abs(np.diff(record.voltage))))
    return travelled / float(np.ptp(record.voltage)) / record.duration


def _loop(record: Record) -> _Loop:
    """Return a record, averaged in blocks if it has many samples; `rests` if it starts at 0 V."""
    valid = record.mask
    y = np.interp(record.time, record.time[valid], record.measured[valid])
    every = -(-record.n // _SAMPLES)
    blocks = record.n // every
    t, u, x = (
        np.mean(values[: blocks * every].reshape(blocks, every), axis=1)
        for values in (record.time, record.voltage, y)
    )
    steps = np.diff(u)
    moving = np.abs(steps) > _HELD * float(np.mean(np.abs(steps)))
    skew = 0.5 * (u[1:] + u[:-1]) * np.sign(steps) * moving * np.diff(t)
    rests = abs(float(u[0])) < 1e-2 * float(np.ptp(u))
    return _Loop(x - x[0], u - u[0], steps, skew, rests)
