"""The bang-bang bound of a stack's linear part, written from the paper's letters alone.

    R_s C_p u' = G v - u,   tau f' = k_L u - f,   m_P y'' + c_P y' + k_P y = f,
    m_B x'' + c_B (x' - y') + k_B (x - y) = c_P y' + k_P y

The least time in which some voltage within its limits, held over each of many equal intervals,
takes this chain from rest to rest: a linear program, and halving.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.optimize import linprog

FloatArray = npt.NDArray[np.float64]


def bang_bang_bound(
    p: Mapping[str, float], begin: float, end: float, low: float, high: float, n: int = 300
) -> float:
    """Return the least time [s] of the linear part from `begin` to `end` [m], `low` to `high` [V].

    The voltage is held over n intervals, so the bound is that from above, by less than two of them.
    """
    a, b = _chain(p)
    level = -np.linalg.solve(a, b)
    size = level * (high - low)
    size[3] = size[2] * np.sqrt(p["k_P"] / p["m_P"])
    size[5] = size[4] * np.sqrt(p["k_B"] / p["m_B"])
    a, b, level = a * size / size[:, None], b / size, level / size
    gain = p["k_L"] * p["G"] * (1.0 / p["k_P"] + 1.0 / p["k_B"])
    first: FloatArray = np.asarray(level * begin / gain, dtype=float)
    last: FloatArray = np.asarray(level * end / gain, dtype=float)
    short, long = 0.0, 100.0 * float(np.max(1.0 / np.abs(np.linalg.eigvals(a))))
    while long - short > 1e-3 * long:
        middle = 0.5 * (short + long)
        if _possible(a, b, (first, last), (low, high), middle / n, n):
            long = middle
        else:
            short = middle
    return long


def _chain(p: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Return x' = a x + b v of u, f, y, y', x, x'."""
    drive, a = p["R_s"] * p["C_p"], np.zeros((6, 6))
    a[0, 0] = -1.0 / drive
    a[1, :2] = p["k_L"] / p["tau"], -1.0 / p["tau"]
    a[2, 3] = a[4, 5] = 1.0
    a[3, 1:4] = np.array([1.0, -p["k_P"], -p["c_P"]]) / p["m_P"]
    a[5, 2:] = np.array([p["k_P"] + p["k_B"], p["c_P"] + p["c_B"], -p["k_B"], -p["c_B"]]) / p["m_B"]
    return a, np.r_[p["G"] / drive, np.zeros(5)]


def _possible(
    a: FloatArray, b: FloatArray, ends: tuple[FloatArray, FloatArray],
    limits: tuple[float, float], h: float, n: int,
) -> bool:  # fmt: skip
    """Say whether some voltage takes the chain from one end to the other in n intervals h."""
    k = len(b)
    block = np.zeros((k + 1, k + 1))
    block[:k, :k], block[:k, k] = a * h, b * h
    power = expm(block)
    step, weights = power[:k, :k], [power[:k, k]]
    for _ in range(n - 1):
        weights.append(step @ weights[-1])
    left = ends[1] - np.linalg.matrix_power(step, n) @ ends[0]
    rows = np.hstack([np.array(weights[::-1]).T, np.eye(k), -np.eye(k)])
    bounds = [limits] * n + [(0.0, None)] * (2 * k)
    answer: Any = linprog(np.r_[np.zeros(n), np.ones(2 * k)], A_eq=rows, b_eq=left, bounds=bounds)
    return bool(answer.status == 0 and answer.fun < 1e-7)
