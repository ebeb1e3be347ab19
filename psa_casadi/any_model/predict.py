"""Predictions of any model for an experiment, and their exact derivatives."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.coordinates import zero_name
from psa_casadi.any_model.runs import Run
from psa_casadi.any_model.start import start_of
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.simulation.stepper import run as simulate

FloatArray = npt.NDArray[np.float64]

#: Tolerance of a step in fits, over the states' usual sizes.
STEP_RTOL = 1e-6
#: Steps between two samples, and mean ones of a record, beyond which a trial point has failed.
_STEPS, _MEAN_STEPS = 3000, 200


def output_of(
    model: Model,
    run: Run,
    unknowns: Unknowns,
    theta: FloatArray,
    index: int,
    output: int,
    rtol: float,
) -> tuple[FloatArray, FloatArray]:
    """Return one output (stop,) of one experiment and its derivatives by theta (stop, size)."""
    current = model.with_values(unknowns.values(theta))
    name, searched = model.output_names[output], unknowns.start(theta, index)
    states = [n for n in unknowns.started[index] if n in model.state_names]
    begun = start_of(current, run.inputs[0], searched)
    columns = [model.parameter_names.index(n) for n in unknowns.names]
    which = [model.state_names.index(n) for n in states]
    shown, slopes = traced(
        current, run, begun.x, [*unknowns.names, *which],
        np.hstack([begun.by_parameter[:, columns], begun.by_state[:, which]]), name, rtol,
    )  # fmt: skip
    by_theta = np.zeros((len(shown), unknowns.size))
    count, first = len(unknowns.names), unknowns.first(index)
    by_theta[:, :count] = slopes[:, :count] @ unknowns.slopes(theta)
    scale = unknowns.start_scale[index]
    for k, n in enumerate(unknowns.started[index]):
        if n in states:
            by_theta[:, first + k] = slopes[:, count + states.index(n)] * scale[k]
        elif n == zero_name(name):
            by_theta[:, first + k] = scale[k]
    return shown + searched.get(zero_name(name), 0.0), by_theta


def traced(
    model: Model,
    run: Run,
    x0: FloatArray,
    unknowns: list[str | int],
    s0: FloatArray,
    output: str,
    rtol: float,
) -> tuple[FloatArray, FloatArray]:
    """Return one output (stop,) and its derivatives (stop, k) by parameters or initial states."""
    steps = simulate(
        model, run.time[: run.stop], run.inputs[: run.stop], x0,
        rtol=rtol, hold=run.signals.hold, unknowns=unknowns, s0=s0, output=output,
        steps_limit=_STEPS, steps_most=_MEAN_STEPS * run.stop,
    )  # fmt: skip
    none = np.zeros((run.stop, 0))
    slopes = none if steps.sensitivity is None else steps.sensitivity
    return steps.y[:, model.output_names.index(output)], slopes


def shown_by(
    model: Model,
    run: Run,
    start: Mapping[str, float],
    stop: int,
    rtol: float,
    zeros: tuple[str, ...] = (),
) -> FloatArray:
    """Return all outputs (stop, ny) of one experiment, with sensors' zeros. Raises PsaError."""
    begun = start_of(model, run.inputs[0], dict(start))
    steps = simulate(
        model, run.time[:stop], run.inputs[:stop], begun.x, rtol=rtol, hold=run.signals.hold,
        steps_limit=_STEPS, steps_most=_MEAN_STEPS * stop,
    )  # fmt: skip
    shown = steps.y.copy()
    for name in zeros:
        shown[:, model.output_names.index(name)] += start.get(zero_name(name), 0.0)
    return shown


def states_of(model: Model, run: Run, start: Mapping[str, float], rtol: float) -> FloatArray:
    """Return all states (n, nx) of one experiment. Raises PsaError."""
    begun = start_of(model, run.inputs[0], dict(start))
    return simulate(
        model, run.time, run.inputs, begun.x, rtol=rtol, hold=run.signals.hold,
        steps_limit=_STEPS, steps_most=_MEAN_STEPS * run.signals.n,
    ).x  # fmt: skip
