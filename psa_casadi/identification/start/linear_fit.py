"""The linear part fitted to excerpts: eqs. (13), (15) behind a drive and a static loop.

    u = v/(T s + 1),   f = g_0 u + sum_j g_j play_j(u),   y = H f + constant,

H the mechanics and the creep lag with gain 1 at rest. The weights g, which every excerpt has for
itself, and the constants are linear: they are eliminated at every theta (variable projection, with
Kaufman's derivative, BIT 15 (1975), 49). A loop of Bouc and Wen is odd play operators to about a
percent, so the rates at which it runs do not mislead the time constants.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.fitting.levenberg_marquardt import Evaluate, minimise
from psa_casadi.identification.start.excerpts import RADII, Excerpt
from psa_casadi.identification.start.linear_response import (
    FloatArray,
    first_order,
    mechanics_poles,
    numerator_time,
    orthonormal,
    plays,
    respond,
)
from psa_casadi.records.drive import turns
from psa_casadi.records.noise import high_frequency_noise

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
