"""Hum of the mains with its third harmonic.

    x_hum = g (sin(w t + a) + b sin(3 w t + c)),   w = 2 pi 50 or 60 Hz, off by at most 0.1 %

Sampled at less than twice the frequency it appears as its alias, as it does in a real record.
Source: magnetising current of transformers, e.g. H. W. Ott, "Electromagnetic Compatibility
Engineering". Not the project's form: not a single line.
"""

import math

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Frequency [Hz], phases, third harmonic of 5-20 %."""
    del run
    mains = 50.0 if rng.integers(2) else 60.0
    return {
        "frequency": mains * (1.0 + 1e-3 * float(rng.uniform(-1.0, 1.0))),
        "a": float(rng.uniform(0.0, 2.0 * math.pi)),
        "b": float(rng.uniform(0.05, 0.2)),
        "c": float(rng.uniform(0.0, 2.0 * math.pi)),
    }


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Hum at the samples, (N,) [m]."""
    angle = 2.0 * math.pi * parameters["frequency"] * run.times
    third = parameters["b"] * np.sin(3.0 * angle + parameters["c"])
    return np.asarray(gain * (np.sin(angle + parameters["a"]) + third), dtype=np.float64)


MAINS_HUM = HiddenEffect(
    "mains_hum", "g", "m", draw, contribution, (1e-10, 3e-6), linear=True, of_sensor=True
)
