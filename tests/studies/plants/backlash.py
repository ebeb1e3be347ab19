"""Lost motion of fixed width between the stack and the output.

    x_out = max(x - g, min(x + g, x_out before))

A hard play operator in the displacement; g is half the gap. It dwells for 2 g after every reversal,
whatever the amplitude. Source: any text on mechanisms; G. Tao and P. V. Kokotovic, "Adaptive
Control of Systems with Actuator and Sensor Nonlinearities". Not the project's form: no smooth stop
element in series.
"""

import numpy as np

from tests.studies.plants.base import Run
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.hysteresis_memory import play
from tests.studies.plants.stack import FloatArray


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """A hard play has no secondary parameters."""
    del rng, run
    return {}


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Output minus stack, (N,) [m]; starts in the middle of the gap."""
    del parameters
    lost = play(run.fine_displacement, gain) - run.fine_displacement
    return lost[:: run.sub_intervals]


BACKLASH = HiddenEffect("backlash", "g", "m", draw, contribution, (1e-9, 3e-6), linear=False)
