"""Foreign: a sensor that changes its gain range at one level.

    measured = x (1 + g)  in the upper range,   x  in the lower range
    up when x > x_s + e,   down when x < x_s - e

The two ranges disagree by g (0.3-1 % in instruments that are adjusted, more in others), so the
reading jumps by g x_s; the level of return lies 2 e lower, so it is no function of the
displacement. Source: autoranging amplifiers, e.g. Keithley, "Low Level Measurements Handbook".
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Level x_s and half the distance of the two levels e [m]."""
    low, span = float(run.displacement.min()), float(np.ptp(run.displacement))
    level = low + float(rng.uniform(0.35, 0.65)) * span
    return {"level": level, "half": float(rng.uniform(0.02, 0.06)) * span}


def upper(x: FloatArray, level: float, half: float) -> FloatArray:
    """1 in the upper range, 0 in the lower one, (N,); starts in the lower range."""
    decided = (x > level + half) | (x < level - half)
    last = np.maximum.accumulate(np.where(decided, np.arange(x.size), -1))
    state = (last >= 0) & (x[np.maximum(last, 0)] > level)
    return np.asarray(state, dtype=np.float64)


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Error of the upper range at the samples, (N,) [m]."""
    x = run.displacement
    return gain * x * upper(x, parameters["level"], parameters["half"])


RANGE_SWITCH = HiddenEffect(
    "range_switch",
    "g",
    "1",
    draw,
    contribution,
    (1e-4, 0.03),
    linear=True,
    foreign=True,
    of_sensor=True,
)
"""Above 1 % only where the base absorbs most of it."""
