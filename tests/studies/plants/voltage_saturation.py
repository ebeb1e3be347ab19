"""An amplifier whose supply is too low: the command is clipped hard before the drive.

    v -> min(v, v_max),   v_max = (1 - g) max(v)

The clipped command goes through drive, hysteresis and mechanics again. Source: data sheets. Not the
project's form: a corner, not a smooth limit, and before the drive.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.rerun import follow, moved


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """A hard clip has no secondary parameters."""
    del rng, run
    return {}


def driven(run: Run, parameters: Parameters, gain: float) -> Run:
    """The stack behind the clipped command; g is the share of the highest command that is cut."""
    del parameters
    highest = (1.0 - gain) * float(run.command.max())
    return follow(run, np.minimum(run.fine_command, highest))


contribution = moved(driven)
"""Displacement with the effect minus without it, (N,) [m]."""

VOLTAGE_SATURATION = HiddenEffect(
    "voltage_saturation", "g", "1", draw, contribution, (1e-3, 0.4), linear=False, driven=driven
)
