"""A mode of the structure around the stack that the base does not have.

    x_mode = g integral of h(t - s) x_f(s) ds,   x_f = (f_L + f_H)(1/k_P + 1/k_B)
    h(t) = w^2/w_d exp(-zeta w t) sin(w_d t)

by modal superposition: one complex pole p = -zeta w + i w_d on the fine grid, x_mode = g w^2/w_d
Im z, z' = p z + x_f. Source: modal superposition, e.g. D. J. Ewins, "Modal Testing". Not the
project's form: a convolution beside the stack driven by the force before the lag, not two more
states driven by the displacement.
"""

import math

import numpy as np

from tests.studies.plants.base import Run, first_order
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """A frequency in the band of the record (25 Hz to 0.2 of the sampling rate), damping 1-5 %."""
    rate = 1.0 / float(run.times[1] - run.times[0])
    frequency = math.exp(rng.uniform(math.log(min(25.0, 0.1 * rate)), math.log(0.2 * rate)))
    return {"frequency": float(frequency), "zeta": float(rng.uniform(0.01, 0.05))}


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement of the mode, (N,) [m]; g is its static share of the displacement."""
    omega, zeta = 2.0 * math.pi * parameters["frequency"], parameters["zeta"]
    damped = omega * math.sqrt(1.0 - zeta**2)
    drive = run.force * run.stack.compliance
    modal = first_order(complex(-zeta * omega, damped), drive, run.fine_step).imag
    return np.asarray(gain * omega**2 / damped * modal[:: run.sub_intervals], dtype=np.float64)


STRUCTURAL_MODE = HiddenEffect(
    "structural_mode", "g", "1", draw, contribution, plausible=(3e-4, 0.1), linear=True
)
