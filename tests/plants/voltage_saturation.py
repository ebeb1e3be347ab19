"""An amplifier whose supply is too low: the command is clipped hard before the drive.

    v -> min(v, v_max),   v_max = (1 - g) max(v)

The clipped command goes through drive, hysteresis and mechanics again. Source: data sheets. Not the
project's form: a corner, not a smooth limit, and before the drive.
"""

import numpy as np

from tests.plants.base import Run
from tests.plants.effect import HiddenEffect, Parameters
from tests.plants.rerun import fine_command, moved_by
from tests.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """A hard clip has no secondary parameters."""
    del rng, run
    return {}


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Clipped minus unclipped displacement; g is the share of the highest command that is cut."""
    del parameters
    if gain == 0.0:
        return np.zeros_like(run.times)
    highest = (1.0 - gain) * float(run.command.max())
    return moved_by(run, np.minimum(fine_command(run), highest))


VOLTAGE_SATURATION = HiddenEffect(
    "voltage_saturation", "g", "1", draw, contribution, plausible=(1e-3, 0.4), linear=False
)
