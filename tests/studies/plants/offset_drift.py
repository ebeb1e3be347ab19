"""A zero point that wanders, whatever the voltage does.

    x_drift = g D(s),  s = t/T from 0 to 1
    D = s + c (1 - exp(-s/q)),  |c| <= 0.3      or      D = s + e max(s - s_1, 0),  |e| <= 0.3

A ramp with a small saturating exponential, or a ramp whose slope changes once. Source: warming of
frames and interferometer paths. Not the project's form: not a straight line.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Direction, and the kind and size of the departure from a straight line."""
    del run
    direction = 1.0 if rng.integers(2) else -1.0
    if rng.integers(2):
        bend = {"exponential": float(rng.uniform(-0.3, 0.3)), "q": float(rng.uniform(0.2, 0.6))}
    else:
        bend = {"slope_change": float(rng.uniform(-0.3, 0.3)), "s_1": float(rng.uniform(0.3, 0.7))}
    return {"direction": direction, **bend}


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Drift at the samples, (N,) [m]; g is about the drift over the whole record [m]."""
    s = (run.times - run.times[0]) / float(run.times[-1] - run.times[0])
    if "q" in parameters:
        shape = s + parameters["exponential"] * (1.0 - np.exp(-s / parameters["q"]))
    else:
        shape = s + parameters["slope_change"] * np.maximum(s - parameters["s_1"], 0.0)
    return np.asarray(gain * parameters["direction"] * shape, dtype=np.float64)


OFFSET_DRIFT = HiddenEffect(
    "offset_drift",
    "g",
    "m",
    draw,
    contribution,
    plausible=(1e-9, 3e-6),
    linear=True,
    of_sensor=True,
)
