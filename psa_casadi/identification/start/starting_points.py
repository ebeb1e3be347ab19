"""Starting points of a search: dynamics that the records show, ordinary loops.

Starting values of the linear part, from the records alone.

1. Excerpts in which a static loop misses something (`excerpts`): steps, broadband, fast loops.
2. Their poles by vector fitting, for one to five poles (`vector_fit`).
3. Poles on drive, lag, wafers and bonding layers in the few ways that make sense; poles that no
   record shows lie below those that it shows.
4. Every such start refined by least squares with the exact response (`fit_linear`), the best ones
   to the end, and k_P/k_B as well where that explains more.

The linear part fitted to excerpts: eqs. (13), (15) behind a drive and a static loop.

    u = v/(T s + 1),   f = g_0 u + sum_j g_j play_j(u),   y = H f + constant,

H the mechanics and the creep lag with gain 1 at rest. The weights g, which every excerpt has for
itself, and the constants are linear: they are eliminated at every theta (variable projection, with
Kaufman's derivative, BIT 15 (1975), 49). A loop of Bouc and Wen is odd play operators to about a
percent, so the rates at which it runs do not mislead the time constants.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np

from psa_casadi.common.units import BoolArray, ComplexArray, FloatArray, IndexArray
from psa_casadi.identification.fitting.levenberg_marquardt import minimise
from psa_casadi.identification.fitting.unknowns import static_compliance, within_bounds
from psa_casadi.identification.start.linear_response import (
    Response,
    contributions,
    first_order,
    mechanics_poles,
    numerator_time,
    orthonormal,
    oscillators,
    plays,
    respond,
    vector_fit,
)
from psa_casadi.identification.start.ordinary import has_loop, loop_start, loop_starts, within_base
from psa_casadi.model.compose import Model
from psa_casadi.records.drive import turns
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.record import Record

#: Samples that all excerpts together may have, and that one may.
SAMPLES, MOST = 8_000, 4_000
#: Radii of the play operators that stand for the loop, over the range of the voltage.
RADII = tuple(k / 16.0 for k in range(1, 9))
#: Share of its range that a static loop must miss in a record: with a voltage that crosses its
#: range within `_FAST` samples, and with a slower one, where the shape of the loop may be wrong.
_SHOWS_FAST, _SHOWS_SLOW, _FAST = 0.01, 0.03, 16.0
#: A record whose voltage takes this many times longer than that of the fastest adds no dynamics.
_SLOWER = 30.0
#: Least noise over the range, and the largest where fast motion looks like noise to its estimate.
_NOISE = (2e-3, 2e-2)
_FEWEST = 16
#: Share of the range within which a response has settled, and within which it is all but over.
_SETTLED, _OVER = 0.01, 0.05
#: Share of an excerpt that starts in motion which is left out as its transient.
_LEAD = 0.2
#: A motion that starts with less than this share of its ordinary rate starts at rest.
_SLOWLY = 0.2
#: Voltages equal within this share of the range are one level.
_LEVEL = 1e-4


@dataclass(frozen=True, eq=False)
class Excerpt:
    """Uniform samples h [s] apart of one record, from (nearly) rest; all arrays (n,).

    `v` [V] and `y` [m] are deviations from the start; `valid` marks measured samples that count,
    elsewhere y is a stand-in; `sigma` [m] is the white noise, within `_NOISE`; `loop` [m] is the
    best static loop for y, 0 at the start, and `static` [m] the root mean square that it leaves.
    No time constant of a stack exceeds `longest` [s]: a hold shows when the response is over.
    """

    name: str
    h: float
    longest: float
    v: FloatArray
    y: FloatArray
    valid: BoolArray
    sigma: float
    loop: FloatArray
    static: float

    @property
    def range(self) -> float:
        """Range of the displacement [m]."""
        return float(np.ptp(self.y[self.valid]))

    @property
    def excess(self) -> float:
        """Root mean square that a static loop leaves above the noise [m]."""
        return float(np.sqrt(max(self.static**2 - self.sigma**2, 0.0)))

    @property
    def crossing(self) -> float:
        """Time in which the voltage crosses its range at its fastest [s]."""
        return self.h * float(np.ptp(self.v) / np.max(np.abs(np.diff(self.v))))


@dataclass(frozen=True, eq=False)
class _Samples:
    """Uniform samples of a record, as they stand: nan where no displacement was measured."""

    h: float
    longest: float
    v: FloatArray
    y: FloatArray

    def part(self, start: int, stop: int, every: int = 1) -> "_Samples":
        cut = slice(max(start, 0), stop, every)
        return _Samples(self.h * every, self.longest, self.v[cut], self.y[cut])


def excerpts(records: Sequence[Record]) -> list[Excerpt]:
    """Return the excerpts in which a static loop misses what is there, the clearest first."""
    dynamic = [
        e
        for e in (e for r in records for e in _of_record(r))
        if (e.static > _SHOWS_FAST * e.range if _fast(e) else e.excess > _SHOWS_SLOW * e.range)
    ]
    fastest = min((e.crossing for e in dynamic), default=0.0)
    kept: list[Excerpt] = []
    for e in sorted(dynamic, key=lambda e: e.range / e.static):
        room = not kept or sum(k.y.size for k in kept) + e.y.size <= SAMPLES
        if room and e.crossing <= _SLOWER * fastest:
            kept.append(e)
    return kept


def _fast(e: Excerpt) -> bool:
    return e.crossing <= _FAST * e.h


def _of_record(record: Record) -> list[Excerpt]:
    """Return the excerpts of one record: all of it, or its fastest part and a coarse whole."""
    if record.displacement is None or record.mask.sum() < _FEWEST or not np.ptp(record.voltage):
        return []
    whole = _without_rests(_uniform(record))
    if whole.v.size <= MOST:
        return _excerpt(record.name, whole)
    start = fastest_part(whole.v, MOST)
    result = _excerpt(f"{record.name}, fastest part", whole.part(start, start + MOST))
    coarse = whole.part(0, whole.v.size, -(-whole.v.size // MOST))
    at = np.arange(whole.v.size) * whole.h
    misfit = np.interp(at, np.arange(coarse.v.size) * coarse.h, coarse.v) - whole.v
    if np.std(misfit) < 0.02 * np.ptp(whole.v):
        result += _excerpt(f"{record.name}, coarse", coarse)
    return result


def _excerpt(name: str, samples: _Samples) -> list[Excerpt]:
    """Return the samples as an excerpt, or nothing where too little was measured or moved."""
    v, y = samples.v, samples.y
    valid = np.isfinite(y)
    rest = _leading_rest(v)
    lead = int(_LEAD * v.size)
    if rest == 0 and np.ptp(v[lead:]) > 0.5 * np.ptp(v):
        valid[:lead] = False
    if valid.sum() < _FEWEST or not np.ptp(v) or not np.ptp(y[valid]):
        return []
    filled = np.interp(np.arange(y.size), np.flatnonzero(np.isfinite(y)), y[np.isfinite(y)])
    moved = filled - np.mean(filled[: max(rest, 1)])
    loop, static = _static_loop(v - v[0], moved, valid)
    excerpt = Excerpt(name, samples.h, samples.longest, v - v[0], moved, valid, 0.0, loop, static)
    noise = max(high_frequency_noise(filled[valid]), _NOISE[0] * excerpt.range)
    return [
        replace(excerpt, sigma=min(noise, _NOISE[1] * excerpt.range) if _fast(excerpt) else noise)
    ]


def _static_loop(v: FloatArray, y: FloatArray, valid: BoolArray) -> tuple[FloatArray, float]:
    """Return the best static loop for y, 0 at the start, and the rms [m] that it leaves."""
    span = float(np.ptp(v))
    columns = np.column_stack([v, plays(v, [span * r for r in RADII]), np.full(v.size, span)])
    q, transform = orthonormal(columns[valid])
    weights = transform @ (q.T @ y[valid])
    fitted = columns @ weights
    return fitted - fitted[0], float(np.sqrt(np.mean((y[valid] - fitted[valid]) ** 2)))


def _uniform(record: Record) -> _Samples:
    """Return the record on uniform instants; a displacement counts within half an interval."""
    t, y = record.time, np.asarray(record.displacement, dtype=np.float64)
    steps = np.diff(t)
    if np.ptp(steps) < 0.01 * record.sample_time:
        return _Samples(record.duration / steps.size, record.duration, record.voltage, y)
    h = max(float(np.quantile(steps, 0.1)), record.duration / (20.0 * MOST))
    grid = t[0] + h * np.arange(int(record.duration / h) + 1)
    measured = t[record.mask]
    after = np.searchsorted(measured, grid).clip(1, measured.size - 1)
    distance = np.minimum(np.abs(grid - measured[after - 1]), np.abs(measured[after] - grid))
    displacement = np.interp(grid, measured, y[record.mask])
    displacement[distance > 0.5 * h] = np.nan
    return _Samples(h, record.duration, np.interp(grid, t, record.voltage), displacement)


def _without_rests(s: _Samples) -> _Samples:
    """Return the samples up to where the last response has settled, and settled ones made nan.

    A rest before the first change of voltage is cut short. Where the longest hold is more than
    twice as long as the response to within 5 %, that response limits the time constants.
    """
    y, size = s.y.copy(), float(np.nanmax(s.y) - np.nanmin(s.y))
    still = np.abs(np.diff(s.v)) <= _LEVEL * np.ptp(s.v)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still, [0]])))
    holds = [(int(a), int(b) + 1) for a, b in zip(edges[::2], edges[1::2], strict=True) if a > 0]
    over = [(last - first, _settled(s.y[first:last], _OVER * size)) for first, last in holds]
    length, response = max(over, default=(0, 0))
    longest = s.longest
    if 2 * response < length:
        longest = min((max(r for n, r in over if 2 * r < n) + 8) * s.h, longest)
    for first, last in holds:
        y[first + 2 * _settled(s.y[first:last], _SETTLED * size) + _FEWEST : last] = np.nan
    start = max(_leading_rest(s.v) - max(s.v.size // 50, 8), 0)
    whole = _Samples(s.h, longest, s.v, y)
    return whole.part(start, int(np.flatnonzero(np.isfinite(y))[-1]) + 1)


def _settled(y: FloatArray, tolerance: float) -> int:
    """Return the number of samples until a hold stays at its last level; all where that is open."""
    third = y[2 * y.size // 3 :]
    if np.isfinite(third).sum() < _FEWEST:
        return int(y.size)
    noise = high_frequency_noise(y[np.isfinite(y)])
    away = np.flatnonzero(np.abs(y - np.nanmedian(third)) > max(tolerance, 3.0 * noise))
    return int(away[-1]) + 1 if away.size else 0


def _leading_rest(v: FloatArray) -> int:
    """Return how many samples at the start have the first voltage; 0 if it was moving before.

    A single sample counts as a rest where the voltage jumps to a level or starts to move slowly.
    """
    level = _LEVEL * float(np.ptp(v))
    changed = np.flatnonzero(np.abs(v - v[0]) > level)
    rest = int(changed[0]) if changed.size else v.size
    moves = np.diff(v)
    slow = np.max(np.abs(moves[:3])) < _SLOWLY * np.sqrt(np.mean(moves**2))
    return 0 if rest == 1 and np.ptp(v[1:4]) > level and not slow else rest


def fastest_part(v: FloatArray, length: int) -> int:
    """Return the start of the part with the largest jumps of voltage from sample to sample.

    Of equal parts the last, a little before.
    """
    energy = np.concatenate([[0.0], np.cumsum(np.diff(v) ** 2)])
    inside = energy[length - 1 :] - energy[: v.size - length + 1]
    best = int(np.flatnonzero(inside >= (1.0 - 1e-9) * inside.max())[-1])
    return max(best - length // 50, 0)


#: Coordinates theta are the natural logarithms of the times T, tau, a_P, of q_P, a square of a
#: time, of a_B, q_B, and of r = k_P/k_B, as in `linear_response`.
#: Standard deviations of the weak priors of the coordinates, centred where a fit starts.
_PRIOR = np.array([2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 1.0])
#: Weak priors, all with standard deviation 1.5: ln of the damping ratios a/(2 sqrt(q)) about 0.7,
#: which keeps a pole and the zero from cancelling far below the band, and ln (m_P/m_B) about 0,
#: since wafers and bonding layers with their places exchanged respond almost equally.
_TYPICAL = np.array(
    [[0, 0, 1, -0.5, 0, 0, 0], [0, 0, 0, 0, 1, -0.5, 0], [0, 0, 0, 1, 0, -1, 1]]
) / 1.5  # fmt: skip
_TYPICAL_AT = np.log([1.4, 1.4, 1.0]) / 1.5
#: Mean and standard deviation of the prior of a play operator's weight, over the slope, where the
#: voltage turns; and where it does not: there only the prior keeps a curve that bends the other
#: way from standing for a fast response behind a slow drive.
_LOOP_PRIOR, _CURVE_PRIOR = (0.03, 0.1), (0.03, 0.02)
#: The same for a shift of the voltage in time, in samples, where it jumps within `_JUMP` samples:
#: the instant between two samples is not known.
_SHIFT_PRIOR, _JUMP = (0.0, 0.3), 2.0
#: Step of the derivatives by differences, in natural logarithms.
_STEP = 1e-3
#: A fit ends when two steps in a row lower the cost by less than this share of it.
_TOLERANCE = 1e-3
#: Shortest time constant over the shortest interval.
_SHORTEST = 0.01


@dataclass(frozen=True, eq=False)
class LinearFit:
    """Where a fit ended: theta (7,), standard errors (7,), weighted cost, and what is left over.

    `left` holds the root mean square of the residual of every excerpt [m], `white` that of its
    white part; a coordinate that was held has no standard error (nan).
    """

    theta: FloatArray
    errors: FloatArray
    cost: float
    left: tuple[float, ...]
    white: tuple[float, ...]


def fit_linear(
    parts: Sequence[Excerpt], start: FloatArray, *, ratio_free: bool, evaluations: int
) -> LinearFit:
    """Fit theta (7,) to the excerpts, from `start`; r stays there unless it is free."""
    free = np.arange(7 if ratio_free else 6)
    low, high = _bounds(parts)
    weights = 1.0 / _PRIOR[free]

    def evaluate(coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals (of every excerpt and its loop's prior, then priors) and Jacobian."""
        theta = start.copy()
        theta[free] = coordinates
        each = [_eliminated(e, theta, free) for e in parts]
        priors = [weights * (coordinates - start[free]), _TYPICAL @ theta - _TYPICAL_AT]
        residual = np.concatenate([*(r for r, _ in each), *priors])
        return residual, np.vstack([*(j for _, j in each), np.diag(weights), _TYPICAL[:, free]])

    minimum = minimise(
        evaluate, start[free], (low[free], high[free]),
        tolerance=_TOLERANCE, evaluations=evaluations,
    )  # fmt: skip
    if minimum is None:  # the objective is finite wherever the bounds allow
        raise ArithmeticError("The linear fit has no value at its start.")
    theta = start.copy()
    theta[free] = minimum.theta
    ends = np.cumsum([int(e.valid.sum()) + _weights_of(e) for e in parts])
    blocks = np.split(minimum.residual, ends)
    data = [b[: int(e.valid.sum())] for e, b in zip(parts, blocks, strict=False)]
    level = max(1.0, float(np.mean(np.concatenate(data) ** 2)))
    information = minimum.jacobian.T @ minimum.jacobian / level
    errors = np.full(7, np.nan)
    errors[free] = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    residuals = [e.sigma * r for e, r in zip(parts, data, strict=True)]
    left = tuple(float(np.sqrt(np.mean(r**2))) for r in residuals)
    white = tuple(high_frequency_noise(r) for r in residuals)
    return LinearFit(theta, errors, minimum.cost, left, white)


