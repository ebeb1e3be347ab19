"""Levenberg-Marquardt as a trust region within bounds, with an active set.

scipy's `least_squares` was measured first: its interior method (`trf`) crawls where a parameter
sits on its bound, as the Bouc-Wen exponent n does on piezo loops, and `dogbox` stops early in the
loop's curved valley.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from psa_casadi.common.units import FloatArray

#: theta -> (residual (m,), Jacobian (m, k)), or None where the model cannot be evaluated.
Evaluate = Callable[[FloatArray], tuple[FloatArray, FloatArray] | None]

#: Radius of the first step of a fit, and the least one of a fit that continues.
FIRST_RADIUS, LEAST_RADIUS = 1.0, 0.1
_SMALLEST_RADIUS = 1e-6
#: Where a step of any length promises more than this multiple of the tolerance, short steps are
#: those of a curved valley. At a tolerance of 1e-3 most fits that had ended promised 0 to 0.7 % of
#: the cost; 3 to 12 % where that of two measured records stopped 13 % above its least error.
_LEFT = 10.0
_NEWTON_STEPS = 60
#: Changes of the active set per coordinate; two or three are ordinary.
_ACTIVE_SETS = 20


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the iteration ended, with residual and Jacobian there, and how it ended.

    Neither `converged` nor `interrupted`: the evaluations were used up. `radius` is that of the
    next step.
    """

    theta: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    cost: float
    converged: bool
    interrupted: bool
    evaluations: int
    radius: float


def minimise(
    evaluate: Evaluate,
    theta: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    *,
    tolerance: float,
    evaluations: int,
    linear: Sequence[int] = (),
    goal: float = np.inf,
    radius: float = FIRST_RADIUS,
    patient: bool = False,
) -> Minimum | None:
    """Minimise |r(theta)|^2 within bounds; None if the start cannot be evaluated.

    A point where the squares of r or J exceed double precision counts as one that cannot be.

    Each step minimises |r + J step|^2 within a radius (Levenberg's damping, by bisection;
    Moré 1978) and the bounds, and is accepted if the cost falls; the radius, at first `radius`,
    follows the ratio of actual to predicted decrease.
    Converged when two steps in a row lower the cost by less than `tolerance` of it, or no radius
    lowers it at all. A keyboard interrupt ends the iteration at the best point so far.

    r(theta) is exactly linear in the `linear` coordinates, which no bound holds and on which the
    Jacobian does not depend: at every point they take their best values, without an evaluation.
    A minimum above the `goal` is of no use: the iteration ends where two steps in a row that lower
    the cost say that as many as are left, each as good as this one, would not lead there. One step
    does not: after a radius that was too large it may be short, and the next ones long again.
    Steps that the radius cuts short in a curved valley lower the cost by little, far from its end:
    a `patient` iteration has converged only where no step promises more than ten tolerances.
    """
    low, high = bounds
    columns = list(linear)
    theta = np.clip(theta, low, high)
    start = _measurable(evaluate(theta))
    if start is None:
        return None
    theta, residual, jacobian = _at_best(theta, start, columns)
    cost = float(residual @ residual)
    count, quiet, short, converged, interrupted = 1, 0, 0, False, False
    while count < evaluations and not converged:
        move, predicted = _best_step(theta, residual, jacobian, bounds, radius)
        trial = np.clip(theta + move, low, high)
        if predicted <= 1e-2 * tolerance * cost:
            converged = True
            break
        try:
            result = _measurable(evaluate(trial))
        except KeyboardInterrupt:
            interrupted = True
            break
        count += 1
        new = np.inf
        if result is not None:
            trial, *at_trial = _at_best(trial, result, columns)
            new = float(at_trial[0] @ at_trial[0])
        ratio = (cost - new) / predicted
        if ratio < 0.25:
            radius = 0.25 * float(np.linalg.norm(move))
        elif ratio > 0.75:
            radius = max(radius, 2.0 * float(np.linalg.norm(move)))
        if new < cost:
            quiet = quiet + 1 if cost - new < tolerance * cost else 0
            short = short + 1 if (evaluations - count) * (cost - new) < new - goal else 0
            theta, (residual, jacobian), cost = trial, at_trial, new
            converged = quiet >= 2 and not (
                patient
                and _best_step(theta, residual, jacobian, bounds, np.inf)[1]
                > _LEFT * tolerance * cost
            )
            if short == 2:
                break
        converged = converged or radius < _SMALLEST_RADIUS
    return Minimum(theta, residual, jacobian, cost, converged, interrupted, count, radius)


