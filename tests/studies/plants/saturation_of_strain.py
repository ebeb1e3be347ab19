"""Strain that saturates once most domains are turned: the linear force bends over.

    f_L = k_L u / (1 + |g u/u_r|^p)^(1/p)

u_r: rated voltage; u_r/g: voltage at which the tangent at zero would reach saturation. Source: the
Froehlich-Kennelly law of saturation, A. E. Kennelly, Trans. AIEE 8 (1891) 485, for polarisation
instead of magnetisation. Not the project's form: neither a polynomial nor tanh.
"""

import numpy as np

from tests.studies.plants.base import Run, force_to_displacement
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Sharpness p of the bend."""
    del run
    return {"p": float(rng.uniform(1.8, 4.0))}


def bend(u: FloatArray, p: float) -> FloatArray:
    """u / (1 + |u|^p)^(1/p): slope 1 at zero, limit 1."""
    return np.asarray(u / (1.0 + np.abs(u) ** p) ** (1.0 / p), dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement lost to saturation, (N,) [m]."""
    if gain == 0.0:
        return np.zeros_like(run.times)
    scale = run.stack.u_rated / gain
    u = run.path.voltage
    force = run.stack.k_l * (scale * bend(u / scale, parameters["p"]) - u)
    return force_to_displacement(run.stack, force, run.fine_step)[:: run.sub_intervals]


SATURATION_OF_STRAIN = HiddenEffect(
    "saturation_of_strain", "g", "1", draw, contribution, plausible=(0.05, 1.0), linear=False
)