def _cost_of(parts: Sequence[Excerpt], theta: FloatArray) -> float:
    """Return the weighted sum of squares that theta (7,) leaves, without its prior."""
    inside = np.clip(theta, *_bounds(parts))
    none = np.arange(0)
    return sum(float(np.sum(_eliminated(e, inside, none)[0] ** 2)) for e in parts)


def _bounds(parts: Sequence[Excerpt]) -> tuple[FloatArray, FloatArray]:
    times = np.log([_SHORTEST * min(e.h for e in parts), min(e.longest for e in parts)])
    power, ratio = np.array([1.0, 1.0, 1.0, 2.0, 1.0, 2.0]), np.log([0.05, 100.0])
    low, high = (np.append(power * t, r) for t, r in zip(times, ratio, strict=True))
    return low, high


def _weights_of(e: Excerpt) -> int:
    """Return how many weights of an excerpt's loop have a prior: of plays, and a jump's shift."""
    return len(RADII) + int(e.crossing < _JUMP * e.h)


def _eliminated(e: Excerpt, theta: FloatArray, free: IndexArray) -> tuple[FloatArray, FloatArray]:
    """Return the weighted residual that the best weights leave, with its priors, and its Jacobian.

    Kaufman's, with a column for each free coordinate.
    """
    force = _force(e, theta)
    count, extra = int(e.valid.sum()), _weights_of(e)
    slope = float(np.polyfit(e.v[e.valid], e.y[e.valid], 1)[0])
    priors = [_LOOP_PRIOR if turns(e.v) else _CURVE_PRIOR] * len(RADII)
    mean, deviation = np.array([*priors, _SHIFT_PRIOR][:extra]).T
    matrix = np.zeros((count + extra, extra + 2))
    matrix[:count, :-1] = _behind(e, theta, force)[e.valid] / e.sigma
    matrix[:count, -1] = 1.0 / e.sigma
    matrix[count:, 1:-1] = np.diag(1.0 / (deviation * abs(slope)))
    target = np.append(e.y[e.valid] / e.sigma, np.sign(slope) * mean / deviation)
    q, transform = orthonormal(matrix)
    weights = (transform @ (q.T @ target))[:-1]
    jacobian = np.zeros((target.size, free.size))
    if free.size:
        total = force @ weights
        here = _behind(e, theta, total)[e.valid]
        for k, place in enumerate(free):
            moved = theta.copy()
            moved[place] += _STEP
            source = _force(e, moved) @ weights if place == 0 else total
            jacobian[:count, k] = (_behind(e, moved, source)[e.valid] - here) / (_STEP * e.sigma)
    return q @ (q.T @ target) - target, jacobian - q @ (q.T @ jacobian)


