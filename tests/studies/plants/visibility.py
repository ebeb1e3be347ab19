"""How much of an effect a record shows once the base model has absorbed what it can.

    ratio = rms(contribution - its least-squares fit by `base_directions`) / sigma

Columns: 1, base displacement, its rate, command, and the derivatives of the base displacement with
respect to R_s C_p, A, beta, gamma, n, delta and tau (central differences on a coarse grid). The
first four alone would call an effect visible that a re-fitted hysteresis swallows.
"""

import math
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.stack import FloatArray, Stack

COARSE_SUB_INTERVALS = 6
RELATIVE_STEP = 0.02
#: Largest change of a parameter in a fit, in its logarithm; residual of a loop that diverges.
_WIDEST, _DIVERGED = 12.0, 1e6
FREE = ("r_s", "a", "beta", "gamma", "n", "delta", "tau")


def base_directions(run: Run) -> FloatArray:
    """Orthonormal directions in which the base model can move, (N, 11)."""
    matrix = base_columns(run.stack, run.times, run.command, run.displacement)
    return np.asarray(np.linalg.qr(matrix / np.linalg.norm(matrix, axis=0))[0], dtype=np.float64)


def base_columns(
    stack: Stack, times: FloatArray, command: FloatArray, displacement: FloatArray
) -> FloatArray:
    """What moves the base's displacement (N,) [m], (N, 11): 1, it, its rate [m/s], the command [V],
    and the derivatives by the logarithms of FREE [m].
    """

    def moved(name: str, factor: float) -> FloatArray:
        changed: Stack = replace(stack, **{name: getattr(stack, name) * factor})
        return simulate_base(changed, times, command, COARSE_SUB_INTERVALS).displacement

    def derivative(name: str) -> FloatArray:
        step = RELATIVE_STEP / 2.0
        return (moved(name, 1.0 + step) - moved(name, 1.0 - step)) / RELATIVE_STEP

    rate = np.gradient(displacement, times)
    columns = [np.ones_like(displacement), displacement, rate, command]
    return np.column_stack([*columns, *(derivative(name) for name in FREE)])


def visible_ratio(directions: FloatArray, contribution: FloatArray, sigma: float) -> float:
    """Rms of what is left over the noise's sigma [1]."""
    left = contribution - directions @ (directions.T @ contribution)
    return math.sqrt(float(np.mean(left**2))) / sigma


def refitted_ratio(run: Run, contribution: FloatArray, sigma: float) -> float:
    """As `visible_ratio`, with the base fitted again instead of linearised: what a lag leaves once
    R_s C_p, tau and the dampings have taken over what they can. A few seconds; coarse grid.

    The dampings' own lags, c_P/k_P and c_B/k_B, may be far below the sampling interval, where no
    slope leads out: a second fit frees them from half of it.
    """
    start = simulate_base(run.stack, run.times, run.command, COARSE_SUB_INTERVALS).displacement

    def rest(logs: FloatArray) -> FloatArray:
        # without the dampings' logarithms they stay as they are
        factors = dict(zip((*FREE, "k_l", "c_p", "c_b"), np.exp(logs).tolist(), strict=False))
        moved = {name: getattr(run.stack, name) * factor for name, factor in factors.items()}
        stack: Stack = replace(run.stack, **moved)
        try:
            fitted = simulate_base(stack, run.times, run.command, COARSE_SUB_INTERVALS).displacement
        except OverflowError:  # a loop that diverges explains nothing
            return np.full(run.times.size, _DIVERGED)
        left = (contribution + start - fitted) / sigma
        return np.asarray(left - left.mean(), dtype=np.float64)

    half = 0.5 * float(run.times[1] - run.times[0])
    lags = run.stack.c_p / run.stack.k_p, run.stack.c_b / run.stack.k_b
    plain = np.zeros(len(FREE) + 1)
    damped = np.concatenate([plain, np.clip(np.log(half / np.array(lags)), -_WIDEST, _WIDEST)])
    bounds = (-_WIDEST - 1.0, _WIDEST + 1.0)
    costs = [
        float(least_squares(rest, logs, bounds=bounds, diff_step=[1e-3], max_nfev=12).cost)
        for logs in (plain, damped)
    ]
    return math.sqrt(2.0 * min(costs) / run.times.size)
