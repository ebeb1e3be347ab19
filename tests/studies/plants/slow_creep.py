"""True logarithmic creep, superposed over the whole history of the elongation.

    x_creep(t) = g sum_j Dx(t_j) lg(1 + (t - t_j)/t_0)

Dx(t_j): increments of the base displacement; g: creep for each decade of time; t_0: where creep
begins. Source: H. Jung and D.-G. Gweon, "Creep characteristics of piezoelectric actuators", Rev.
Sci. Instrum. 71 (2000) 1896 (logarithmic law); superposition over the voltage history after L.
Boltzmann. Not the project's form: a sum of relaxations is a set of exponentials with a last time
constant, after which it stops; the logarithm is a continuous spectrum and never stops.
"""

import numpy as np
from scipy.signal import fftconvolve

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """t_0 between 0.05 and 0.1 s."""
    del run
    return {"t_0": float(rng.uniform(0.05, 0.1))}


def creep(times: FloatArray, elongation: FloatArray, t_0: float) -> FloatArray:
    """Creep for g = 1 at uniform times, (N,) [m]; each increment is placed in the middle of its
    interval.
    """
    step = float(times[1] - times[0])
    increments = np.diff(elongation)
    age = step * (np.arange(times.size - 1) + 0.5)
    kernel = np.log10(1.0 + age / t_0)
    return np.concatenate(([0.0], fftconvolve(increments, kernel)[: times.size - 1]))


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Creep of the base displacement."""
    return gain * creep(run.times, run.displacement, parameters["t_0"])


SLOW_CREEP = HiddenEffect(
    "slow_creep", "g", "1", draw, contribution, plausible=(0.003, 0.05), linear=True
)