def _force(e: Excerpt, theta: FloatArray) -> FloatArray:
    """Return the drive's voltage, the play operators on it and, for a jump, its shift, (n, k)."""
    u = first_order(float(np.exp(theta[0])), e.v, e.h)
    span = float(np.ptp(e.v))
    columns = [u[:, None], plays(u, [span * r for r in RADII])]
    if e.crossing < _JUMP * e.h:
        columns.append(np.gradient(u)[:, None])
    return np.hstack(columns)


def _behind(e: Excerpt, theta: FloatArray, x: FloatArray) -> FloatArray:
    """Return x behind the creep lag and the mechanics, gain 1 at rest."""
    return respond(mechanics_poles(theta), numerator_time(theta), x, e.h)


#: Number of candidates at most, and of poles that vector fitting looks for.
CANDIDATES, ORDERS = 4, (1, 2, 3, 4, 5)
#: Poles count that are this share of the noise, or of the strongest.
_COUNTS = 0.2
#: Excerpts whose poles are sought.
_SOURCES = 3
#: Rounds of the search: how many of the best starts go on, for how many evaluations; the last one.
_ROUNDS, _FULL = ((16, 3), (8, 6)), 20
#: Largest difference, in natural logarithms, of starts that are the same.
_ALIKE = 0.1
#: Dynamics show when the variance that they leave is less than this of what a static loop leaves,
#: and that is more than this of the noise.
_GAIN, _VISIBLE = 0.5, 0.1
#: Least residual, over the range, by which an excerpt is weighted.
_FLOOR = 5e-4
#: How much more a residual that is not white counts than a white one.
_MISSED = 10.0


