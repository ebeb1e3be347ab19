"""The places of a model where something may be missing: inputs, outputs, rates, parameters.

A model with ports is the same model, written so that others may add to it:

    applied_u = u + ...          what acts in the place of the input u
    rate_x    = f_x(...) + ...   the rate of the state x
    true_y    = h_y(...)         an output as the equations have it
    shown_y   = true_y + ...     what the sensor shows of it
    varied_p  = p + ...          what acts in the place of the parameter p
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import casadi as ca

from psa_casadi.component import Balance, Component, Equations, Expression, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.symbolic import in_turn
from psa_casadi.units import rate_unit, si_unit

Kind = Literal["input", "rate", "output", "parameter"]
_PREFIX: dict[Kind, str] = {
    "input": "applied_", "rate": "rate_", "output": "shown_", "parameter": "varied_",
}  # fmt: skip


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


def true_output(name: str) -> str:
    """Return the name of the sum that holds an output before its sensor."""
    return f"true_{name}"


@in_turn
def ports_of(model: Model) -> tuple[Port, ...]:
    """Return the ports of a model: its inputs, the rates of its own physics' states, its outputs.

    A rate that is nothing but another state (the position's is the velocity) is a definition and no
    physics: it has no port. States of effects have none either.
    """
    s = model.structure
    base = [c for c in model.components if c.gain is None]
    states = [q for c in base for q in c.states]
    return (
        *(Port("input", i.name, _si(i.unit)) for c in base for i in c.inputs),
        *(
            Port("rate", q.name, rate_unit(_si(q.unit)))
            for q in states
            if _is_physics(ca.SX(s.der[q.name]), q.name)
        ),
        *(Port("output", o.name, _si(o.unit)) for c in base for o in c.outputs),
    )


def parameter_ports(model: Model) -> tuple[Port, ...]:
    """Return the ports of the parameters of a model's own physics that may be fitted.

    None of an imported FMU, whose parameters are numbers.
    """
    if model.structure.foreign:
        return ()
    base = [c for c in model.components if c.gain is None]
    own = [p for c in base for p in c.parameters if p.fitted]
    return tuple(Port("parameter", p.name, _si(p.unit)) for p in own)


def _is_physics(rate: Expression, state: str) -> bool:
    """Whether a rate is more than a symbol, but for the sum at its port."""
    return not rate.is_symbolic() or rate.name() == _PREFIX["rate"] + state


def with_ports(model: Model, ports: Iterable[Port] | None = None) -> Model:
    """Return the model with sums at its ports, or at some of them, that effects may add to.

    Its values, starts and equations stay; it computes the same.
    """
    chosen = frozenset(ports_of(model) if ports is None else ports)
    return model.with_components(ported(c, chosen) for c in model.components)


@cache
def ported(component: Component, ports: frozenset[Port]) -> Component:
    """Return a component with sums at those of the ports that are its own; once for all.

    Those that it has already stay.
    """
    if isinstance(component.equations, Opened):
        ports, component = ports | {*component.equations.ports}, component.equations.component
    names = {
        "input": [i.name for i in component.inputs],
        "rate": [q.name for q in component.states],
        "output": [o.name for o in component.outputs],
        "parameter": [p.name for p in component.parameters],
    }
    own = [p for p in sorted(ports, key=lambda p: p.balance) if p.variable in names[p.kind]]
    if component.gain is not None or not own:
        return component
    acts = "what acts in the place of "
    about = {"input": acts, "rate": "", "output": "what is shown of ", "parameter": acts}
    balances = []
    for p in own:
        if p.kind == "output":
            true = true_output(p.variable)
            balances.append(Balance(true, p.unit, f"{p.words} before its sensor"))
        balances.append(Balance(p.balance, p.unit, about[p.kind] + p.words))
    return replace(component, equations=Opened(component, tuple(own)), balances=tuple(balances))


def state_unit(model: Model, name: str) -> str:
    """Return the SI unit of a state."""
    return next(_si(q.unit) for q in model.structure.states if q.name == name)


def _si(unit: str) -> str:
    return si_unit(unit) if unit else "1"


@dataclass(frozen=True, eq=False)
class Opened:
    """The equations of a component with sums in the places of what its ports stand for."""

    component: Component
    ports: tuple[Port, ...]

    def __call__(self, s: Symbols) -> Equations:
        """Return the equations in these symbols."""
        given = [p for p in self.ports if p.kind in ("input", "parameter")]
        replaced = {p.variable: getattr(s, p.balance) for p in given}
        plain = self.component.equations(_Replaced(s, replaced))
        add: dict[str, Expression] = dict(plain.add)
        der, out = dict(plain.der), dict(plain.out)
        for p in self.ports:
            if p in given:
                add[p.balance] = getattr(s, p.variable)
            elif p.kind == "rate":
                add[p.balance], der[p.variable] = der[p.variable], getattr(s, p.balance)
            else:
                true = true_output(p.variable)
                add[true], add[p.balance] = out[p.variable], getattr(s, true)
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
