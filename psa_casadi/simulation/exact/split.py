"""How a model splits for exact steps: a linear part, states along a path, and what is left.

A stack is a cascade. Most of it is linear with constant coefficients,

    L' = M L + B u + c + e_i n_i,

with M, B and c functions of the parameters and a *port* n_i for each row that is not linear: all of
that row that the linear part leaves. States of hysteresis change along the path of another state
(the *driver*), whatever its course in time: they rest where it rests. Both follow here from the
equations alone, by their sparsity and by what the derivatives depend on. Ports and groups of states
along one driver are evaluated in the order in which they feed each other; a port that feeds back to
what it depends on (a load's stiffness) is solved for.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from psa_casadi.common.symbolic import in_turn, instructions
from psa_casadi.common.units import BoolArray
from psa_casadi.model.component import Expression
from psa_casadi.model.structure import Structure


def dependence(of: Expression, on: Expression) -> BoolArray:
    """Return which rows of an expression depend on which symbols, shape (rows, symbols)."""
    return np.array(ca.DM(ca.jacobian_sparsity(of, on), 1).full(), dtype=bool)


def closure(depends: BoolArray) -> BoolArray:
    """Return [k, j]: a change of j reaches k sooner or later; each reaches itself."""
    reach = depends | np.eye(len(depends), dtype=bool)
    for _ in range(len(depends).bit_length()):
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    return reach


def variables(s: Structure) -> Expression:
    """Return states, inputs and time, one above the other."""
    return ca.vertcat(s.x, s.u, s.time)


def others(s: Structure, i: int) -> Iterable[int]:
    """Return the indices of all states but the i-th."""
    return (j for j in range(len(s.states)) if j != i)


@dataclass(frozen=True)
class Group:
    """States along the path of one driver, by their indices in the model's state vector.

    `rate` is the symbol of the driver's rate in `slopes`, the states' derivatives.
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
        if ca.depends_on(slope, s.time) or not ca.depends_on(slope, rate):
            continue
        resting = ca.substitute(slope, rate, ca.SX(0))
        everything = ca.vertcat(s.x[list(others(s, i))], s.u, s.time)
        decay = ca.jacobian(resting, s.x[i])
        if not ca.depends_on(resting, everything) and not ca.depends_on(decay, s.x[i]):
            return driver, rate, slope
    return None


def _rate_name(s: Structure, i: int) -> str | None:
    """Return the name of the balance or state that is a state's derivative, if there is one."""
    derivative: Expression = ca.SX(s.der[s.states[i].name])
    return str(derivative.name()) if derivative.is_symbolic() else None


def _resolved(s: Structure, expression: Expression, keep: set[str]) -> Expression:
    """Return an expression with all balances but those kept substituted, by 0 where none is."""
    sums = {n: s.balances.get(n, ca.SX(0)) for n in s.balance_table if n not in keep}
    symbols, result = [s.symbols[n] for n in sums], ca.SX(expression)
    while any(ca.depends_on(result, q) for q in symbols):
        result = ca.substitute([result], symbols, list(sums.values()))[0]
    return result


def groups_along(table: Mapping[int, tuple[int, Expression, Expression]]) -> tuple[Group, ...]:
    """Return the states with driver, rate symbol and slope (`along`), one group for a driver."""
    drivers = sorted({driver for driver, *_ in table.values()})
    groups = []
    for driver in drivers:
        states = tuple(i for i, (d, *_) in table.items() if d == driver)
        rate = table[states[0]][1]
        slopes = [ca.substitute(table[i][2], table[i][1], rate) for i in states]
        groups.append(Group(driver, states, rate, ca.vertcat(*slopes)))
    return tuple(groups)


#: A group (its index), a port, or ports that are solved for together (their indices).
Item = tuple[str, tuple[int, ...]]


class NoSplit(Exception):  # noqa: N818 - a form that does not fit is no mistake
    """The model does not have the form of exact steps; the message gives the reason."""


