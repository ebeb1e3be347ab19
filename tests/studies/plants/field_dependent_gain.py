"""A force for each volt that grows with the field: reversible growth and Rayleigh loops.

    F = g k_L u_r [ (1 - w) (u/u_r)^(1 + p) + w R(u)/u_r^2 ]
    dR = |u - u_last reversal| du   (closed loops are wiped out, memory.py)

u_r: rated voltage. Of the growth a share w comes from domain walls that move irreversibly: then the
gain grows with the amplitude and the loop with its square. Source: D. Damjanovic, "Ferroelectric,
dielectric and piezoelectric properties of ferroelectric thin films and ceramics", Rep. Prog. Phys.
61 (1998) 1267, Rayleigh law. Not the project's form: the power is not 2 and part of the growth
depends on the last reversal, not on the voltage.
"""

import numpy as np

from tests.studies.plants.base import Run, force_to_displacement
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.memory import with_memory
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Power p of the growth and irreversible share w."""
    del run
    return {"p": float(rng.uniform(0.7, 1.5)), "w": float(rng.uniform(0.2, 0.5))}


def rayleigh(voltage: FloatArray) -> FloatArray:
    """R [V^2], (M,): half the square of the distance from each reversal, added up."""
    return with_memory(voltage, lambda distance: 0.5 * distance**2)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement of the additional force; g is its growth over the rated voltage."""
    span, w = run.stack.u_rated, parameters["w"]
    u = run.path.voltage / span
    reversible = np.sign(u) * np.abs(u) ** (1.0 + parameters["p"])
    irreversible = rayleigh(run.path.path_voltage)[run.path.node] / span**2
    force = gain * run.stack.k_l * span * ((1.0 - w) * reversible + w * irreversible)
    return force_to_displacement(run.stack, force, run.fine_step)[:: run.sub_intervals]


FIELD_DEPENDENT_GAIN = HiddenEffect(
    "field_dependent_gain", "g", "1", draw, contribution, plausible=(1e-3, 0.4), linear=True
)
