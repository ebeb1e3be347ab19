"""The places of a model where something may be missing: signals, rates, parameters.

A model with ports is the same model, written so that others may add to it:

    applied_u = u + ...          what acts in the place of the input u
    rate_x    = f_x(...) + ...   the rate of the state x
    true_y    = h_y(...)         an output as the equations have it
    shown_y   = true_y + ...     what the sensor shows of it
    varied_p  = p + ...          what acts in the place of the parameter p
    true_w    = h_w(...)         an intermediate (a force, a flow) as the equations have it
    w         = true_w + ...     what acts of it, wherever it acts
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import casadi as ca
import numpy as np

from psa_casadi.common.symbolic import in_turn
from psa_casadi.common.units import rate_unit, si_unit
from psa_casadi.model.component import Balance, Component, Equations, Expression, OnDemand, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import Parameter

Kind = Literal["input", "rate", "output", "parameter", "intermediate"]
_PREFIX: dict[Kind, str] = {
    "input": "applied_", "rate": "rate_", "output": "shown_", "parameter": "varied_",
    "intermediate": "",
}  # fmt: skip
#: Name of the term by which `is_place` asks where an intermediate acts.
_PROBE = "term_of_a_probe"
#: What these are before an effect adds to them.
_BEFORE: dict[Kind, str] = {"output": "before its sensor", "intermediate": "by its equation"}


@dataclass(frozen=True)
class Port:
    """A place where an effect may attach: which kind, of which variable, in which SI unit."""

    kind: Kind
    variable: str
    unit: str

    @property
    def balance(self) -> str:
        """Name of the sum that an effect adds to."""
        return _PREFIX[self.kind] + self.variable

    @property
    def words(self) -> str:
        """The place in words: "the input u", "the rate of x", "the parameter p"."""
        if self.kind == "rate":
            return f"the rate of {self.variable}"
        return f"the {self.kind} {self.variable}"


def true_sum(name: str) -> str:
    """Return the name of the sum that holds an output or an intermediate before its port's."""
    return f"true_{name}"


@in_turn
def ports_of(model: Model) -> tuple[Port, ...]:
    """Return the ports of a model: its inputs, the rates of its base states, its outputs.

    And its intermediates. A rate that is nothing but another state (the position's is the
    velocity) is a definition and no physics: it has no port, nor has an intermediate that is
    `kinematic`. States of effects have none either.
    """
    base = model.base
    rates = [q for c in base for q in c.states if definition_of(model, q.name) is None]
    sums = [w for c in base for w in plain(c).balances if w.name not in kinematic(c)]
    return (
        *(Port("input", i.name, _si(i.unit)) for c in base for i in c.inputs),
        *(Port("rate", q.name, rate_unit(_si(q.unit))) for q in rates),
        *(Port("output", o.name, _si(o.unit)) for c in base for o in c.outputs),
        *(Port("intermediate", w.name, _si(w.unit)) for w in sums),
    )


def parameter_ports(model: Model) -> tuple[Port, ...]:
    """Return the ports of the parameters of a model's base physics that may be fitted.

    None of an imported FMU, whose parameters are numbers.
    """
    if model.structure.foreign:
        return ()
    fitted = [p for c in model.base for p in c.parameters if p.fitted]
    return tuple(Port("parameter", p.name, _si(p.unit)) for p in fitted)


def plain(component: Component) -> Component:
    """Return a component without the sums that effects add to."""
    opened = component.equations
    return opened.component if isinstance(opened, Opened) else component


@cache
@in_turn
def written(component: Component) -> Equations:
    """Return a component's equations without ports, in symbols of the names that they have."""
    return plain(component).equations(OnDemand())


@cache
@in_turn
def kinematic(component: Component) -> Mapping[str, Mapping[str, float]]:
    """Return the intermediates that are sums of states times numbers, the largest +-1, by state.

    The stretch of a spring between two bodies, say: a definition. A larger number is a stiffness.
    """
    states, table = {q.name for q in component.states}, dict[str, Mapping[str, float]]()
    for name in [w.name for w in plain(component).balances]:
        definition = ca.SX(written(component).add[name])
        symbols = ca.vertcat(ca.SX(0, 1), *ca.symvar(definition))
        slopes = ca.jacobian(definition, symbols)
        names = [q.name() for q in ca.symvar(definition)]
        if names and states.issuperset(names) and slopes.is_constant():
            numbers = np.array(ca.evalf(ca.densify(slopes))).ravel()
            if np.max(np.abs(numbers)) == 1.0:
                table[name] = dict(zip(names, numbers.tolist(), strict=True))
    return table


def kinematics(model: Model) -> dict[str, Mapping[str, float]]:
    """Return the `kinematic` intermediates of a model's base physics."""
    return {n: parts for c in model.base for n, parts in kinematic(c).items()}


def definition_of(model: Model, state: str) -> str | None:
    """Return the state, input or kinematic intermediate that a state's rate is, None of physics."""
    rate = next(ca.SX(written(c).der[state]) for c in model.base if state in written(c).der)
    known = (*model.state_names, *model.input_names, *kinematics(model))
    return str(rate.name()) if rate.is_symbolic() and rate.name() in known else None


@in_turn
def is_place(model: Model, port: Port) -> bool:
    """Whether what may be missing in an intermediate is not the same as in one rate.

    It is where the intermediate only adds to that rate, times a function of parameters.
    """
    if port.kind != "intermediate":
        return False
    probe = Component(
        _PROBE, "one more term", "", lambda s: Equations(add={port.balance: getattr(s, _PROBE)}),
        parameters=(Parameter(_PROBE, 0.0, port.unit, (0.0, 0.0), "the term"),),
    )  # fmt: skip
    s = model.with_components((*model.components, probe)).structure
    by = [ca.jacobian(of, s.symbols[_PROBE]) for of in (s.xdot, s.y)]
    names = {q.name() for q in ca.symvar(by[0])}
    once = by[0].nnz() == 1 and not by[1].nnz()
    return not (once and names <= {q.name for q in s.parameters})


