"""More memory, asymmetric: a generalised Prandtl-Ishlinskii loop, plays with their squares.

    F = g k_L sum_j w_j (p_j - u + b (p_j^2 - u^2)/u_rated),   sum_j w_j = 1

p_j: play operators of the voltage u with thresholds over 4 to 18 % of the span
(hysteresis_memory.py). Rising and falling branches differ more the higher the voltage, so that no
symmetric memory forms the loop. Not the project's form: hard operators, and every one of them has
an envelope of its own. Source: M. Al Janaideh, S. Rakheja, C.-Y. Su, "An analytical
generalized Prandtl-Ishlinskii model inversion for hysteresis compensation in micropositioning
control", IEEE/ASME Trans. Mechatronics 16 (2011) 734: envelope functions of the play; here 1 + b u.
"""

import numpy as np

from tests.studies.plants.base import Run, force_to_displacement
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.hysteresis_memory import COUNT, play
from tests.studies.plants.hysteresis_memory import draw as draw_plays
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Thresholds and weights of the plays, and the share b of their squares, 0.7 to 2."""
    return {**draw_plays(rng, run), "b": float(rng.uniform(0.7, 2.0))}


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement of the additional hysteretic force."""
    path, span = run.path.path_voltage, run.stack.u_rated
    total = np.zeros_like(path)
    for j in range(COUNT):
        p = play(path, parameters[f"r_{j}"])
        total += parameters[f"w_{j}"] * (p - path + parameters["b"] * (p**2 - path**2) / span)
    force = gain * run.stack.k_l * total[run.path.node]
    return force_to_displacement(run.stack, force, run.fine_step)[:: run.sub_intervals]


ASYMMETRIC_MEMORY = HiddenEffect(
    "asymmetric_memory",
    "g",
    "1",
    draw,
    contribution,
    (0.01, 0.6),
    linear=True,
    called="hysteresis_memory",
)
