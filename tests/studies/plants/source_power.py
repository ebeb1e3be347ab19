"""Foreign: an optical sensor whose source flickers slowly: the gain of the reading wanders.

    measured = x (1 + g n(t)),   (T d/dt + 1)^2 n = white noise,   rms of n = 1

n is unrelated to the voltage: it comes and goes, so it is
neither ageing nor heat, and it vanishes at x = 0, so it is no drift. Source: relative intensity
noise of diodes in reflective sensors, e.g. K. Petermann, "Laser Diode Modulation and Noise".
"""

import math

import numpy as np
from scipy.signal import lfilter

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Correlation time T [s], 1-4 % of the record's length, and the seed of the noise."""
    length = float(run.times[-1] - run.times[0])
    return {"t": float(rng.uniform(0.01, 0.04)) * length, "seed": float(rng.integers(2**31))}


def flicker(times: FloatArray, constant: float, seed: int) -> FloatArray:
    """n at the samples, (N,) [1], stationary from the start, scaled to rms 1 and mean 0."""
    rng = np.random.default_rng(seed)
    decay = math.exp(-float(times[1] - times[0]) / constant)
    noise = rng.standard_normal(2 * times.size)
    slow = np.asarray(lfilter([1.0], [1.0, -2.0 * decay, decay**2], noise))[times.size :]
    slow = slow - slow.mean()
    return np.asarray(slow / np.std(slow), dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Error of the reading at the samples, (N,) [m]."""
    return gain * flicker(run.times, parameters["t"], int(parameters["seed"])) * run.displacement


SOURCE_POWER = HiddenEffect(
    "source_power",
    "g",
    "1",
    draw,
    contribution,
    (1e-4, 0.1),
    linear=True,
    foreign=True,
    random=True,
)
