"""Compose components into one model: a table of variables and symbolic functions over it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.component import BALANCES, Component, Equations, Expression, Symbols
from psa_casadi.errors import InputError
from psa_casadi.variables import (
    Input,
    Output,
    Parameter,
    Provenance,
    State,
    nominal_value,
)


@dataclass(frozen=True, eq=False)
class Structure:
    """The equations of a composed model, without parameter values.

    `time`, `x`, `u`, `p` are the symbols (columns, in the order of the variable tables);
    `balances` maps each balance to its terms' sum with balances kept as symbols (for people);
    `xdot` and `y` have everything substituted (for machines).
    """

    components: tuple[Component, ...]
    parameters: tuple[Parameter, ...]
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    time: Expression
    x: Expression
    u: Expression
    p: Expression
    symbols: Mapping[str, Expression]
    balances: Mapping[str, Expression]
    der: Mapping[str, Expression]
    out: Mapping[str, Expression]
    xdot: Expression
    y: Expression

    @cached_property
    def f(self) -> ca.Function:
        """Casadi function `(time, x, u, p) -> (xdot, y)`; columns of nx, nu, np and nx, ny."""
        return ca.Function(
            "f",
            [self.time, self.x, self.u, self.p],
            [self.xdot, self.y],
            ["time", "x", "u", "p"],
            ["xdot", "y"],
        )


@dataclass(frozen=True)
class Model:
    """A composed model with parameter values (SI units) and where they come from."""

    structure: Structure
    values: Mapping[str, float]
    name: str = "psa"
    description: str = ""
    provenance: Provenance = field(default_factory=Provenance)

    @property
    def components(self) -> tuple[Component, ...]:
        """The components in the order of composition."""
        return self.structure.components

    @property
    def effects(self) -> tuple[Component, ...]:
        """The components that a gain can remove."""
        return tuple(c for c in self.components if c.gain is not None)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in the order of the state vector."""
        return tuple(s.name for s in self.structure.states)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the parameter vector."""
        return tuple(p.name for p in self.structure.parameters)

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
        raise InputError([f"The model has no parameter '{name}'; it has {self.parameter_names}."])

    def parameter_vector(self) -> npt.NDArray[np.float64]:
        """Return the values as a vector, shape (np,)."""
        return np.array([self.values[n] for n in self.parameter_names])

    def state_nominals(self) -> npt.NDArray[np.float64]:
        """Return the usual size of every state, shape (nx,)."""
        return np.array([nominal_value(s.nominal, self.values) for s in self.structure.states])

    def output_nominals(self) -> npt.NDArray[np.float64]:
        """Return the usual size of every output, shape (ny,)."""
        return np.array([nominal_value(o.nominal, self.values) for o in self.structure.outputs])

    def with_values(self, values: Mapping[str, float], **changes: object) -> "Model":
        """Return the model with some values replaced, each checked against its bounds."""
        merged = {**self.values, **{k: float(v) for k, v in values.items()}}
        _check_values(self.structure, merged)
        return replace(self, values=merged, **changes)  # type: ignore[arg-type]

    def with_components(self, components: Iterable[Component]) -> "Model":
        """Return a model of other components that keeps the values the two have in common."""
        structure = structure_of(tuple(components))
        values = {p.name: self.values.get(p.name, p.value) for p in structure.parameters}
        return replace(self, structure=structure, values=values)

    def with_effect(self, effect: Component, values: Mapping[str, float] | None = None) -> "Model":
        """Return the model with one more effect, at its default gain of 0 unless given."""
        if effect.name in (c.name for c in self.components):
            return self.with_values(values or {})
        return self.with_components((*self.components, effect)).with_values(values or {})

    def without(self, names: Iterable[str]) -> "Model":
        """Return the model without the named components."""
        gone = set(names)
        return self.with_components(c for c in self.components if c.name not in gone)

    def plant(self) -> "Model":
        """Return the model without sensor and environment: what an exported plant contains."""
        return self.without(
            c.name for c in self.components if c.belongs_to in ("sensor", "environment")
        )


def compose(
    components: Iterable[Component],
    values: Mapping[str, float] | None = None,
    *,
    name: str = "psa",
    description: str = "",
) -> Model:
    """Compose components to a model; values override the components' defaults (SI units).

    Raises InputError for a missing symbol, a name used twice, a loop among the balances, an
    unknown parameter or a value out of bounds.
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
            problems.append(f"The model has no parameter '{name}'; it has {sorted(known)}.")
            continue
        low, high = known[name].bounds
        if not low <= value <= high:
            problems.append(
                f"Parameter '{name}' is {value:g} {known[name].unit}, outside its bounds"
                f" [{low:g}, {high:g}]; choose a value inside."
            )
    if problems:
        raise InputError(problems)


