"""Ascending and descending branches that curve differently, at every rate alike.

    df_H = A du - r^n (beta sgn(f_H) |du| + gamma du + g beta |du|) + delta u sgn(u') dt

The last loss, g beta r^n |du|, has one sign on both branches: domains that switch while the
voltage rises are lost at another rate than those that switch back, so the two envelopes lie at
different distances and are approached with different curvature. No time enters, so the shape is
the same at every rate. Source: J. Song and A. Der Kiureghian, "Generalized Bouc-Wen model for
highly asymmetric hysteresis", J. Eng. Mech. 132 (2006) 610 (their term beta_4 sgn(x')). Not the
project's form: it depends on the state of the hysteresis and not on the voltage, as `delta_r u
|u'|` does.
"""

import numpy as np

from tests.studies.plants.base import Run, force_to_displacement, hysteresis_force
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """Which branch loses more."""
    del run
    return {"branch": 1.0 if rng.integers(2) else -1.0}


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Displacement with minus without the branch-dependent loss, (N,) [m]; gain is g."""
    if gain == 0.0:
        return np.zeros_like(run.times)
    stack = run.stack
    branch = gain * parameters["branch"] * stack.beta
    force = hysteresis_force(stack, run.path, branch) + stack.k_l * run.path.voltage - run.force
    return force_to_displacement(stack, force, run.fine_step)[:: run.sub_intervals]


RATE_INDEPENDENT_ASYMMETRY = HiddenEffect(
    "rate_independent_asymmetry", "g", "1", draw, contribution, plausible=(0.01, 0.8), linear=False
)