@dataclass(frozen=True)
class LinearCandidate:
    """Starting values by parameter name, their misfit, and the parameters that are determined.

    `misfit` is the rms residual of the fast records as a share of their range; `determined` names
    the parameters with a standard error below a factor of e^(1/2).
    """

    values: Mapping[str, float]
    misfit: float
    determined: tuple[str, ...]


def linear_start(
    records: Sequence[Record], values: Mapping[str, float]
) -> tuple[LinearCandidate, ...]:
    """Return starting values of tau, R_s, c_P, m_P, c_B, m_B, and k_P if determined; best first.

    `values` gives C_p [F], k_P and k_B [N/m], which voltage and displacement do not determine.
    Empty if the records show no dynamics: loops that a static loop explains.
    """
    parts: Sequence[Excerpt] = excerpts(records)
    if not parts:
        return ()
    starts: list[FloatArray] = []
    for e in parts[:_SOURCES]:
        v, y = e.v[e.valid] - np.mean(e.v[e.valid]), e.y[e.valid]
        scaled = e.v * float(v @ (y - np.mean(y)) / (v @ v))  # the voltage in metres
        for source in (scaled, e.loop):
            starts += placed(e, source, ORDERS, [log(values["k_P"] / values["k_B"])], weak=True)
    best, parts = sought(parts, starts, _ROUNDS, ratio_free=False, reweigh=True)
    fits = _different(_refined(parts, f) for f in best[:CANDIDATES])
    return tuple(_candidate(f, values, _share(parts, f.left)) for f in fits if _explains(parts, f))


