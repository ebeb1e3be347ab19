"""The sub-divisional error of an optical encoder, periodic in the displacement.

    measured = x + g e(2 pi x/L + phi),   e(a) = arg(cos(a + c) + p + i ((1 + k) sin a + q)) - a

two signals with offsets p and q, unequal amplitudes k and a phase that is off by c; e has rms 1. L:
grating signal period, about 2 um; g: up to a few percent of it. Source: P. L. M. Heydemann,
"Determination and correction of quadrature fringe measurement errors in interferometers", Appl.
Opt. 20 (1981) 3382. Not the project's form: the angle of a bent circle, with all harmonics.
"""

import math

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Period and phase of the grating, errors of its signals."""
    del run
    return {
        "period": float(rng.uniform(1.6e-6, 2.4e-6)),
        "phase": float(rng.uniform(0.0, 6.28)),
        "p": float(rng.uniform(0.1, 0.3)),
        "q": float(rng.uniform(-0.3, 0.3)),
        "k": float(rng.uniform(-0.3, 0.3)),
        "c": float(rng.uniform(-0.3, 0.3)),
    }


def angle_error(angle: FloatArray, parameters: Parameters) -> FloatArray:
    """Error of the angle that the two signals tell [rad]."""
    first = np.cos(angle + parameters["c"]) + parameters["p"]
    second = (1.0 + parameters["k"]) * np.sin(angle) + parameters["q"]
    found = np.arctan2(second, first) - angle
    return np.asarray(found - 2.0 * math.pi * np.round(found / (2.0 * math.pi)), dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Ripple at the samples, (N,) [m], zero at x = 0."""
    once = angle_error(np.linspace(0.0, 2.0 * math.pi, 721)[:-1], parameters)
    angle = 2.0 * math.pi * run.displacement / parameters["period"] + parameters["phase"]
    rest = angle_error(np.array([parameters["phase"]]), parameters)
    return np.asarray(gain * (angle_error(angle, parameters) - rest) / np.std(once))


ENCODER_RIPPLE = HiddenEffect(
    "encoder_ripple", "g", "m", draw, contribution, (1e-9, 3e-7), linear=True,
    called="sensor_ripple", of_sensor=True,
)  # fmt: skip
