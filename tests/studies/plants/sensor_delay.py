"""A sensor that reports late by a pure delay.

    measured(t) = x(t - d)

by cubic interpolation of the displacement on the fine grid (x = 0 before the record). Source: none
needed; e.g. the output filter and bus of a digital interferometer. Not the project's form: a
shift, not a Padé fraction.
"""

import numpy as np
from scipy.interpolate import CubicSpline

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """A delay has no secondary parameters."""
    del rng, run
    return {}


def delayed(time: FloatArray, signal: FloatArray, times: FloatArray, delay: float) -> FloatArray:
    """`signal`, given on the fine grid `time`, read at `times - delay`; its first value before the
    start.
    """
    spline = CubicSpline(time, signal)
    return np.asarray(spline(np.maximum(times - delay, time[0])), dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Delayed minus undelayed displacement; gain is the delay [s]."""
    del parameters
    if gain == 0.0:
        return np.zeros_like(run.times)
    return delayed(run.path.time, run.fine_displacement, run.times, gain) - run.displacement


SENSOR_DELAY = HiddenEffect(
    "sensor_delay",
    "d",
    "s",
    draw,
    contribution,
    plausible=(2e-5, 1e-2),
    linear=False,
    of_sensor=True,
)
