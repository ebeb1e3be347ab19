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

from tests.plants.base import Run, first_order
from tests.plants.effect import HiddenEffect, Parameters
from tests.plants.rerun import fine_command, moved_by
from tests.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """T [s] between 2 and 40 % of the record's length."""
    length = float(run.times[-1] - run.times[0])
    return {"t": length * math.exp(float(rng.uniform(math.log(0.02), math.log(0.4))))}


def droop(command: FloatArray, step: float, constant: float) -> FloatArray:
    """The low-pass w, (M,) [V]."""
    return first_order(-1.0 / constant + 0j, command, step).real / constant


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement with minus without the leak."""
    if gain == 0.0:
        return np.zeros_like(run.times)
    command = fine_command(run)
    return moved_by(run, command - gain * droop(command, run.fine_step, parameters["t"]))


CHARGE_LEAKAGE = HiddenEffect(
    "charge_leakage", "g", "1", draw, contribution, plausible=(5e-4, 0.9), linear=False
)
