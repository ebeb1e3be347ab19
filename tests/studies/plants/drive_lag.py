"""An amplifier of second order between command and drive.

    T^2 v_f'' + 2 zeta T v_f' + v_f = v

by one complex pole p = (-zeta + i sqrt(1 - zeta^2))/T, exact for a command that is linear between
samples: v_f = Im z/(T sqrt(1 - zeta^2)), z' = p z + v. The filtered command goes through drive,
hysteresis and mechanics again. g = T. A single pole would do for the physics, but no record shows
it: a larger R_s C_p takes it over to within a tenth of the noise. Source: error amplifier and
output filter of any piezo amplifier with a capacitive load; bandwidth 40 Hz to 8 kHz in data
sheets. Not the project's form: one complex pair, no further state in the balance of the drive.
"""

import math

import numpy as np

from tests.studies.plants.base import Run, first_order
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.rerun import follow, moved
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Damping: little or no overshoot."""
    del run
    return {"zeta": float(rng.uniform(0.7, 0.95))}


def filtered(command: FloatArray, step: float, constant: float, zeta: float) -> FloatArray:
    """v_f on the fine grid, (M,) [V]."""
    damped = math.sqrt(1.0 - zeta**2)
    pole = complex(-zeta, damped) / constant
    return first_order(pole, command, step).imag / (constant * damped)


def driven(run: Run, parameters: Parameters, gain: float) -> Run:
    """The stack behind the filter; g is its time constant [s]."""
    return follow(run, filtered(run.fine_command, run.fine_step, gain, parameters["zeta"]))


contribution = moved(driven)
"""Displacement with the effect minus without it, (N,) [m]."""

DRIVE_LAG = HiddenEffect(
    "drive_lag",
    "T",
    "s",
    draw,
    contribution,
    (2e-5, 4e-3),
    linear=False,
    refit=True,
    driven=driven,
)
