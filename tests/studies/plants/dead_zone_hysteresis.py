"""Foreign: hysteresis of the force only where a swing is larger than a threshold.

    R = R_r + d max(0, |u - u_r| - D)^2/2,   d = sgn(u'),  (u_r, R_r) the last reversal
    F = g k_L u_rated R/R(rated swing)

A Preisach operator whose density is zero where the two switching voltages differ by less than D and
uniform beyond (memory.py): small loops have none, large ones grow with the square. Source: I. D.
Mayergoyz, "Mathematical Models of Hysteresis", ch. 1.
"""

import numpy as np

from tests.studies.plants.base import Run, force_to_displacement
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.memory import with_memory
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Dead zone D [V], 35-55 % of the rated voltage."""
    return {"dead_zone": float(rng.uniform(0.35, 0.55)) * run.stack.u_rated}


def preisach(voltage: FloatArray, dead_zone: float) -> FloatArray:
    """R [V^2], (M,)."""
    return with_memory(voltage, lambda swing: 0.5 * np.maximum(0.0, swing - dead_zone) ** 2)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement of the additional force; g is its size over the linear force after a rated
    swing.
    """
    span, dead_zone = run.stack.u_rated, parameters["dead_zone"]
    operator = preisach(run.path.path_voltage, dead_zone)[run.path.node]
    force = gain * run.stack.k_l * span * operator / (0.5 * (span - dead_zone) ** 2)
    return force_to_displacement(run.stack, force, run.fine_step)[:: run.sub_intervals]


DEAD_ZONE_HYSTERESIS = HiddenEffect(
    "dead_zone_hysteresis", "g", "1", draw, contribution, (1e-3, 0.5), linear=True, foreign=True
)
