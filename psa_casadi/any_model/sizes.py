"""How large the signals of a model are in given experiments: what effects and solvers need."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.predict import states_of
from psa_casadi.any_model.runs import Run
from psa_casadi.component import Component
from psa_casadi.errors import PsaError
from psa_casadi.model.compose import Model, Structure

FloatArray = npt.NDArray[np.float64]

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
