"""A sensor whose characteristic bends: a function of the displacement alone.

    measured = x + g S (h(z) - h(z_0)),   h(z) = atan(b z)/atan(b) - z,   z = 2 (x - x_c)/S

S: range moved; x_c: electrical centre, off the middle; z_0: z at x = 0. Source: the S-shaped error
of differential transformers and Hall sensors, e.g. J. Fraden, "Handbook of Modern Sensors". Not the
project's form: no polynomial.
"""

import math

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Centre x_c and range S [m], steepness b."""
    low, span = float(run.displacement.min()), float(np.ptp(run.displacement))
    return {
        "centre": low + float(rng.uniform(0.25, 0.75)) * span,
        "span": span,
        "b": float(rng.uniform(1.0, 2.5)),
    }


def bend(x: FloatArray, centre: float, span: float, b: float) -> FloatArray:
    """h, (N,) [1]: zero in the centre and half the range away from it."""
    z = 2.0 * (x - centre) / span
    return np.asarray(np.arctan(b * z) / math.atan(b) - z, dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Error of the sensor, (N,) [m], zero at x = 0."""
    centre, span, b = (parameters[name] for name in ("centre", "span", "b"))
    error = bend(run.displacement, centre, span, b) - bend(np.zeros(1), centre, span, b)
    return gain * span * error


SENSOR_NONLINEARITY = HiddenEffect(
    "sensor_nonlinearity",
    "g",
    "1",
    draw,
    contribution,
    plausible=(5e-4, 0.3),
    linear=True,
    of_sensor=True,
)
