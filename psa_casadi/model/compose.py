"""Compose components into one model: a table of variables with values, and its equations."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from psa_casadi.common.display import Celled
from psa_casadi.common.errors import InputError, quoted
from psa_casadi.common.units import FloatArray
from psa_casadi.model.component import Component, Expression
from psa_casadi.model.evidence import Evidence
from psa_casadi.model.structure import Structure, structure_of
from psa_casadi.model.variables import (
    Input,
    Parameter,
    Provenance,
    Publication,
    State,
    nominal_value,
)

__all__ = ["Model", "Structure", "compose"]


@dataclass(frozen=True, repr=False)
class Model(Celled):
    """A composed model with parameter values (SI units), their origin, and who publishes it.

    `evidence` speaks of these components with these values: a model with others has none, but the
    plant that an export takes out of it.
    """

    structure: Structure
    values: Mapping[str, float]
    name: str = "psa"
    description: str = ""
    provenance: Provenance = field(default_factory=Provenance)
    publication: Publication = field(default_factory=Publication)
    evidence: Evidence | None = None

    def __repr__(self) -> str:
        """Return name and composition in one line."""
        parts = ", ".join(c.name for c in self.components)
        return f"<Model '{self.name}': {parts}; {len(self.values)} parameters>"

    @property
    def components(self) -> tuple[Component, ...]:
        """The components in the order of composition."""
        return self.structure.components

    @property
    def base(self) -> tuple[Component, ...]:
        """The components that no gain can remove: the base physics."""
        return tuple(c for c in self.components if c.gain is None)

    @property
    def effects(self) -> tuple[Component, ...]:
        """The components that a gain can remove."""
        return tuple(c for c in self.components if c.gain is not None)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in the order of the state vector."""
        return tuple(s.name for s in self.structure.states)

    @property
    def sampled_names(self) -> tuple[str, ...]:
        """Names of the states that change at sample instants only, in the order of their vector."""
        return tuple(s.name for s in self.structure.sampled)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the parameter vector."""
        return self.structure.parameter_names

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs, in the order of the input vector."""
        return tuple(i.name for i in self.structure.inputs)

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs, in the order of the output vector."""
        return tuple(o.name for o in self.structure.outputs)

    def parameter(self, name: str) -> Parameter:
        """Return the declaration of one parameter."""
        for parameter in self.structure.parameters:
            if parameter.name == name:
                return parameter
        raise InputError(
            f"The model has no parameter '{name}'; it has {quoted(self.parameter_names)}."
        )

    def casadi(self) -> dict[str, Expression]:
        """Return the equations as CasADi names them: t, x, u, p, ode and y, columns of SX symbols.

        Rows are in the order of `state_names`, `input_names`, `parameter_names` and `output_names`,
        in SI units; `parameter_vector()` holds the values of p.

            dae = model.casadi()
            f = casadi.Function("f", [dae[k] for k in "xup"], [dae["ode"], dae["y"]])

        Raises:
            InputError: the model has states that change at sample instants only, which no such
                equations hold.
        """
        s = self.structure
        if s.sampled:
            raise InputError(
                f"The model '{self.name}' has states that change at sample instants only"
                f" ({', '.join(self.sampled_names)}); leave its sampled components out."
            )
        return {"t": s.time, "x": s.x, "u": s.u, "p": s.p, "ode": s.xdot, "y": s.y}

    def at_start(self) -> list[Any]:
        """Return the arguments of `structure.f` at the start: time, x, u, p, z if there is one."""
        s = self.structure
        x, u, z = ([v.start for v in group] for group in (s.states, s.inputs, s.sampled))
        return [0.0, x, u, self.parameter_vector(), *([z] if s.sampled else [])]

    def parameter_vector(self) -> FloatArray:
        """Return the values as a vector, shape (np,)."""
        return np.array([self.values[n] for n in self.parameter_names])

    def state_nominals(self) -> FloatArray:
        """Return the usual size of every state, shape (nx,)."""
        return np.array([nominal_value(s.nominal, self.values) for s in self.structure.states])

    def error_sizes(self) -> FloatArray:
        """Return the size against which an error of every state counts, shape (nx,)."""
        sizes = [s.nominal if s.whole is None else s.whole for s in self.structure.states]
        return np.array([nominal_value(size, self.values) for size in sizes])

    def output_nominals(self) -> FloatArray:
        """Return the usual size of every output, shape (ny,)."""
        return np.array([nominal_value(o.nominal, self.values) for o in self.structure.outputs])

    def with_values(self, values: Mapping[str, float], **changes: object) -> "Model":
        """Return the model with some values replaced, each checked against its bounds."""
        merged = {**self.values, **{k: float(v) for k, v in values.items()}}
        _check_values(self.structure, merged)
        if merged != self.values:
            changes.setdefault("evidence", None)
        # `changes` are fields of the model by name, which a type checker cannot match
        return replace(self, values=merged, **changes)  # type: ignore[arg-type]

    def with_components(self, components: Iterable[Component]) -> "Model":
        """Return a model of other components that keeps what the two have in common.

        Values of parameters, and starts that are not the declared ones.
        """
        structure = structure_of(tuple(components))
        values = {p.name: self.values.get(p.name, p.value) for p in structure.parameters}
        there = {v.name for v in _starting(structure)}
        kept = {n: v for n, v in self.changed_starts().items() if n in there}
        same = _in_plant(self.components) == _in_plant(structure.components)
        evidence = self.evidence.of_parameters(values) if self.evidence and same else None
        changed = replace(self, structure=structure, values=values, evidence=evidence)
        return changed.with_starts(kept)

    def changed_starts(self) -> dict[str, float]:
        """Return the starts of states and inputs that are not those their components declare."""
        declared = {v.name: v.start for c in self.components for v in _starting(c)}
        every = _starting(self.structure)
        return {v.name: v.start for v in every if v.start != declared.get(v.name, v.start)}

    @property
    def starts_itself(self) -> bool:
        """Whether it sets starts of states or of the voltage that its components do not declare."""
        return not {"voltage", *self.state_names}.isdisjoint(self.changed_starts())

    def with_declared_starts(self) -> "Model":
        """Return the model with the start values that its components declare."""
        values = self.changed_starts()
        return replace(self, structure=structure_of(self.components)) if values else self

    def with_starts(self, starts: Mapping[str, float]) -> "Model":
        """Return the model with other start values of states and inputs (SI units).

        They are what a simulation, an exported FMU and a Modelica package start from.
        Raises InputError for a name that is neither, or a value that is not finite.
        """
        if not starts:
            return self
        s = self.structure
        known = {v.name for v in _starting(s)}
        problems = [
            f"The model has no state or input '{n}' to start from; it has {quoted(sorted(known))}."
            if n not in known
            else f"The start of '{n}' is {v}; give a finite number."
            for n, v in starts.items()
            if n not in known or not np.isfinite(v)
        ]
        if problems:
            raise InputError(problems)
        return replace(self, structure=s.started(starts))

    def with_effect(self, effect: Component, values: Mapping[str, float] | None = None) -> "Model":
        """Return the model with one more effect, its gain 0 unless `values` has another."""
        if effect.name in (c.name for c in self.components):
            return self.with_values(values or {})
        return self.with_components((*self.components, effect)).with_values(values or {})

    def without(self, names: Iterable[str]) -> "Model":
        """Return the model without the named components."""
        gone = set(names)
        return self.with_components(c for c in self.components if c.name not in gone)

    def plant(self) -> "Model":
        """Return the model without sensor and environment: what an exported plant contains."""
        return self.without(c.name for c in self.components if not c.in_plant)


def _in_plant(components: Iterable[Component]) -> tuple[Component, ...]:
    return tuple(c for c in components if c.in_plant)


def _starting(of: Structure | Component) -> tuple[State | Input, ...]:
    return (*of.states, *of.inputs)


def compose(
    components: Iterable[Component],
    values: Mapping[str, float] | None = None,
    *,
    name: str = "psa",
    description: str = "",
) -> Model:
    """Compose components to a model; values override the components' defaults (SI units).

    Raises InputError for a missing symbol, a name used twice, a loop among the balances, sample
    periods that differ, an unknown parameter or a value out of bounds.
    """
    structure = structure_of(tuple(components))
    merged = {p.name: p.value for p in structure.parameters}
    merged.update({k: float(v) for k, v in (values or {}).items()})
    _check_values(structure, merged)
    return Model(structure, merged, name, description)


def _check_values(structure: Structure, values: Mapping[str, float]) -> None:
    problems = []
    known = {p.name: p for p in structure.parameters}
    for name, value in values.items():
        if name not in known:
            problems.append(f"The model has no parameter '{name}'; it has {quoted(sorted(known))}.")
            continue
        low, high = known[name].bounds
        if low > high or (known[name].log and low < 0.0):
            what = "are reversed" if low > high else "are negative, with log=True"
            problems.append(f"The bounds ({low:g}, {high:g}) of '{name}' {what}; correct them.")
        elif not low <= value <= high:
            problems.append(
                f"Parameter '{name}' is {value:g} {known[name].unit}, outside its bounds"
                f" [{low:g}, {high:g}]; choose a value inside."
            )
    if problems:
        raise InputError(problems)