def _best_step(
    theta: FloatArray, residual: FloatArray, jacobian: FloatArray,
    bounds: tuple[FloatArray, FloatArray], radius: float,
) -> tuple[FloatArray, float]:  # fmt: skip
    """Return the step within bounds and radius, and by how much it lowers |r + J step|^2."""
    low, high = bounds
    gradient, normal = jacobian.T @ residual, jacobian.T @ jacobian
    move = _bounded_step(gradient, normal, radius, low - theta, high - theta)
    return move, -float(2.0 * gradient @ move + move @ normal @ move)


def _measurable(
    result: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, FloatArray] | None:
    """Return residual and Jacobian where |J|^2 |r|^2 is finite, else None: the model diverged."""
    if result is None:
        return None
    residual, jacobian = result
    with np.errstate(over="ignore", invalid="ignore"):
        size = float(np.vdot(residual, residual)) * max(1.0, float(np.vdot(jacobian, jacobian)))
    return result if np.isfinite(size) else None


def _at_best(
    theta: FloatArray, result: tuple[FloatArray, FloatArray], columns: list[int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return theta, residual and Jacobian where the residual's linear coordinates are best."""
    residual, jacobian = result
    if not columns:
        return theta, residual, jacobian
    slopes = jacobian[:, columns]
    move = np.zeros_like(theta)
    move[columns] = -np.linalg.lstsq(slopes.T @ slopes, slopes.T @ residual)[0]
    return theta + move, residual + slopes @ move[columns], jacobian


def _bounded_step(
    gradient: FloatArray, normal: FloatArray, radius: float, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return the step within the radius and between low and high (low <= 0 <= high).

    The damped minimum in the box gets shorter as the damping grows; bisection finds the damping
    that makes it as long as the radius.
    """
    step = _step(gradient, normal, radius)
    if np.all((step >= low) & (step <= high)):
        return step
    identity = np.eye(len(gradient))
    least = 1e-14 * max(float(np.trace(normal)), 1e-300)
    step = _in_box(gradient, normal + least * identity, low, high)
    if np.linalg.norm(step) <= radius:
        return step
    small, large = least, float(np.linalg.norm(gradient)) / radius
    while large > (1.0 + 1e-3) * small:
        middle = sqrt(small * large)
        step = _in_box(gradient, normal + middle * identity, low, high)
        small, large = (middle, large) if np.linalg.norm(step) > radius else (small, middle)
    return _in_box(gradient, normal + large * identity, low, high)


def _in_box(
    gradient: FloatArray, normal: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Minimise gradient step + step normal step / 2 between low and high, by active sets.

    Walks from 0 towards the minimum over the free coordinates; the first that meets its bound is
    held there. At that minimum, the held coordinate that pulls inwards most is let go.
    """
    step = np.zeros_like(gradient)
    free = ((low < 0) | (gradient < 0)) & ((high > 0) | (gradient > 0))
    for _ in range(_ACTIVE_SETS * len(gradient)):
        target = step.copy()
        held = normal[np.ix_(free, ~free)] @ step[~free]
        target[free] = np.linalg.solve(normal[np.ix_(free, free)], -gradient[free] - held)
        move = target - step
        edge = np.where(move > 0, high, low)
        crossing = free & ((target > high) | (target < low))
        if crossing.any():
            shares = np.full(len(step), np.inf)
            shares[crossing] = (edge[crossing] - step[crossing]) / move[crossing]
            first = int(np.argmin(shares))
            step = np.clip(step + shares[first] * move, low, high)
            step[first] = edge[first]
            free[first] = False
            continue
        step = target
        pull = gradient + normal @ step
        inward = np.where(step >= high, pull, -pull)
        inward[free | (low == high)] = 0.0
        if np.max(inward, initial=0.0) <= 1e-12 * float(np.max(np.abs(gradient), initial=0.0)):
            break
        free[int(np.argmax(inward))] = True
    return step


def _step(gradient: FloatArray, normal: FloatArray, radius: float) -> FloatArray:
    """Minimise |r + J step|^2 with |step| <= radius."""
    if not len(gradient):
        return gradient
    values, vectors = np.linalg.eigh(normal)
    values = np.maximum(values, 1e-14 * max(float(values[-1]), 1e-300))
    along = -(vectors.T @ gradient)
    damping = 0.0
    for _ in range(_NEWTON_STEPS):  # on 1/|step|, which grows nearly straight with the damping
        scaled = along / (values + damping)
        size = float(np.linalg.norm(scaled))
        if size <= (1.0 + 1e-9) * radius:
            break
        damping += (size / radius - 1.0) * size**2 / float(scaled @ (scaled / (values + damping)))
    damped: FloatArray = vectors @ scaled
    return damped
