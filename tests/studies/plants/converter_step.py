"""The major carry of a sensor's analogue-to-digital converter: its bits do not add up.

    measured = x + g (H(x - a) + c H(x - a + b) + c H(x - a - b)) - the same at x = 0

H is the unit step. Where all lower bits turn at once, at mid-scale a, the mismatch of the largest
bit shows as a jump; the next bit's at a quarter of the scale b below and above it. Source: W.
Kester (ed.), "The Data Conversion Handbook", Analog Devices (2005), 2.3 (static linearity, major
carry). Not the project's form: hard steps, and three of them.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Mid-scale and the distance of the next bit's steps [m], and their height over its."""
    low, span = float(run.displacement.min()), float(np.ptp(run.displacement))
    return {
        "mid": low + float(rng.uniform(0.25, 0.75)) * span,
        "quarter": float(rng.uniform(0.3, 0.6)) * span,
        "next": float(rng.uniform(-0.25, 0.25)),
    }


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Error of the reading at the samples, (N,) [m], zero at x = 0."""
    x = np.append(0.0, run.displacement)
    mid, quarter = parameters["mid"], parameters["quarter"]
    steps = (x > mid) + parameters["next"] * (
        (x > mid - quarter).astype(float) + (x > mid + quarter)
    )
    return np.asarray(gain * (steps - steps[0])[1:], dtype=np.float64)


CONVERTER_STEP = HiddenEffect(
    "converter_step", "g", "m", draw, contribution, (1e-9, 3e-7), linear=True,
    called="sensor_jump", of_sensor=True,
)  # fmt: skip
