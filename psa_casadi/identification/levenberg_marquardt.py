"""Levenberg-Marquardt as a trust region within bounds, with an active set.

scipy's `least_squares` was measured first: its interior method (`trf`) crawls where a parameter sits
on its bound, as the Bouc-Wen exponent n does on piezo loops, and `dogbox` stops early in the loop's
curved valley.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
#: theta -> (residual (m,), Jacobian (m, k)), or None where the model cannot be evaluated.
Evaluate = Callable[[FloatArray], tuple[FloatArray, FloatArray] | None]

_FIRST_RADIUS = 1.0
_SMALLEST_RADIUS = 1e-6
_BISECTIONS = 60


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the iteration ended, with residual and Jacobian there, and whether it converged."""

    theta: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    cost: float
    converged: bool
    evaluations: int


def minimise(
    evaluate: Evaluate,
    theta: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    *,
    tolerance: float,
    evaluations: int,
) -> Minimum | None:
    """Minimise |r(theta)|^2 within bounds; None if the start cannot be evaluated.

    Each step minimises |r + J step|^2 within a radius (Levenberg's damping, found by bisection;
    Moré 1978) and the bounds, and is accepted if the cost falls; the radius follows the ratio of actual to predicted decrease.
    Converged when two steps in a row lower the cost by less than `tolerance` of it, or no radius
    lowers it at all.
    """
    low, high = bounds
    theta = np.clip(theta, low, high)
    start = evaluate(theta)
    if start is None:
        return None
    residual, jacobian = start
    cost, radius = float(residual @ residual), _FIRST_RADIUS
    count, quiet, converged = 1, 0, False
    while count < evaluations and not converged:
        gradient, normal = jacobian.T @ residual, jacobian.T @ jacobian
        move = _bounded_step(gradient, normal, radius, low - theta, high - theta)
        trial = np.clip(theta + move, low, high)
        predicted = -float(2.0 * gradient @ move + move @ normal @ move)
        if predicted <= 1e-2 * tolerance * cost:
            converged = True
            break
        found = evaluate(trial)
        count += 1
        new = float(found[0] @ found[0]) if found is not None else np.inf
        ratio = (cost - new) / predicted
        if ratio < 0.25:
            radius = 0.25 * float(np.linalg.norm(move))
        elif ratio > 0.75:
            radius = max(radius, 2.0 * float(np.linalg.norm(move)))
        if found is not None and new < cost:
            quiet = quiet + 1 if cost - new < tolerance * cost else 0
            theta, (residual, jacobian), cost = trial, found, new
            converged = quiet == 2
        converged = converged or radius < _SMALLEST_RADIUS
    return Minimum(theta, residual, jacobian, cost, converged, count)


def _bounded_step(
    gradient: FloatArray, normal: FloatArray, radius: float, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return the step within the radius and between low and high.

    Coordinates that the step would carry past a bound are set onto it and the others solved again,
    until none crosses.
    """
    step = np.zeros_like(gradient)
    free = np.ones(len(gradient), dtype=bool)
    while True:
        shifted = gradient + normal[:, ~free] @ step[~free]
        step[free] = _step(shifted[free], normal[np.ix_(free, free)], radius)
        crossing = free & ((step < low) | (step > high))
        if not crossing.any():
            return step
        step[crossing] = np.clip(step, low, high)[crossing]
        free &= ~crossing


def _step(gradient: FloatArray, normal: FloatArray, radius: float) -> FloatArray:
    """Minimise |r + J step|^2 with |step| <= radius."""
    if not len(gradient):
        return gradient
    values, vectors = np.linalg.eigh(normal)
    values = np.maximum(values, 1e-14 * max(float(values[-1]), 1e-300))
    along = -(vectors.T @ gradient)
    if np.linalg.norm(along / values) <= radius:
        solution: FloatArray = vectors @ (along / values)
        return solution
    low, high = 0.0, float(np.linalg.norm(along)) / radius
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if np.linalg.norm(along / (values + middle)) > radius:
            low = middle
        else:
            high = middle
    solution = vectors @ (along / (values + high))
    return solution
