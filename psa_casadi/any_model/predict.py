"""Predictions of any model with their derivatives, from its start, and the sizes in them.

x_0 = declared start + deviation for the states of the own equations and for memories; what is left,
filters of effects, starts where it would rest: g(x_s, x_0, u_0, p) = 0 with g its rates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.runs import Run, measured_spans
from psa_casadi.component import Component
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.unknowns import (
    LINEAR_PRIOR,
    LOG_PRIOR,
    Unknowns,
    memory_prior,
)
from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.stepper import SimulationError, Steps
from psa_casadi.simulation.stepper import run as simulate
from psa_casadi.variables import nominal_value

FloatArray = npt.NDArray[np.float64]

_NEWTON_STEPS = 8


@dataclass(frozen=True)
class Begun:
    """Initial state (nx,), its derivatives by parameters (nx, np) and by deviations (nx, nx)."""

    x: FloatArray
    by_parameter: FloatArray
    by_state: FloatArray


def resting_states(structure: Structure) -> tuple[str, ...]:
    """Return the states of effects that start where they would rest."""
    effects = [c for c in structure.components if c.gain is not None]
    return tuple(s.name for c in effects for s in c.states if not s.memory)


def start_of(model: Model, inputs: FloatArray, deviations: dict[str, float]) -> Begun:
    """Return the start for the first inputs (nu,) and deviations from the declared starts."""
    s = model.structure
    x = np.array([q.start + deviations.get(q.name, 0.0) for q in s.states])
    p, nx = model.parameter_vector(), len(s.states)
    by_p, by_x = np.zeros((nx, len(p))), np.eye(nx)
    resting = [k for k, q in enumerate(s.states) if q.name in resting_states(s)]
    if not resting:
        return Begun(x, by_p, by_x)
    rest = _rest(s)
    for _ in range(_NEWTON_STEPS):
        rates, slopes, _ = (np.array(a) for a in rest(0.0, x, inputs, p))
        move = np.linalg.lstsq(slopes[:, resting], -rates[:, 0], rcond=None)[0]
        x[resting] += move
        if np.max(np.abs(move) / np.maximum(np.abs(x[resting]), 1e-9)) < 1e-12:
            break
    _, slopes, by_parameter = (np.array(a) for a in rest(0.0, x, inputs, p))
    if not np.isfinite(x).all():
        raise SimulationError("The effects' states have no rest at the start; change the values.")
    others = [k for k in range(nx) if k not in resting]
    own = np.linalg.pinv(slopes[:, resting])
    by_p[resting] = -own @ by_parameter
    by_x[np.ix_(resting, others)] = -own @ slopes[:, others]
    by_x[np.ix_(resting, resting)] = 0.0
    return Begun(x, by_p, by_x)


@cache
def _rest(structure: Structure) -> ca.Function:
    """Casadi function (t, x, u, p) -> rates of the resting states, their slopes by x and by p."""
    names = resting_states(structure)
    rows = [k for k, s in enumerate(structure.states) if s.name in names]
    rates = structure.xdot[rows]
    return ca.Function(
        "rest",
        [structure.time, structure.x, structure.u, structure.p],
        [rates, *(ca.densify(structure.jacobian(rates, by)) for by in (structure.x, structure.p))],
    )


def zero_name(output: str) -> str:
    """Return the name of the coordinate that is an output's unknown zero."""
    return f"zero of {output}"


def coordinates_of(
    model: Model,
    free: Sequence[str],
    runs: Sequence[Run],
    zeros: Sequence[str] = (),
    *,
    known_start: bool = False,
) -> Unknowns:
    """Set up the coordinates around a model's values.

    Parameters on the scale that they declare; per experiment the initial states as deviations from
    the declared starts (unless these are known) over their usual size, and the zeros of sensors
    over the output's range.
    Weak priors: `LOG_PRIOR` and `LINEAR_PRIOR` for parameters, `LINEAR_PRIOR` usual sizes for
    states and zeros, `memory_prior` for memories of effects. The coordinate that a stack's fit has
    for its sensor's offset stays at 0.
    """
    s, values = model.structure, model.values
    parameters = [model.parameter(n) for n in free]
    log = np.array([p.log and values[p.name] > 0 for p in parameters], dtype=bool)
    memories = {q.name for c in model.effects for q in c.states if q.memory}
    names = memories if known_start else {q.name for q in s.states} - {*resting_states(s)}
    states = [q for q in s.states if q.name in names]
    spans = measured_spans(runs)
    sizes = [nominal_value(q.nominal, values) for q in states]
    sizes += [float(spans[model.output_names.index(n)]) or 1.0 for n in zeros]
    own = [memory_prior(q) if q.name in memories else LINEAR_PRIOR for q in states]
    own += [LINEAR_PRIOR] * len(zeros)
    started = (*(q.name for q in states), *(zero_name(n) for n in zeros))
    return Unknowns(
        names=tuple(free),
        started=tuple(started for _ in runs),
        reference=np.array([values[n] for n in free]),
        scale=np.array([p.typical(values) for p in parameters]),
        log=log,
        low=np.array([p.bounds[0] for p in parameters]),
        high=np.array([p.bounds[1] for p in parameters]),
        start_scale=tuple(np.array(sizes) for _ in runs),
        first_voltage=tuple(0.0 for _ in runs),
        compliance=0.0,
        offset_scale=1.0,
        prior=np.concatenate(
            [np.where(log, LOG_PRIOR, LINEAR_PRIOR), *([*own, 1.0] for _ in runs)]
        ),
    )


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
    steps = _steps(model, run, x0, run.stop, rtol, unknowns=unknowns, s0=s0, outputs=(output,))
    return steps.y[:, model.output_names.index(output)], steps.sensitivity[:, 0]


