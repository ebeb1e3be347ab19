"""The linear part fitted to excerpts: eqs. (13), (15) behind a drive and a static loop.

    u = v/(T s + 1),   f = g_0 u + sum_j g_j play_j(u),   y = H f + constant,

H the mechanics and the creep lag with gain 1 at rest. The weights g, which every excerpt has for
itself, and the constants are linear: they are eliminated at every theta (variable projection, with
Kaufman's derivative, BIT 15 (1975), 49). A loop of Bouc and Wen is odd play operators to about a
percent, so the rates at which it runs do not mislead the time constants.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.fitting.levenberg_marquardt import Evaluate, minimise
from psa_casadi.identification.start.linear_response import (
    first_order,
    mechanics_poles,
    numerator_time,
    orthonormal,
    plays,
    respond,
)
from psa_casadi.records.drive import turns
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

BoolArray = npt.NDArray[np.bool_]

#: Samples that all excerpts together may have, and that one may.
SAMPLES, MOST = 8_000, 4_000
#: Radii of the play operators that stand for the loop, over the range of the voltage.
RADII = tuple(k / 16.0 for k in range(1, 9))
#: Share of its range that a static loop must miss in a record: with a voltage that crosses its
#: range within `_FAST` samples, and with a slower one, where the shape of the loop may be missed.
_SHOWS_FAST, _SHOWS_SLOW, _FAST = 0.01, 0.03, 16.0
#: A record whose voltage takes this many times longer than that of the fastest adds no dynamics.
_SLOWER = 30.0
#: Least noise over the range, and the largest where fast motion looks like noise to its estimate.
_NOISE = (2e-3, 2e-2)
_FEWEST = 16
#: Share of the range within which a response has settled, and within which it is all but over.
_SETTLED, _OVER = 0.01, 0.05
#: Share of an excerpt that begins in motion and is given to its transient.
_LEAD = 0.2
#: A motion that begins with less than this share of its ordinary rate begins at rest.
_SLOWLY = 0.2
#: Voltages alike within this share of the range are one level.
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
    found = [e for r in records for e in _of_record(r)]
    shown = [e for e in found if _shows(e)]
    shown.sort(key=lambda e: e.range / e.static)
    fastest = min((e.crossing for e in shown), default=0.0)
    kept: list[Excerpt] = []
    for e in shown:
        room = not kept or sum(k.y.size for k in kept) + e.y.size <= SAMPLES
        if room and e.crossing <= _SLOWER * fastest:
            kept.append(e)
    return kept


def _fast(e: Excerpt) -> bool:
    return e.crossing <= _FAST * e.h


def _shows(e: Excerpt) -> bool:
    """Whether a static loop misses enough of the displacement; noise excused where it is known."""
    if _fast(e):
        return e.static > _SHOWS_FAST * e.range
    return e.static**2 - e.sigma**2 > (_SHOWS_SLOW * e.range) ** 2


def _of_record(record: Record) -> list[Excerpt]:
    """Return the excerpts of one record: all of it, or its fastest part and a coarse whole."""
    if record.displacement is None or record.mask.sum() < _FEWEST or not np.ptp(record.voltage):
        return []
    whole = _without_rests(_uniform(record))
    if whole.v.size <= MOST:
        return _excerpt(record.name, whole)
    start = fastest_part(whole.v, MOST)
    found = _excerpt(f"{record.name}, fastest part", whole.part(start, start + MOST))
    coarse = whole.part(0, whole.v.size, -(-whole.v.size // MOST))
    at = np.arange(whole.v.size) * whole.h
    missed = np.interp(at, np.arange(coarse.v.size) * coarse.h, coarse.v) - whole.v
    if np.std(missed) < 0.02 * np.ptp(whole.v):
        found += _excerpt(f"{record.name}, coarse", coarse)
    return found


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
    found = Excerpt(name, samples.h, samples.longest, v - v[0], moved, valid, 0.0, loop, static)
    noise = max(high_frequency_noise(filled[valid]), _NOISE[0] * found.range)
    return [replace(found, sigma=min(noise, _NOISE[1] * found.range) if _fast(found) else noise)]


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

    A single sample counts as a rest where the voltage jumps to a level or begins to move slowly.
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


IndexArray = npt.NDArray[np.intp]

#: Names of the coordinates: natural logarithms of times T, tau, a, of squares of times q, and of
#: r = k_P/k_B, as in `linear_response`.
COORDINATES = ("T", "tau", "a_P", "q_P", "a_B", "q_B", "r")
#: Standard deviations of the weak priors of the coordinates, centred where a fit starts.
_PRIOR = np.array([2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 1.0])
#: Weak priors, all with standard deviation 1.5: ln of the damping ratios a/(2 sqrt(q)) about 0.7,
#: which keeps a pole and the zero from cancelling far below the band, and ln (m_P/m_B) about 0,
#: since wafers and bonding layers with their places exchanged respond alike.
_TYPICAL = np.array(
    [[0, 0, 1, -0.5, 0, 0, 0], [0, 0, 0, 0, 1, -0.5, 0], [0, 0, 0, 1, 0, -1, 1]]
) / 1.5  # fmt: skip
_TYPICAL_AT = np.log([1.4, 1.4, 1.0]) / 1.5
#: Mean and standard deviation of the prior of a play operator's weight, over the slope, where the
#: voltage turns; and where it does not: there only the prior keeps a curve that bends the other
#: way from standing for a fast response behind a slow drive.
_LOOP_PRIOR, _CURVE_PRIOR = (0.03, 0.1), (0.03, 0.02)
#: The same for a shift of the voltage in time, in samples, where it jumps within `_JUMP` samples:
#: the record does not tell when, between two of them.
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
    found = minimise(
        _objective(parts, start, free),
        start[free],
        (low[free], high[free]),
        tolerance=_TOLERANCE,
        evaluations=evaluations,
    )
    if found is None:  # the objective is finite wherever the bounds allow
        raise ArithmeticError("The linear fit has no value at its start.")
    theta = start.copy()
    theta[free] = found.theta
    ends = np.cumsum([int(e.valid.sum()) for e in parts])
    data = np.split(found.residual[: ends[-1]], ends[:-1])
    level = max(1.0, float(np.mean(found.residual[: ends[-1]] ** 2)))
    information = found.jacobian.T @ found.jacobian / level
    errors = np.full(7, np.nan)
    errors[free] = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    residuals = [e.sigma * r for e, r in zip(parts, data, strict=True)]
    return LinearFit(
        theta=theta,
        errors=errors,
        cost=found.cost,
        left=tuple(float(np.sqrt(np.mean(r**2))) for r in residuals),
        white=tuple(high_frequency_noise(r) for r in residuals),
    )


def cost_of(parts: Sequence[Excerpt], theta: FloatArray) -> float:
    """Return the weighted sum of squares that theta (7,) leaves, without its prior."""
    low, high = _bounds(parts)
    inside = np.clip(theta, low, high)
    return sum(float(np.sum(_eliminated(e, inside).residual ** 2)) for e in parts)


def _bounds(parts: Sequence[Excerpt]) -> tuple[FloatArray, FloatArray]:
    shortest = np.log(_SHORTEST * min(e.h for e in parts))
    longest = np.log(min(e.longest for e in parts))
    power = np.array([1.0, 1.0, 1.0, 2.0, 1.0, 2.0])
    ratio = np.log([0.05, 100.0])
    return np.append(power * shortest, ratio[0]), np.append(power * longest, ratio[1])


def _objective(parts: Sequence[Excerpt], start: FloatArray, free: IndexArray) -> Evaluate:
    """Return residuals (data of all excerpts, their loop priors, then the prior) and Jacobian."""

    def evaluate(coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
        theta = start.copy()
        theta[free] = coordinates
        each = [_eliminated(e, theta) for e in parts]
        slopes = [_slopes(e, theta, free, found) for e, found in zip(parts, each, strict=True)]
        counts = [int(e.valid.sum()) for e in parts]
        weights = 1.0 / _PRIOR[free]
        residual = [
            *(f.residual[:n] for f, n in zip(each, counts, strict=True)),
            *(f.residual[n:] for f, n in zip(each, counts, strict=True)),
            weights * (coordinates - start[free]),
            _TYPICAL @ theta - _TYPICAL_AT,
        ]
        jacobian = [
            *(j[:n] for j, n in zip(slopes, counts, strict=True)),
            *(j[n:] for j, n in zip(slopes, counts, strict=True)),
            np.diag(weights),
            _TYPICAL[:, free],
        ]
        return np.concatenate(residual), np.vstack(jacobian)

    return evaluate


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """One excerpt at one theta: residual of data and loop prior, basis, force and its weights."""

    residual: FloatArray
    basis: FloatArray
    force: FloatArray
    weights: FloatArray


def _eliminated(e: Excerpt, theta: FloatArray) -> _Eliminated:
    """Return the least-squares weights of one excerpt and the weighted residual they leave."""
    force = _force(e, theta)
    count, extra = int(e.valid.sum()), force.shape[1] - 1
    slope = float(np.polyfit(e.v[e.valid], e.y[e.valid], 1)[0])
    priors = [_LOOP_PRIOR if turns(e.v) else _CURVE_PRIOR] * len(RADII)
    mean, deviation = np.array([*priors, _SHIFT_PRIOR][:extra]).T
    matrix = np.zeros((count + extra, extra + 2))
    matrix[:count, :-1] = _behind(e, theta, force)[e.valid] / e.sigma
    matrix[:count, -1] = 1.0 / e.sigma
    matrix[count:, 1:-1] = np.diag(1.0 / (deviation * abs(slope)))
    target = np.append(e.y[e.valid] / e.sigma, np.sign(slope) * mean / deviation)
    q, transform = orthonormal(matrix)
    weights = transform @ (q.T @ target)
    return _Eliminated(q @ (q.T @ target) - target, q, force, weights[:-1])


def _slopes(e: Excerpt, theta: FloatArray, free: IndexArray, at: _Eliminated) -> FloatArray:
    """Return Kaufman's Jacobian (rows of the residual, free coordinates)."""
    count = int(e.valid.sum())
    total = at.force @ at.weights
    here = _behind(e, theta, total)[e.valid]
    jacobian = np.zeros((at.residual.size, free.size))
    for k, place in enumerate(free):
        moved = theta.copy()
        moved[place] += _STEP
        source = _force(e, moved) @ at.weights if place == 0 else total
        jacobian[:count, k] = (_behind(e, moved, source)[e.valid] - here) / (_STEP * e.sigma)
    projected: FloatArray = jacobian - at.basis @ (at.basis.T @ jacobian)
    return projected


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