@dataclass(frozen=True)
class Port:
    """What the linear part leaves of one state's derivative.

    `chord` is the driver along whose path the port varies, -1 if there is none.
    """

    state: int
    value: Expression
    feedback: bool
    chord: int


def order_of(
    s: Structure, groups: Sequence[Group], ports: Sequence[Port], reach: BoolArray
) -> tuple[Item, ...]:
    """Return the order in which groups and ports are evaluated, each after what feeds it."""
    items: list[Item] = [("group", (k,)) for k in range(len(groups))]
    label = np.argmax(reach & reach.T, axis=1)  # the first of those that reach each other
    loops: dict[int, list[int]] = {}
    for k, port in enumerate(ports):
        if port.feedback:
            loops.setdefault(int(label[port.state]), []).append(k)
        else:
            items.append(("port", (k,)))
    items += [("loop", tuple(ks)) for ks in loops.values()]
    feeds, reads = [], []
    for kind, members in items:
        if kind == "group":
            group = groups[members[0]]
            inside, fed = np.any(dependence(group.slopes, s.x), axis=0), list(group.states)
            read = [*(j for j in np.flatnonzero(inside).tolist() if j not in fed), group.driver]
        else:
            inside = np.any([dependence(ports[k].value, s.x)[0] for k in members], axis=0)
            fed, read = [ports[k].state for k in members], np.flatnonzero(inside).tolist()
        feeds.append(fed)
        reads.append(read)
    waiting, done = list(range(len(items))), []
    while waiting:
        ready = [
            k
            for k in waiting
            if not any(reach[r, f] for o in waiting if o != k for f in feeds[o] for r in reads[k])
        ]
        if not ready:
            raise NoSplit("its nonlinear parts feed each other in a loop")
        done += ready
        waiting = [k for k in waiting if k not in ready]
    return tuple(items[k] for k in done)


#: Operations whose value jumps.
_JUMPS = frozenset(
    getattr(ca, f"OP_{name}")
    for name in ("LT", "LE", "EQ", "NE", "NOT", "AND", "OR", "SIGN", "FLOOR", "CEIL", "FMOD")
)
#: Place of the inputs among the arguments of the equations, behind time and states.
_INPUT = 2


@dataclass(frozen=True, eq=False)
class Split:
    """The parts of a model by their indices in its state vector.

    `linear` are the states of L. `order` lists what is evaluated one after the other. M (nL, nL),
    B (nL, nu) and c (nL,) depend on the parameters alone.
    """

    structure: Structure
    linear: tuple[int, ...]
    groups: tuple[Group, ...]
    ports: tuple[Port, ...]
    order: tuple[Item, ...]
    matrices: tuple[Expression, Expression, Expression]

    @property
    def along(self) -> tuple[int, ...]:
        """The states along a path, in the order of the groups."""
        return tuple(i for g in self.groups for i in g.states)


@cache
@in_turn
def split_of(structure: Structure) -> Split | str:
    """Return how a model splits, or the reason why it does not, a sentence."""
    try:
        return _split(structure)
    except NoSplit as reason:
        return str(reason)


def _split(s: Structure) -> Split:
    if s.sampled:
        raise NoSplit("it has sampled states")
    if not s.states:
        raise NoSplit("it has no states")
    if any(argument < _INPUT for argument, _ in jumping(s, s.xdot)):
        raise NoSplit("its equations jump")
    depends = dependence(s.xdot, s.x)  # [k, j]: x_k' depends on x_j
    reach = closure(depends)
    every = variables(s)
    moving = [  # not affine in states, inputs and time with constant coefficients
        i for i in range(len(s.states)) if ca.depends_on(ca.jacobian(s.xdot[i], every), every)
    ]
    alone = [i for i in moving if not any(reach[i, j] and reach[j, i] for j in others(s, i))]
    table = {i: g for i in alone if (g := along(s, i, reach)) is not None}
    groups = groups_along(table)
    # what feeds comes before what it feeds: M is block triangular
    rest = (i for i in range(len(s.states)) if i not in table)
    linear = tuple(sorted(rest, key=lambda i: (int(reach[i].sum()), i)))
    matrices, remainders = _linear_part(s, linear)
    ports = _ports(s, linear, remainders, groups, reach)
    # kinks that are not those of a driver's rate: steps do not look for others
    rates = [s.xdot[g.driver] for g in groups]
    for name, expression in s.switches.items():
        if not any(ca.is_equal(expression, rate, 20) for rate in rates):
            raise NoSplit(f"its equations have another kink ({name})")
    return Split(s, linear, groups, ports, order_of(s, groups, ports, reach), matrices)


