"""Charge that leaks away: the voltage on the stack droops behind a first-order high-pass.

    v -> v - g w,   T w' + w = v

g: share of the charge that leaks in the end; T = R C of insulation and coupling capacitor. Exact
for a command that is linear between samples; the result goes through drive, hysteresis and
mechanics again. Source: charge amplifiers, e.g. A. J. Fleming and S. O. R. Moheimani, "A
grounded-load charge amplifier for reducing hysteresis in piezoelectric tube scanners", Rev. Sci.
Instrum. 76 (2005) 073707. Not the project's form: a mix of the command with its low-pass, no
balance of charge.
"""

import math

import numpy as np

from tests.studies.plants.base import Run, first_order
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.rerun import follow, moved
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """T [s] between 2 and 40 % of the record's length."""
    length = float(run.times[-1] - run.times[0])
    return {"t": length * math.exp(float(rng.uniform(math.log(0.02), math.log(0.4))))}


def droop(command: FloatArray, step: float, constant: float) -> FloatArray:
    """The low-pass w, (M,) [V]."""
    return first_order(-1.0 / constant + 0j, command, step).real / constant


def driven(run: Run, parameters: Parameters, gain: float) -> Run:
    """The stack behind the leak."""
    command = run.fine_command
    return follow(run, command - gain * droop(command, run.fine_step, parameters["t"]))


contribution = moved(driven)
"""Displacement with the effect minus without it, (N,) [m]."""

CHARGE_LEAKAGE = HiddenEffect(
    "charge_leakage", "g", "1", draw, contribution, (5e-4, 0.9), linear=False, driven=driven
)
