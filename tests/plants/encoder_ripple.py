"""Foreign: the sub-divisional error of an optical encoder, periodic in the displacement.

    measured = x + g sin(2 pi x/L + phi)

L: grating signal period, about 2 um; g: a few percent of it. Source: J. R. R. Mayer,
"High-resolution of rotary encoder analog quadrature signals", IEEE Trans. Instrum. Meas. 43 (1994)
494 (ellipse errors). Over 5-20 periods no polynomial of the displacement follows it.
"""

import math

import numpy as np

from tests.plants.base import Run
from tests.plants.effect import HiddenEffect, Parameters
from tests.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Period and phase of the grating."""
    del run
    return {"period": float(rng.uniform(1.6e-6, 2.4e-6)), "phase": float(rng.uniform(0.0, 6.28))}


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Ripple at the samples, (N,) [m], zero at x = 0."""
    angle = 2.0 * math.pi * run.displacement / parameters["period"] + parameters["phase"]
    return np.asarray(gain * (np.sin(angle) - math.sin(parameters["phase"])), dtype=np.float64)


ENCODER_RIPPLE = HiddenEffect(
    "encoder_ripple", "g", "m", draw, contribution, (1e-9, 3e-7), linear=True, foreign=True
)