def sought(
    parts: Sequence[Excerpt],
    starts: Sequence[FloatArray],
    rounds: Sequence[tuple[int, int]],
    *,
    ratio_free: bool,
    reweigh: bool = False,
) -> tuple[list[LinearFit], Sequence[Excerpt]]:
    """Return the best fits from starts (7,), unlike each other, and the excerpts as last weighted.

    In rounds: how many of the best go on, and for how many evaluations. `reweigh` gives excerpts
    the noise that the best fit leaves, in which what the model misses and which is not white counts
    many times.
    """
    kept: list[FloatArray] = []
    for theta in starts:
        if all(np.max(np.abs(theta - k)) > _ALIKE for k in kept):
            kept.append(theta)
    kept.sort(key=lambda theta: _cost_of(parts, theta))
    best: list[LinearFit] = []
    for count, evaluations in rounds:
        best = _different(
            fit_linear(parts, s, ratio_free=ratio_free, evaluations=evaluations)
            for s in kept[:count]
        )
        kept = [f.theta for f in best]
        if reweigh:
            levels = [
                np.hypot(white, _MISSED * np.sqrt(max(left**2 - white**2, 0.0)))
                for left, white in zip(best[0].left, best[0].white, strict=True)
            ]
            parts = [
                replace(e, sigma=float(max(level, _FLOOR * e.range)))
                for e, level in zip(parts, levels, strict=True)
            ]
    return best, parts


