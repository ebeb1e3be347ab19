"""Loops that widen with the rate: play operators whose thresholds grow with the logarithm of it.

    p_j = max(u - R_j, min(u + R_j, p_j before)),   R_j = r_j (1 + g lg(1 + |u'|/q))
    F = W k_L sum_j w_j (p_j with g - p_j with g = 0),   sum_j w_j = 1

u: voltage on the stack. Because p follows u at a distance, stroke falls as width grows. Source: M.
Al Janaideh, C.-Y. Su and S. Rakheja, "Development of the rate-dependent Prandtl-Ishlinskii model
for smart actuators", Smart Mater. Struct. 17 (2008) 035026 (logarithmic dynamic threshold). Not the
project's form: thresholds of hard operators, neither a lag before the hysteresis nor rates in the
coefficients of Bouc and Wen.
"""

import numpy as np

from tests.studies.plants.base import Run, force_to_displacement
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.hysteresis_memory import play
from tests.studies.plants.stack import FloatArray

COUNT = 3


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Thresholds r_j [V] between 4 and 25 % of the span, weights, rate q [V/s] where growth begins,
    and the share W of the force that plays.
    """
    span = run.stack.u_rated
    edges = np.linspace(0.04, 0.25, COUNT + 1) * span
    weights = rng.uniform(0.5, 1.5, COUNT)
    weights /= weights.sum()
    parameters = {
        "q": float(rng.uniform(0.3, 1.5)) * span,
        "share": float(rng.uniform(0.25, 0.45)),
    }
    for j in range(COUNT):
        parameters[f"r_{j}"] = float(rng.uniform(edges[j], edges[j + 1]))
        parameters[f"w_{j}"] = float(weights[j])
    return parameters


def moving_play(voltage: FloatArray, threshold: FloatArray) -> FloatArray:
    """Play operator whose threshold (M,) [V] changes on the way, from the relaxed state."""
    state, out = float(voltage[0]), []
    low, high = (voltage - threshold).tolist(), (voltage + threshold).tolist()
    for least, most in zip(low, high, strict=True):
        if state < least:
            state = least
        elif state > most:
            state = most
        out.append(state)
    return np.asarray(out)


def growth(rate: FloatArray, q: float) -> FloatArray:
    """lg(1 + |u'|/q), (M,) [1]."""
    return np.asarray(np.log10(1.0 + np.abs(rate) / q), dtype=np.float64)


def drive_rate(run: Run) -> FloatArray:
    """u' = (v - u)/(R_s C_p) along the path, 0 at every reversal, [V/s]."""
    command = np.interp(run.path.path_time, run.path.time, run.fine_command)
    return (command - run.path.path_voltage) / run.stack.drive_time


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement with minus without the growth of the thresholds; g is growth for each decade."""
    if gain == 0.0:
        return np.zeros_like(run.times)
    voltage = run.path.path_voltage
    wider = 1.0 + gain * growth(drive_rate(run), parameters["q"])
    total = np.zeros_like(voltage)
    for j in range(COUNT):
        threshold = parameters[f"r_{j}"]
        change = moving_play(voltage, threshold * wider) - play(voltage, threshold)
        total += parameters[f"w_{j}"] * change
    force = parameters["share"] * run.stack.k_l * total[run.path.node]
    return force_to_displacement(run.stack, force, run.fine_step)[:: run.sub_intervals]


RATE_DEPENDENT_HYSTERESIS = HiddenEffect(
    "rate_dependent_hysteresis", "g", "1", draw, contribution, (0.01, 0.6), linear=False
)
"""Growth of loop width for each decade of rate; 3 to 10 % of stroke has been measured."""
