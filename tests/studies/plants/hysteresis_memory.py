"""More memory than one Bouc-Wen state can hold: parallel play operators.

    p_j(t) = max(u - r_j, min(u + r_j, p_j before))
    F = g k_L sum_j w_j (p_j - u),   sum_j w_j = 1

u: voltage on the stack; r_j: thresholds spread over 4 to 18 % of the span; the force goes through
lag and mechanics. Source: K. Kuhnen, "Modeling, identification and compensation of complex
hysteretic nonlinearities", Eur. J. Control 9 (2003) 407. Not the project's form: the operators are
hard (a corner at each threshold, wiped out exactly by larger reversals), not smooth stop elements
of Bouc-Wen type, and there are more of them than one would fit.
"""

import numpy as np

from tests.studies.plants.base import Run, force_to_displacement
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray

COUNT = 5


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Thresholds r_j [V] at random in equal bins between 4 and 18 % of the span, weights w_j that
    sum to 1.
    """
    edges = np.linspace(0.04, 0.18, COUNT + 1) * run.stack.u_rated
    weights = rng.uniform(0.5, 1.5, COUNT)
    weights /= weights.sum()
    parameters: dict[str, float] = {}
    for j in range(COUNT):
        parameters[f"r_{j}"] = float(rng.uniform(edges[j], edges[j + 1]))
        parameters[f"w_{j}"] = float(weights[j])
    return parameters


def play(voltage: FloatArray, threshold: float, start: float = 0.0) -> FloatArray:
    """Play operator, (M,) [V]: recursion at the turning points only, a clip between them."""
    direction = np.sign(np.diff(voltage))
    moving = np.flatnonzero(direction)
    turns = moving[1:][direction[moving[1:]] != direction[moving[:-1]]]
    bounds = np.concatenate(([0], turns, [voltage.size - 1])).astype(int)
    out = np.empty_like(voltage)
    state = float(min(max(start, voltage[0] - threshold), voltage[0] + threshold))
    for first, last in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        piece = voltage[first : last + 1]
        out[first : last + 1] = np.minimum(np.maximum(state, piece - threshold), piece + threshold)
        state = float(out[last])
    return out


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement of the additional hysteretic force."""
    path = run.path.path_voltage
    total = np.zeros_like(path)
    for j in range(COUNT):
        total += parameters[f"w_{j}"] * (play(path, parameters[f"r_{j}"]) - path)
    force = gain * run.stack.k_l * total[run.path.node]
    fine = force_to_displacement(run.stack, force, run.fine_step)
    return fine[:: run.sub_intervals]


HYSTERESIS_MEMORY = HiddenEffect(
    "hysteresis_memory", "g", "1", draw, contribution, plausible=(0.01, 0.6), linear=True
)