def jumping(s: Structure, of: Expression) -> set[tuple[int, int]]:
    """Return what operations that jump read: the argument of the equations, and its element.

    Derivatives do not show what depends on these. Of equations without sampled states.
    """
    equations = ca.Function("f", s.arguments, [of])
    reads: dict[int, set[tuple[int, int]]] = {}
    result: set[tuple[int, int]] = set()
    for op, inputs, targets in instructions(equations):
        if op == ca.OP_OUTPUT:
            continue
        if op == ca.OP_INPUT:
            read = {(inputs[0], inputs[1])}
        else:
            read = set().union(*(reads[q] for q in inputs if op != ca.OP_CONST))
        result |= read if op in _JUMPS else set()
        reads |= dict.fromkeys(targets, read)
    return result


def _linear_part(
    s: Structure, linear: Sequence[int]
) -> tuple[tuple[Expression, Expression, Expression], list[Expression]]:
    """Return M, B, c at the origin, and what they leave of each row."""
    rows = list(linear)
    xdot, x = s.xdot[rows], s.x[rows]
    everything = variables(s)
    origin = ca.SX.zeros(everything.numel())
    blocks = [ca.jacobian(xdot, x), ca.jacobian(xdot, s.u), xdot]
    m, b, c = (ca.densify(q) for q in ca.substitute(blocks, [everything], [origin]))
    inputs, coefficients = ca.vertcat(x, s.u), ca.horzcat(m, b)
    remainders = []
    for k in range(len(rows)):
        # where the row is affine in a variable, this is taken out by setting it to 0, so that
        # nothing cancels in numbers
        slopes, of_row = ca.jacobian(xdot[k], inputs), coefficients[k, :].T
        turns = {len(rows) + j for argument, j in jumping(s, xdot[k]) if argument == _INPUT}
        bent = [
            j for j in range(inputs.numel()) if j in turns or ca.depends_on(slopes[j], everything)
        ]
        straight = [j for j in range(inputs.numel()) if j not in bent]
        rest = ca.substitute(xdot[k], inputs[straight], ca.SX.zeros(len(straight)))
        if ca.depends_on(rest, everything):
            remainders.append(rest - c[k] - (of_row[bent].T @ inputs[bent] if bent else 0))
        else:
            remainders.append(ca.SX(0))
    return (m, b, c), remainders


def _ports(
    s: Structure,
    linear: Sequence[int],
    remainders: Sequence[Expression],
    groups: Sequence[Group],
    reach: BoolArray,
) -> tuple[Port, ...]:
    ports = []
    for state, value in zip(linear, remainders, strict=True):
        if not ca.depends_on(value, variables(s)):
            continue
        read = [int(j) for j in np.flatnonzero(dependence(value, s.x)[0])]
        feedback = any(reach[j, state] for j in read)
        if feedback and any(j in g.states for g in groups for j in read):
            raise NoSplit("a hysteresis lies in a loop")
        drivers = [g.driver for g in groups if set(g.states) & set(read)]
        near = [j for j in read if j in {g.driver for g in groups}] or [
            j for j in read if j in linear
        ]
        chord = -1 if feedback else next(iter([*drivers, *near]), -1)
        ports.append(Port(state, value, feedback, chord))
    return tuple(ports)