def _explains(parts: Sequence[Excerpt], fit: LinearFit) -> bool:
    """Whether dynamics leave clearly less than a static loop does, white noise aside."""
    noise = _share(parts, fit.white) ** 2
    left = _share(parts, fit.left) ** 2 - noise
    static = _share(parts, [e.static for e in parts]) ** 2 - noise
    return left < _GAIN * static and static > _VISIBLE * noise


def _share(parts: Sequence[Excerpt], left: Sequence[float]) -> float:
    """Return the root mean square of what is left over the ranges."""
    return float(np.sqrt(np.mean([(r / e.range) ** 2 for e, r in zip(parts, left, strict=True)])))


def _refined(parts: Sequence[Excerpt], fit: LinearFit) -> LinearFit:
    """Return the fit continued, with k_P/k_B free where that lowers the cost clearly."""
    fixed = fit_linear(parts, fit.theta, ratio_free=False, evaluations=_FULL)
    free = fit_linear(parts, fixed.theta, ratio_free=True, evaluations=_FULL)
    samples = sum(int(e.valid.sum()) for e in parts)
    needed = max(1.0, free.cost / samples) * log(samples)
    return free if free.errors[-1] < 0.5 and fixed.cost - free.cost > needed else fixed


def _different(fits: Iterable[LinearFit]) -> list[LinearFit]:
    """Return the fits, best first, without those that repeat a better one within 10 %."""
    kept: list[LinearFit] = []
    for f in sorted(fits, key=lambda f: f.cost):
        if all(np.max(np.abs(f.theta - k.theta)) > _ALIKE for k in kept):
            kept.append(f)
    return kept