def shown_by(
    model: Model,
    run: Run,
    start: Mapping[str, float],
    stop: int,
    rtol: float,
    zeros: tuple[str, ...] = (),
) -> FloatArray:
    """Return all outputs (stop, ny) of one experiment, with sensors' zeros. Raises PsaError."""
    shown = _steps(model, run, start_of(model, run.inputs[0], dict(start)).x, stop, rtol).y.copy()
    for name in zeros:
        shown[:, model.output_names.index(name)] += start.get(zero_name(name), 0.0)
    return shown


def states_of(model: Model, run: Run, start: Mapping[str, float], rtol: float) -> FloatArray:
    """Return all states (n, nx) of one experiment. Raises PsaError."""
    return _steps(model, run, start_of(model, run.inputs[0], dict(start)).x, run.signals.n, rtol).x


def _steps(model: Model, run: Run, x0: FloatArray, stop: int, rtol: float, **wanted: Any) -> Steps:
    """Simulate the first samples of an experiment from a state."""
    return simulate(
        model, run.time[:stop], run.inputs[:stop], x0, rtol=rtol, hold=run.signals.hold,
        steps_limit=_STEPS, steps_most=_MEAN_STEPS * stop, **wanted,
    )  # fmt: skip


#: Tolerance of the first look at a model whose states' sizes are not known.
_LOOK_RTOL = 1e-9


@dataclass(frozen=True)
class Sizes:
    """The largest magnitudes of inputs, states, rates and outputs by name, and two times [s]."""

    inputs: Mapping[str, float]
    states: Mapping[str, float]
    rates: Mapping[str, float]
    outputs: Mapping[str, float]
    sample: float
    duration: float


def sizes_of(
    model: Model, runs: Sequence[Run], starts: Sequence[Mapping[str, float]] | None = None
) -> Sizes:
    """Return the sizes of a model's signals in experiments. Raises PsaError."""
    given = starts or [{} for _ in runs]
    tables = [states_of(model, r, s, _LOOK_RTOL) for r, s in zip(runs, given, strict=True)]
    f, p = _rates(model.structure), model.parameter_vector()
    rates, outputs = [], []
    for run, x in zip(runs, tables, strict=True):
        found = f.map(len(x))(run.time, x.T, run.inputs.T, np.tile(p[:, None], len(x)))
        rates.append(np.array(found[0]).T)
        outputs.append(np.array(found[1]).T)

    def largest(names: Sequence[str], parts: Sequence[FloatArray]) -> dict[str, float]:
        whole = np.max(np.abs(np.vstack(parts)), axis=0, initial=0.0)
        return {n: float(v) if v > 0 else 1.0 for n, v in zip(names, whole, strict=True)}

    return Sizes(
        inputs=largest(model.input_names, [r.inputs for r in runs]),
        states=largest(model.state_names, tables),
        rates=largest(model.state_names, rates),
        outputs=largest(model.output_names, outputs),
        sample=float(np.median(np.concatenate([np.diff(r.time) for r in runs]))),
        duration=max(float(r.time[-1]) for r in runs),
    )


def sized(model: Model, runs: Sequence[Run]) -> Model:
    """Return a model whose states of the plain size 1 have the size that they show in experiments.

    Where it cannot be simulated at its values, it stays as it is.
    """
    if not any(s.nominal == 1.0 for c in model.components for s in c.states):
        return model
    try:
        found = sizes_of(model, runs)
    except PsaError:
        return model
    return model.with_components(
        resized(c, tuple(found.states[s.name] for s in c.states)) for c in model.components
    )


@cache
def resized(component: Component, sizes: tuple[float, ...]) -> Component:
    """Return a component with other usual sizes of states that declare none; once for all."""
    states = tuple(
        replace(s, nominal=float(f"{size:.2g}")) if s.nominal == 1.0 else s
        for s, size in zip(component.states, sizes, strict=True)
    )
    return replace(component, states=states)


@cache
def _rates(structure: Structure) -> ca.Function:
    arguments = [structure.time, structure.x, structure.u, structure.p]
    return ca.Function("rates", arguments, [structure.xdot, structure.y])