@cache
def structure_of(components: tuple[Component, ...]) -> Structure:
    """Add up the components' terms, order the balances and substitute them."""
    parameters = tuple(p for c in components for p in c.parameters)
    states = tuple(s for c in components for s in c.states)
    inputs = tuple(i for c in components for i in c.inputs)
    outputs = tuple(o for c in components for o in c.outputs)
    _refuse_duplicates([v.name for v in (*parameters, *states, *inputs)])
    _refuse_duplicates([o.name for o in outputs])
    table = {v.name: ca.SX.sym(v.name) for v in (*parameters, *states, *inputs)}
    table["time"] = ca.SX.sym("time")
    balance_symbols = {name: ca.SX.sym(name) for name in BALANCES}
    parts = [_equations_of(c, Symbols({**table, **balance_symbols})) for c in components]
    balances = _sum_terms(parts, components)
    der = {k: v for e in parts for k, v in e.der.items()}
    out = {k: v for e in parts for k, v in e.out.items()}
    missing = [s.name for s in states if s.name not in der]
    if missing:
        raise InputError([f"State '{name}' has no derivative; declare it in `der`." for name in missing])
    full = _substitute_in_order(balances, balance_symbols)

    def resolve(expression: Expression) -> Expression:
        return ca.substitute([ca.SX(expression)], list(balance_symbols.values()), full)[0]

    x = ca.vertcat(*[table[s.name] for s in states])
    xdot = ca.vertcat(*[resolve(der[s.name]) for s in states])
    if "displacement" in balances:
        out["velocity"] = _time_derivative(
            resolve(balance_symbols["displacement"]), x, xdot, table["time"]
        )
    y = ca.vertcat(*[resolve(out[o.name]) for o in outputs])
    return Structure(
        components=components,
        parameters=parameters,
        states=states,
        inputs=inputs,
        outputs=outputs,
        time=table["time"],
        x=x,
        u=ca.vertcat(*[table[i.name] for i in inputs]),
        p=ca.vertcat(*[table[q.name] for q in parameters]),
        symbols={**table, **balance_symbols},
        balances=balances,
        der=der,
        out=out,
        xdot=xdot,
        y=y,
    )


def _refuse_duplicates(names: list[str]) -> None:
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise InputError(
            [f"Two components declare '{n}'; rename one or leave one out." for n in twice]
        )


def _equations_of(component: Component, symbols: Symbols) -> Equations:
    try:
        return component.equations(symbols)
    except AttributeError as error:
        raise InputError(
            [f"Component '{component.name}' cannot be composed: {error}; add the component that has it."]
        ) from error


def _sum_terms(
    parts: list[Equations], components: tuple[Component, ...]
) -> dict[str, Expression]:
    balances: dict[str, Expression] = {}
    for component, part in zip(components, parts, strict=True):
        for name, term in part.add.items():
            if name not in BALANCES:
                raise InputError(
                    [f"Component '{component.name}' adds to '{name}', which is no balance; "
                     f"the balances are {sorted(BALANCES)}."]
                )
            balances[name] = balances[name] + term if name in balances else ca.SX(term)
    return balances


def _substitute_in_order(
    balances: Mapping[str, Expression], symbols: Mapping[str, Expression]
) -> list[Expression]:
    """Substitute balances into each other until none is left; name the loop if there is one."""
    resolved: dict[str, Expression] = {n: ca.SX(0) for n in symbols if n not in balances}
    waiting = dict(balances)
    while waiting:
        ready = [
            name
            for name, expression in waiting.items()
            if not any(ca.depends_on(expression, symbols[other]) for other in waiting)
        ]
        if not ready:
            loop = " -> ".join(_find_loop(waiting, symbols))
            raise InputError(
                [f"The balances form a loop: {loop}; put a state between two of them."]
            )
        for name in ready:
            known = list(resolved)
            resolved[name] = ca.substitute(
                [waiting.pop(name)], [symbols[k] for k in known], [resolved[k] for k in known]
            )[0]
    return [resolved[name] for name in symbols]


def _find_loop(
    waiting: Mapping[str, Expression], symbols: Mapping[str, Expression]
) -> list[str]:
    """Follow dependencies until a name repeats; return the names from its first appearance on."""
    path = [next(iter(waiting))]
    while True:
        following = next(n for n in waiting if ca.depends_on(waiting[path[-1]], symbols[n]))
        if following in path:
            return [*path[path.index(following) :], following]
        path.append(following)


def _time_derivative(
    expression: Expression, x: Expression, xdot: Expression, time: Expression
) -> Expression:
    """Return d/dt of an expression in states and time."""
    return ca.jtimes(expression, x, xdot) + ca.jacobian(expression, time)
