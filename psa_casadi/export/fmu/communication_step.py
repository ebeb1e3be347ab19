"""How short a communication step must be where an importer holds the inputs over it.

A held signal is late by half a step h on average: an output that moves at the rate dy/dt errs by
h/2 |dy/dt|. So the step for an error of a share e of the range R follows from the signal alone,

    h = 2 e R / max |dy/dt|,  for a sine of frequency f over the whole range  h = 2 e / (pi f),

as long as h is short against what the model adds of its own: lags, resonances, the slope of a loop.
What it adds is measured on the reference run that the archive holds.

Source: Astrom and Wittenmark 1997, Computer-Controlled Systems (a hold delays by half a period).
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.export.fmu.reference_results import reference_inputs
from psa_casadi.model.compose import Model
from psa_casadi.simulation.stepper import run

FloatArray = npt.NDArray[np.float64]

#: Error that the step must meet, over the range of the output.
SHARE = 1e-3
#: Steps in a period of a sine over the whole range: pi / (2 SHARE), and a quarter more for a loop.
STEPS_PER_PERIOD = 2000
_FIRST, _MOST = 4, 64
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class HeldStep:
    """The step [s] with which an output's error on the reference run is `error` of its range.

    It is the longest one that divides the rows of the run and keeps the error within `SHARE`, or
    the shortest one tried where none does. `rate` is the steepest motion in ranges per second.
    """

    output: str
    step: float
    error: float
    rate: float


def held_step(model: Model) -> HeldStep | None:
    """Return the step for the displacement, or for the first output of a model that has none.

    None if the model has no input or no output, or the output does not move.
    """
    if not (model.input_names and model.output_names):
        return None
    output = "displacement" if "displacement" in model.output_names else model.output_names[0]
    column = model.output_names.index(output)
    times, inputs = reference_inputs(model)
    start = np.array([s.start for s in model.structure.states])
    truth = run(model, times, inputs, start, rtol=_TOLERANCE).y[:, column]
    span = float(np.ptp(truth))
    if span == 0.0:
        return None
    rate = float(np.max(np.abs(np.diff(truth)))) / float(times[1]) / span

    def error(parts: int) -> float:
        grid = np.linspace(times[0], times[-1], parts * (len(times) - 1) + 1)
        fine = np.array([np.interp(grid, times, c) for c in inputs.T]).T
        found = run(model, grid, fine, start, rtol=_TOLERANCE, hold="zero").y[::parts, column]
        return float(np.max(np.abs(found - truth))) / span

    parts, worst = _FIRST, error(_FIRST)
    wanted = min(_MOST, max(1, math.ceil(parts * worst / SHARE)))
    while wanted != parts:
        parts, worst = wanted, error(wanted)
        if worst > SHARE and parts < _MOST:
            wanted = min(_MOST, parts + max(1, parts // 8))
    return HeldStep(output, float(times[1]) / parts, worst, rate)
