"""Several effects in one record: each acts on what those before it have left.

    command -> effects of the drive -> stack and its effects -> effects of the sensor -> reading

A sum of what each adds to the base alone is no device where they are large: a lag or a delay that a
base model takes over nearly as a whole may add forty times the noise, and two of them, summed, let
a step begin the other way.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray

Effect = tuple[HiddenEffect, Parameters, float]
"""An effect with its secondary parameters and its gain, SI."""


def added_by(run: Run, effects: Sequence[Effect]) -> FloatArray:
    """What the effects add to the displacement of a run together, (N,) [m].

    Those of one place act in the order given. Between the samples an effect of stack or sensor is
    a cubic spline.
    """
    total = np.zeros_like(run.times)
    for effect, parameters, gain in sorted(effects, key=lambda e: _place(e[0])):
        own = effect.contribution(run, parameters, gain)
        total = total + own
        if effect.driven is not None:
            run = run if gain == 0.0 else effect.driven(run, parameters, gain)
            continue
        between = CubicSpline(run.times, own)(run.path.time)
        run = replace(run, fine_displacement=run.fine_displacement + between)
    return total


def _place(effect: HiddenEffect) -> int:
    return 0 if effect.driven is not None else 2 if effect.of_sensor else 1