@in_turn
def seen_by(model: Model, port: Port) -> tuple[str, ...]:
    """Return the states, inputs and kinematic intermediates in what a rate or intermediate is.

    Those of a rate include its state.
    """
    kept, terms = kinematics(model), dict[str, list[Expression]]()
    for c in model.base:
        for group in (written(c).add, written(c).der):
            for name, term in group.items():
                terms.setdefault(name, []).append(term)
    inside, waiting = set[str](), [*terms[port.variable]]
    stop = {*kept, *model.state_names}
    while waiting:
        names = {q.name() for q in ca.symvar(ca.SX(waiting.pop()))} - inside
        inside |= names
        waiting += [e for n in names - stop for e in terms.get(n, ())]
    inside |= {port.variable} if port.kind == "rate" else set()
    order = (*model.state_names, *model.input_names, *kept)
    return tuple(n for n in order if n in inside)


@in_turn
def variables_at(model: Model, port: Port) -> tuple[str, ...]:
    """Return what a free function at a port is of: no variable is a sum of others times numbers.

    At a rate or an intermediate, what it sees, kinematic intermediates first, and what these are
    of; at a signal, itself.
    """
    if port.kind not in ("rate", "intermediate"):
        return (port.variable,)
    kept, read = kinematics(model), seen_by(model, port)
    of = [q for n in read for q in kept.get(n, ())]
    independent: list[str] = []
    rows = np.zeros((0, len(model.state_names)))
    for n in dict.fromkeys((*(n for n in read if n in kept), *read, *of)):
        parts = kept.get(n, {n: 1.0})
        row = [parts.get(q, 0.0) for q in model.state_names]
        more = np.vstack([rows, row])
        if not any(row) or np.linalg.matrix_rank(more) > len(rows):
            independent.append(n)
            rows = more if any(row) else rows
    return tuple(independent)


def _names(component: Component, kind: Kind) -> list[str]:
    """Return the variables of a component that a kind of port may be of."""
    groups: dict[Kind, Sequence[Any]] = {
        "input": component.inputs, "rate": component.states, "output": component.outputs,
        "parameter": component.parameters, "intermediate": plain(component).balances,
    }  # fmt: skip
    return [v.name for v in groups[kind]]


def with_ports(model: Model, ports: Iterable[Port] | None = None) -> Model:
    """Return the model with sums at its ports, or at some of them, that effects may add to.

    Its values, starts and equations stay; it computes the same.
    """
    chosen = frozenset(ports_of(model) if ports is None else ports)
    return model.with_components(ported(c, chosen) for c in model.components)


@cache
def ported(component: Component, ports: frozenset[Port]) -> Component:
    """Return a component with sums at those of the ports that belong to it (cached).

    Sums that it has already stay.
    """
    if isinstance(component.equations, Opened):
        ports, component = ports | {*component.equations.ports}, component.equations.component
    by_name = sorted(ports, key=lambda p: p.balance)
    here = [p for p in by_name if p.variable in _names(component, p.kind)]
    if component.gain is not None or not here:
        return component
    acts = "what acts in the place of "
    about = {"input": acts, "rate": "", "output": "reading of ", "parameter": acts}
    balances = [*component.balances]
    for p in here:
        if p.kind in _BEFORE:
            before = f"{p.words} {_BEFORE[p.kind]}"
            balances.append(Balance(true_sum(p.variable), p.unit, before))
        if p.kind != "intermediate":
            balances.append(Balance(p.balance, p.unit, about[p.kind] + p.words))
    return replace(component, equations=Opened(component, tuple(here)), balances=tuple(balances))


def unit_of(model: Model, name: str) -> str:
    """Return the SI unit of a state, an input or an intermediate."""
    s = model.structure
    sums = [w for c in model.components for w in plain(c).balances]
    signals: list[Any] = [*s.states, *s.inputs, *sums]
    return next(_si(q.unit) for q in signals if q.name == name)


def _si(unit: str) -> str:
    return si_unit(unit) if unit else "1"


@dataclass(frozen=True, eq=False)
class Opened:
    """The equations of a component with sums in the places of what its ports stand for."""

    component: Component
    ports: tuple[Port, ...]

    def __call__(self, s: Symbols) -> Equations:
        """Return the equations in these symbols."""
        replacing = [p for p in self.ports if p.kind in ("input", "parameter")]
        replaced = {p.variable: getattr(s, p.balance) for p in replacing}
        plain = self.component.equations(_Replaced(s, replaced))
        add: dict[str, Expression] = dict(plain.add)
        der, out = dict(plain.der), dict(plain.out)
        for p in self.ports:
            if p in replacing:
                add[p.balance] = getattr(s, p.variable)
            elif p.kind == "rate":
                add[p.balance], der[p.variable] = der[p.variable], getattr(s, p.balance)
            else:
                true, of = true_sum(p.variable), out if p.kind == "output" else add
                add[true], add[p.balance] = of[p.variable], getattr(s, true)
                if p.kind == "output":
                    out[p.variable] = getattr(s, p.balance)
        return replace(plain, der=der, add=add, out=out)


class _Replaced(Symbols):
    """The symbols of a model, some of them replaced."""

    def __init__(self, symbols: Symbols, replaced: dict[str, Expression]) -> None:
        super().__init__(replaced)
        self._symbols = symbols

    def __getattr__(self, name: str) -> Expression:
        table = self.__dict__["_table"]
        return table[name] if name in table else getattr(self.__dict__["_symbols"], name)
