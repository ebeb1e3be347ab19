"""Foreign: the neighbouring axis of a stage moves too, and part of it is measured.

    x_cross = g (w - a (w - play(w, r))),   w: random-phase signal within a band, rms 1

w has 12 random frequencies between f_1 and f_2 (0.4 to 4 Hz in a record of some seconds), unrelated
to the voltage of this axis; the neighbour's own hysteresis is a play operator. Source: crosstalk of
parallel-kinematic stages, e.g. Y. K. Yong, S. O. R. Moheimani, B. J. Kenton and K. K. Leang, Rev.
Sci. Instrum. 83 (2012) 121101.
"""

import math

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.hysteresis_memory import play
from tests.studies.plants.stack import FloatArray

LINES = 12


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Band [Hz], threshold r and share a of the play, seed of frequencies and phases."""
    length = float(run.times[-1] - run.times[0])
    return {
        "f_1": float(rng.uniform(3.0, 6.0)) / length,
        "f_2": float(rng.uniform(15.0, 30.0)) / length,
        "r": float(rng.uniform(0.3, 0.8)),
        "a": float(rng.uniform(0.2, 0.5)),
        "seed": float(rng.integers(2**31)),
    }


def neighbour(times: FloatArray, parameters: Parameters) -> FloatArray:
    """w, (N,) [1]."""
    rng = np.random.default_rng(int(parameters["seed"]))
    frequency = rng.uniform(parameters["f_1"], parameters["f_2"], LINES)
    phase = rng.uniform(0.0, 2.0 * math.pi, LINES)
    waves = np.sin(2.0 * math.pi * np.outer(frequency, times) + phase[:, None])
    return np.asarray(waves.sum(axis=0) / math.sqrt(0.5 * LINES), dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Crosstalk at the samples, (N,) [m]."""
    w = neighbour(run.times, parameters)
    lag = w - play(w, parameters["r"], float(w[0]))
    return np.asarray(gain * (w - parameters["a"] * lag), dtype=np.float64)


CROSS_AXIS = HiddenEffect(
    "cross_axis", "g", "m", draw, contribution, (1e-9, 3e-6), linear=True, foreign=True, random=True
)