def _candidate(fit: LinearFit, values: Mapping[str, float], misfit: float) -> LinearCandidate:
    drive, tau, *_, ratio = np.exp(fit.theta).tolist()
    ratio_free, k_B = not np.isnan(fit.errors[-1]), values["k_B"]
    k_P = ratio * k_B if ratio_free else values["k_P"]
    table = {"R_s": drive / values["C_p"], "tau": tau, **oscillators(fit.theta, k_P, k_B)}
    names = (*table, "k_P")
    determined = tuple(n for n, e in zip(names, fit.errors, strict=True) if e < 0.5)
    return LinearCandidate(
        within_base(table | ({"k_P": k_P} if ratio_free else {})), misfit, determined
    )


def placed(
    e: Excerpt, source: FloatArray, orders: Sequence[int], ratios: Sequence[float], *, weak: bool
) -> Iterator[FloatArray]:
    """Yield theta (7,) for every way to place the poles of an excerpt's response to a source (n,).

    Poles that hardly show are left out; with `weak` also those that hardly do over the strongest.
    """
    response = Response(e.h, source, e.y, e.valid, e.sigma)
    for order in orders:
        poles = vector_fit(response, order)
        share = contributions(response, poles)
        least = min(1.0, share.max())
        for level in {least, share.max()} if weak else {least}:
            for theta in arrangements(poles[share >= _COUNTS * level], e.h):
                for ratio in ratios:
                    yield np.append(theta, ratio)


def arrangements(poles: ComplexArray, interval: float) -> list[FloatArray]:
    """Return ln (T, tau, a_P, q_P, a_B, q_B) for the ways to place poles [rad/s]; see module.

    Oscillations belong to wafers and bonding layers, the slowest real pole to the creep lag or
    the drive, others to the drive or an overdamped pair. What is left open lies at 0.3 of the
    shortest of these times, not below a quarter of the sampling interval.
    """
    times = sorted((1.0 / abs(p) for p in poles if not p.imag), reverse=True)
    tones = sorted((p for p in poles if p.imag > 0), key=abs)
    fast = max(0.3 * min([1.0 / abs(p) for p in poles]), 0.25 * interval)
    pairs = [(-2.0 * p.real / abs(p) ** 2, 1.0 / abs(p) ** 2) for p in tones[:2]]
    result = []
    for lags in (2, 1) if len(times) > 1 else (2,):
        slow = [*times, fast, fast][:lags] + [0.5 * fast] * (2 - lags)
        left = times[lags:]
        both = list(pairs)
        while len(both) < 2:
            one, two = [*left, fast, 0.7 * fast][:2]
            left = left[2:]
            both.append((one + two, one * two))
        for tau, drive in {(slow[0], slow[1]), (slow[1], slow[0])}:
            for b, p in {(both[0], both[1]), (both[1], both[0])}:
                result.append(np.log([drive, tau, *p, *b]))
    return result


#: Candidate dynamics that miss the fast records this much more than the best are not tried.
_WORSE, _DYNAMICS = 1.2, 3
#: An oscillator shows where sqrt(m/k) is at least this share of the sampling interval.
_RESOLVED = 0.3
_MASSES = ("m_P", "m_B")


