"""States that change along the path of another one, whatever its course in time."""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.model.structure import Structure
from psa_casadi.simulation.exact.dependence import BoolArray, others


@dataclass(frozen=True)
class Group:
    """States along the path of one driver, by their indices in the model's state vector.

    `rate` is the symbol that stands for the driver's rate in `slopes`, the states' derivatives.
    """

    driver: int
    states: tuple[int, ...]
    rate: Expression
    slopes: Expression


def along(s: Structure, i: int, reach: BoolArray) -> tuple[int, Expression, Expression] | None:
    """Return driver, rate symbol and slope of a state that rests where its driver rests.

    With the driver's rate at zero its derivative may depend on nothing but the state itself, and on
    that linearly (a heat that decays).
    """
    rates = {j: name for j in others(s, i) if (name := _rate_name(s, j)) is not None}
    for driver, name in rates.items():
        if not reach[i, driver] or reach[driver, i]:
            continue
        rate = ca.SX.sym("rate")
        keep = {name} if name in s.balances else set()
        slope = _resolved(s, s.der[s.states[i].name], keep)
        slope = ca.substitute(slope, s.symbols[name], rate)
        if ca.depends_on(slope, s.time):
            continue
        if not ca.depends_on(slope, rate):
            continue
        resting = ca.substitute(slope, rate, ca.SX(0))
        everything = ca.vertcat(s.x[list(others(s, i))], s.u, s.time)
        own = ca.jacobian(resting, s.x[i])
        if not ca.depends_on(resting, everything) and not ca.depends_on(own, s.x[i]):
            return driver, rate, slope
    return None


def _rate_name(s: Structure, i: int) -> str | None:
    """Return the name of the balance or state that is a state's derivative, if there is one."""
    derivative: Expression = ca.SX(s.der[s.states[i].name])
    return str(derivative.name()) if derivative.is_symbolic() else None


def _resolved(s: Structure, expression: Expression, keep: set[str]) -> Expression:
    """Return an expression with all balances but those kept substituted."""
    names = [n for n in s.balances if n not in keep]
    symbols, sums = [s.symbols[n] for n in names], [s.balances[n] for n in names]
    unused = [q for n, q in s.symbols.items() if n not in s.balances and _is_balance(s, n)]
    result = ca.substitute([ca.SX(expression)], unused, [ca.SX(0)] * len(unused))[0]
    while any(ca.depends_on(result, q) for q in symbols):
        result = ca.substitute([result], symbols, sums)[0]
        result = ca.substitute([result], unused, [ca.SX(0)] * len(unused))[0]
    return result


def _is_balance(s: Structure, name: str) -> bool:
    tables = (s.states, s.inputs, s.parameters, s.sampled)
    return name != "time" and all(name not in [q.name for q in table] for table in tables)


def groups_along(found: Mapping[int, tuple[int, Expression, Expression]]) -> tuple[Group, ...]:
    """Return the states with driver, rate symbol and slope (`along`), one group for a driver."""
    drivers = sorted({driver for driver, *_ in found.values()})
    groups = []
    for driver in drivers:
        states = tuple(i for i, (d, *_) in found.items() if d == driver)
        rate = found[states[0]][1]
        slopes = [ca.substitute(found[i][2], found[i][1], rate) for i in states]
        groups.append(Group(driver, states, rate, ca.vertcat(*slopes)))
    return tuple(groups)
