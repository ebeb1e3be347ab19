"""The sizes of a model's signals in its records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import casadi as ca
import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.symbolic import in_turn
from psa_casadi.common.units import FloatArray
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model, Structure
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.start import start_for
from psa_casadi.simulation.stepper import Steps, run

#: Steps between two samples, and mean ones of a record, beyond which a run is abandoned.
_STEPS, _MEAN_STEPS = 3000, 200


def states_of(model: Model, e: Experiment, start: Mapping[str, float], rtol: float) -> FloatArray:
    """Return all states (n, nx) of one experiment. Raises PsaError."""
    return _course(model, e, start, rtol).x


def _course(model: Model, e: Experiment, start: Mapping[str, float], rtol: float) -> Steps:
    t, u = e.record.time - e.record.time[0], record_inputs(model, e.record, e.record.n)
    x0 = start_for(model, t, u, start).x
    return run(
        model, t, u, x0, rtol=rtol, hold=e.record.hold,
        steps_limit=_STEPS, steps_most=_MEAN_STEPS * e.record.n,
    )  # fmt: skip


#: Tolerance of the first look at a model whose states' sizes are not known.
_LOOK_RTOL = 1e-9


@dataclass(frozen=True)
class Sizes:
    """The largest magnitudes of signals and of rates by name, and two times [s].

    `signals` are inputs, states, outputs and intermediates; `rates` those of states and, while the
    inputs rest, of intermediates.
    """

    signals: Mapping[str, float]
    rates: Mapping[str, float]
    sample: float
    duration: float


def sizes_of(
    model: Model,
    experiments: Sequence[Experiment],
    starts: Sequence[Mapping[str, float]] | None = None,
) -> Sizes:
    """Return the sizes of a model's signals in experiments. Raises PsaError."""
    pairs = zip(experiments, starts or [{} for _ in experiments], strict=True)
    courses = [_course(model, e, s, _LOOK_RTOL) for e, s in pairs]
    states, outputs = [c.x for c in courses], [c.y for c in courses]
    inputs = [record_inputs(model, e.record, e.record.n) for e in experiments]
    f, p = _rates(model.structure), model.parameter_vector()
    courses_of_rates = []
    for e, u, x in zip(experiments, inputs, states, strict=True):
        time = e.record.time - e.record.time[0]
        courses_of_rates.append(f.map(len(x))(time, x.T, u.T, np.tile(p[:, None], len(x))))
    rates, sums, changes = (
        [np.array(part).T for part in parts] for parts in zip(*courses_of_rates, strict=True)
    )

    def largest(names: Sequence[str], parts: Sequence[FloatArray]) -> dict[str, float]:
        whole = np.max(np.abs(np.vstack(parts)), axis=0, initial=0.0)
        return {n: float(v) if v > 0 else 1.0 for n, v in zip(names, whole, strict=True)}

    return Sizes(
        signals={
            **largest(model.input_names, inputs),
            **largest(model.state_names, states),
            **largest(model.output_names, outputs),
            **largest(_sums(model.structure), sums),
        },
        rates={
            **largest(model.state_names, rates),
            **largest(_sums(model.structure), changes),
        },
        sample=float(np.median(np.concatenate([np.diff(e.record.time) for e in experiments]))),
        duration=max(e.record.duration for e in experiments),
    )


def sized(model: Model, experiments: Sequence[Experiment]) -> Model:
    """Return a model whose states of the plain size 1 have the size that they show in experiments.

    Where it cannot be simulated at its values, it stays as it is.
    """
    if not any(s.nominal == 1.0 for c in model.components for s in c.states):
        return model
    try:
        sizes = sizes_of(model, experiments)
    except PsaError:
        return model
    return model.with_components(
        resized(c, tuple(sizes.signals[s.name] for s in c.states)) for c in model.components
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
@in_turn
def _rates(structure: Structure) -> ca.Function:
    arguments = [structure.time, structure.x, structure.u, structure.p]
    sums = ca.vertcat(ca.SX(0, 1), *(structure.sums[n] for n in _sums(structure)))
    changes = ca.jtimes(sums, structure.x, structure.xdot)
    return ca.Function("rates", arguments, [structure.xdot, sums, changes])


def _sums(structure: Structure) -> list[str]:
    return [b.name for c in structure.components for b in c.balances]
