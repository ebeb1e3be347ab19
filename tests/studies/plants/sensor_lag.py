"""A sensor with a first-order low-pass.

    T m' + m = x

exact for a displacement that is linear on each sub-interval. g = T. Source: the bandwidth in the
data sheet of any capacitive or inductive sensor, 40 Hz to 8 kHz. Not the project's form: a
recursion on the finished displacement, no further state.
"""

import numpy as np

from tests.studies.plants.base import Run, first_order
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """A pole has no secondary parameters."""
    del rng, run
    return {}


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Filtered minus unfiltered displacement; g is the time constant [s]."""
    del parameters
    if gain == 0.0:
        return np.zeros_like(run.times)
    slow = first_order(-1.0 / gain + 0j, run.fine_displacement, run.fine_step).real / gain
    return np.asarray((slow - run.fine_displacement)[:: run.sub_intervals], dtype=np.float64)


SENSOR_LAG = HiddenEffect(
    "sensor_lag",
    "T",
    "s",
    draw,
    contribution,
    (2e-5, 4e-3),
    linear=False,
    refit=True,
    of_sensor=True,
)
"""A fit of R_s C_p and tau leaves 0.5 to 2 times the noise at most, at any T: often limited."""
