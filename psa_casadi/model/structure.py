"""The equations of a composed model: the components' terms added up, ordered and substituted."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import casadi as ca

from psa_casadi.common.errors import InputError, Problems, quoted
from psa_casadi.common.symbolic import in_turn
from psa_casadi.model.component import (
    BALANCES,
    Balance,
    Component,
    Equations,
    Expression,
    Foreign,
    Symbols,
)
from psa_casadi.model.variables import Input, Output, Parameter, State


def refuse_duplicates(components: tuple[Component, ...], symbols: list[str]) -> None:
    """Symbols share one name space with the balances and time, outputs have a separate one."""
    outputs = [o.name for c in components for o in c.outputs]
    problems = Problems()
    for names in (symbols, outputs):
        for name in sorted({n for n in names if names.count(n) > 1}):
            problems.add(f"Two components declare '{name}'; rename one or leave one out.")
    balances = [b.name for c in components for b in c.balances]
    for name in sorted({n for n in balances if n in BALANCES or balances.count(n) > 1}):
        problems.add(f"The balance '{name}' is declared more than once; rename one.")
    for name in sorted({*balances, "time"}.intersection(symbols)):
        problems.add(f"A component declares '{name}', the name of a balance or of time; rename it.")
    problems.raise_if_any()


def sample_period(components: tuple[Component, ...]) -> str | None:
    """Return the parameter that is the period of all sampled components; None without any."""
    parameters = {p.name: p for c in components for p in c.parameters}
    problems, users = Problems(), [c for c in components if c.sampled or c.sample_period]
    for c in users:
        if not c.sampled or c.sample_period is None:
            problems.add(
                f"Component '{c.name}' declares only one of sampled states and a sample period;"
                " declare both or none."
            )
        elif c.sample_period not in parameters:
            problems.add(
                f"The sample period '{c.sample_period}' of component '{c.name}' is no parameter of"
                " the model; declare it, or add the component that does."
            )
        elif not parameters[c.sample_period].bounds[0] > 0.0:
            problems.add(
                f"The sample period '{c.sample_period}' may be 0 by its bounds"
                f" {parameters[c.sample_period].bounds}; give it a lower bound above 0."
            )
    periods = sorted({c.sample_period for c in users if c.sample_period})
    if len(periods) > 1:
        problems.add(
            f"The sampled components have different periods ({', '.join(periods)}), but a model has"
            " one clock; let all of them name the same parameter."
        )
    problems.raise_if_any()
    return periods[0] if periods else None


def check_declarations(component: Component, equations: Equations) -> None:
    """A component gives what it declares and nothing else; velocity follows from displacement."""
    derived = {"velocity"} - set(equations.out)
    outputs = {o.name for o in component.outputs} - derived
    problems = Problems()
    for kind, declared, present in (
        ("derivative of the state", {s.name for s in component.states}, set(equations.der)),
        ("equation of the output", outputs, set(equations.out)),
        ("next value of the sampled state", {s.name for s in component.sampled}, {*equations.next}),
    ):
        for name in sorted(declared - present):
            problems.add(f"Component '{component.name}' lacks the {kind} '{name}'; declare it.")
        for name in sorted(present - declared):
            problems.add(
                f"Component '{component.name}' has the {kind} '{name}', which it does not declare;"
                " add a term to a balance instead, or declare it."
            )
    problems.raise_if_any()


@dataclass(frozen=True, eq=False)
class Structure:
    """The equations of a composed model, without parameter values.

    `time`, `x`, `u`, `p` are the symbols (columns, in the order of the variable tables);
    `balances` maps each balance to its terms' sum with balances kept as symbols (for people);
    `sums` (the same), `xdot`, `y` and `switches` (zero where xdot has a kink) have everything
    substituted (for machines).

    `z` are the sampled states, constant but for the instants k T of the parameter `period`, T [s];
    there they take the value `znext`, in which `z` are their values before the instant
    (`next` is the same with balances kept as symbols).
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
    sums: Mapping[str, Expression]
    der: Mapping[str, Expression]
    out: Mapping[str, Expression]
    xdot: Expression
    y: Expression
    switches: Mapping[str, Expression]
    sampled: tuple[State, ...]
    period: str | None
    z: Expression
    next: Mapping[str, Expression]
    znext: Expression

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle the components and the starts: the equations are composed again from them."""
        starts = {q.name: q.start for q in self.states} | {i.name: i.start for i in self.inputs}
        return _composed, (self.components, starts)

    def started(self, starts: Mapping[str, float]) -> "Structure":
        """Return the same with other starts of states and inputs; itself where none differs."""
        states = tuple(replace(q, start=float(starts.get(q.name, q.start))) for q in self.states)
        inputs = tuple(replace(q, start=float(starts.get(q.name, q.start))) for q in self.inputs)
        same = (states, inputs) == (self.states, self.inputs)
        return self if same else replace(self, states=states, inputs=inputs)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of their vector; every run reads them."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def balance_table(self) -> dict[str, Balance]:
        """The sums that components may add to, by name: of every model, then of the components."""
        return _balance_table(self.components)

    @cached_property
    def foreign(self) -> tuple[Foreign, ...]:
        """The compiled functions that the equations call: of imported FMUs."""
        table = {c.foreign.name: c.foreign for c in self.components if c.foreign}
        return tuple(table.values())

    @cached_property
    def played(self) -> Any:
        """What is run as a whole in the place of equations: an FMU. None without one."""
        return next((c.played for c in self.components if c.played is not None), None)

    def jacobian(self, of: Expression, by: Expression) -> Expression:
        """Return casadi's Jacobian, by columns where equations call what has forward derivatives.

        Casadi takes rows where there are fewer, and those of such a function are zeros.
        """
        columns = {"helper_options": {"ad_weight": 0.0}} if self.foreign else {}
        return ca.jacobian(of, by, columns)

    @property
    def arguments(self) -> list[Expression]:
        """The symbols that the equations are functions of: time, x, u, p, and z if there is one."""
        return [self.time, self.x, self.u, self.p, *([self.z] if self.sampled else [])]

    @cached_property
    @in_turn
    def f(self) -> ca.Function:
        """Casadi function `(time, x, u, p) -> (xdot, y)`; columns of nx, nu, np and nx, ny.

        With sampled states `(time, x, u, p, z) -> (xdot, y)`, z a column of nz.
        """
        names = ["time", "x", "u", "p", "z"][: len(self.arguments)]
        return ca.Function("f", self.arguments, [self.xdot, self.y], names, ["xdot", "y"])

    @in_turn
    def balance(self, name: str) -> ca.Function:
        """Return the casadi function `(time, x, u, p) -> sum` of one balance, in its unit."""
        return ca.Function(name, self.arguments, [self.sums[name]])

    @cached_property
    @in_turn
    def slopes(self) -> ca.Function:
        """Casadi function of the same arguments `-> (A, B, C, D)`: xdot and y by x and u.

        Shapes (nx, nx), (nx, nu), (ny, nx), (ny, nu).
        """
        blocks = [self.jacobian(of, by) for of in (self.xdot, self.y) for by in (self.x, self.u)]
        return ca.Function("slopes", self.arguments, blocks)

    @cached_property
    @in_turn
    def g(self) -> ca.Function:
        """Casadi function `(time, x, u, p, z) -> z_next`: the sampled states after an instant."""
        return ca.Function("g", [self.time, self.x, self.u, self.p, self.z], [self.znext])


#: The columns of symbols, and the variables in each.
_COLUMNS = {"p": "parameters", "x": "states", "z": "sampled", "u": "inputs"}


@cache
@in_turn
def structure_of(components: tuple[Component, ...]) -> Structure:
    """Add up the components' terms, order the balances and substitute them.

    Raises InputError for a name used twice, a missing symbol, an unknown balance, a component that
    declares what it does not give, a loop among the balances, and for sampled components of
    different periods, or of a period that is no parameter or can be 0.
    """
    variables: dict[str, Any] = {
        kind: tuple(v for c in components for v in getattr(c, kind))
        for kind in (*_COLUMNS.values(), "outputs")
    }
    names = [v.name for kind in _COLUMNS.values() for v in variables[kind]]
    refuse_duplicates(components, names)
    period = sample_period(components)
    table = {n: ca.SX.sym(n) for n in (*names, "time")}
    sums = {n: ca.SX.sym(n) for n in _balance_table(components)}
    parts = [_equations_of(c, Symbols({**table, **sums})) for c in components]
    balances: dict[str, Expression] = {}
    for component, part in zip(components, parts, strict=True):
        for name, term in part.add.items():
            if name not in sums:
                raise InputError(
                    f"Component '{component.name}' adds to '{name}', which is no balance;"
                    f" the balances are {quoted(sorted(sums))}."
                )
            balances[name] = balances[name] + term if name in balances else ca.SX(term)
    der, out, switches, following = (
        {k: v for e in parts for k, v in getattr(e, kind).items()}
        for kind in ("der", "out", "switches", "next")
    )
    full = _substitute_in_order(balances, sums)
    by, instead = _column(sums.values()), _column(full)

    def resolved(expressions: Iterable[Expression]) -> Expression:
        return ca.substitute(_column(expressions), by, instead)

    columns = {k: _column(table[v.name] for v in variables[kind]) for k, kind in _COLUMNS.items()}
    xdot = resolved(der[s.name] for s in variables["states"])
    if "displacement" in balances and "velocity" not in out:
        moved = full[list(sums).index("displacement")]
        out["velocity"] = ca.jtimes(moved, columns["x"], xdot) + ca.jacobian(moved, table["time"])
    return Structure(
        components=components,
        **variables,
        **columns,
        time=table["time"],
        symbols={**table, **sums},
        balances=balances,
        sums=dict(zip(sums, full, strict=True)),
        der=der,
        out=out,
        xdot=xdot,
        y=resolved(out[o.name] for o in variables["outputs"]),
        switches=dict(zip(switches, ca.vertsplit(resolved(switches.values())), strict=True)),
        period=period,
        next=following,
        znext=resolved(following[s.name] for s in variables["sampled"]),
    )


def _balance_table(components: tuple[Component, ...]) -> dict[str, Balance]:
    """Return the sums of every model whose names are no symbols, and those of the components."""
    symbols = {v.name for c in components for k in _COLUMNS.values() for v in getattr(c, k)}
    shared = {n: b for n, b in BALANCES.items() if n not in symbols}
    return shared | {b.name: b for c in components for b in c.balances}


def _composed(components: tuple[Component, ...], starts: Mapping[str, float]) -> Structure:
    return structure_of(components).started(starts)


def _column(parts: Iterable[Expression]) -> Expression:
    return ca.vertcat(ca.SX(0, 1), *parts)


def _equations_of(component: Component, symbols: Symbols) -> Equations:
    try:
        equations = component.equations(symbols)
    except AttributeError as error:
        raise InputError(
            f"Component '{component.name}' cannot be composed: {error}; add the component that has"
            " it."
        ) from error
    check_declarations(component, equations)
    return equations


def _substitute_in_order(
    balances: Mapping[str, Expression], symbols: Mapping[str, Expression]
) -> list[Expression]:
    """Substitute balances into each other until none is left; name the loop if there is one."""
    resolved: dict[str, Expression] = {n: ca.SX(0) for n in symbols if n not in balances}
    needed = {name: {q.name() for q in ca.symvar(e)} for name, e in balances.items()}
    waiting = dict(balances)
    while waiting:
        ready = [name for name in waiting if needed[name].isdisjoint(waiting)]
        if not ready:  # follow what each depends on until a name repeats
            path = [next(iter(waiting))]
            while path[-1] not in path[:-1]:
                path.append(
                    next(n for n in waiting if ca.depends_on(waiting[path[-1]], symbols[n]))
                )
            loop = " -> ".join(path[path.index(path[-1]) :])
            raise InputError(f"The balances form a loop: {loop}; put a state between two of them.")
        for name in ready:
            known = [k for k in resolved if k in needed[name]]
            expression = waiting.pop(name)
            if known:
                by, instead = (_column(of[k] for k in known) for of in (symbols, resolved))
                expression = ca.substitute(expression, by, instead)
            resolved[name] = expression
    return [resolved[name] for name in symbols]