def starting_points(
    model: Model, linear: Sequence[LinearCandidate], records: Sequence[Record]
) -> list[tuple[str, dict[str, float]]]:
    """Return the starts by name; static gain and loop keep their size where k_P moves.

    The loop that the records show comes first, then shapes that loops usually have: fewer of them
    where the records show a loop, and where they show dynamics to try. The model's loop where
    its hysteresis is none of Bouc-Wen's.
    """
    shapes: list[tuple[str, dict[str, float]]] = [("the model's loop", {})]
    if has_loop(model):
        shapes = [(f"loop shape {k}", shape) for k, shape in enumerate(loop_starts(model), 1)]
        loop = loop_start(model, records)
        if loop is not None:
            shapes = [("the records' loops", loop), *shapes[: 1 if linear else 2]]
    if not linear:
        return shapes
    sample_time = min(r.sample_time for r in records)
    dynamics = [within_bounds(model, values) for values in _dynamics(model, linear, sample_time)]
    named = [(name, _moved(model, shape, dynamics[0])) for name, shape in shapes]
    return named + [
        (f"dynamics {k}", _moved(model, shapes[0][1], other))
        for k, other in enumerate(dynamics[1:], 2)
    ]


def resolved(
    model: Model, linear: Sequence[LinearCandidate], sample_time: float
) -> tuple[str, ...]:
    """Return the masses, and k_P, that are searched because the best candidate shows them.

    Two masses that the sampling resolves are searched even if they are determined badly: with
    assumed masses the intervals of the lags would be too short.
    """
    if not linear:
        return ()
    values = {**model.values, **linear[0].values}
    times = {m: (values[m] / values[m.replace("m", "k")]) ** 0.5 for m in _MASSES}
    masses = tuple(m for m, t in times.items() if t >= _RESOLVED * sample_time)
    return (*masses, *(n for n in ("k_P",) if masses and n in linear[0].determined))


def _dynamics(
    model: Model, linear: Sequence[LinearCandidate], sample_time: float
) -> list[dict[str, float]]:
    """Return the dynamics to start from: the creep lag the slower one, then the drive's lag.

    A linear response does not separate the two; amplifiers are usually the faster. Where the
    sampling resolves no mass, masses stay as they are and the slowest lag is the creep lag.
    """
    near = [dict(c.values) for c in linear if c.misfit < _WORSE * linear[0].misfit]
    if not set(_MASSES) & set(resolved(model, linear, sample_time)):
        near = [_creep_slowest(model, values) for values in near]
    slow_first, turned = [], []
    for values in near:
        drive = values["R_s"] * model.values["C_p"]
        there = {**values, "tau": drive, "R_s": values["tau"] / model.values["C_p"]}
        pair = (values, there) if values["tau"] >= drive else (there, values)
        slow_first.append(pair[0])
        turned.append(pair[1])
    return [*slow_first[:_DYNAMICS], turned[0]]


def _creep_slowest(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Return dynamics of lags alone: ordinary masses, the creep lag exchanged with a slower c/k."""
    ordinary = {k: v for k, v in values.items() if k not in (*_MASSES, "k_P")}
    stiffness = {c: model.values[c.replace("c", "k")] for c in ("c_P", "c_B")}
    table = {c: values[c] / {**model.values, **values}[c.replace("c", "k")] for c in stiffness}
    ordinary |= {c: lag * stiffness[c] for c, lag in table.items()}
    slow = max(table, key=lambda c: table[c])
    if table[slow] > values["tau"]:
        ordinary |= {"tau": table[slow], slow: values["tau"] * stiffness[slow]}
    return ordinary


def _moved(
    model: Model, shape: Mapping[str, float], candidate: Mapping[str, float]
) -> dict[str, float]:
    """Return a loop with a candidate's dynamics, forces scaled to keep the displacement."""
    before = static_compliance(model.values)
    ratio = before / static_compliance({**model.values, **candidate})
    forces = {"k_L": model.values["k_L"], **shape}
    scaled = {n: v if n == "n" else v * ratio for n, v in forces.items()}
    return {**scaled, **candidate}
