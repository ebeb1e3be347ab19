"""How a model splits for exact steps: a linear part, states along a path, and what is left.

A stack is a cascade. Most of it is linear with constant coefficients,

    L' = M L + B u + c + e_i n_i,

with M, B and c functions of the parameters and a *port* n_i for each row that is not linear: all of
that row that the linear part leaves. States of hysteresis change along the path of another state
(the *driver*), whatever its course in time: they rest where it rests. Both are found here from the
equations alone, by their sparsity and by what the derivatives depend on. Ports and groups of states
along one driver are evaluated in the order in which they feed each other; a port that feeds back to
what it depends on (a load's stiffness) is solved for.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from psa_casadi.component import Expression
from psa_casadi.model.structure import Structure
from psa_casadi.simulation.exact.dependence import (
    BoolArray,
    closure,
    dependence,
    others,
    variables,
)
from psa_casadi.simulation.exact.order import Item, NoSplit, Port, order_of
from psa_casadi.simulation.exact.paths import Group, along, groups_along

#: Operations whose value jumps.
_JUMPS = frozenset(
    getattr(ca, f"OP_{name}")
    for name in ("LT", "LE", "EQ", "NE", "NOT", "AND", "OR", "SIGN", "FLOOR", "CEIL", "FMOD")
)


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
def split_of(structure: Structure) -> Split | str:
    """Return how a model splits, or a sentence that says why it does not."""
    try:
        return _split(structure)
    except NoSplit as reason:
        return str(reason)


def _split(s: Structure) -> Split:
    if s.sampled:
        raise NoSplit("it has sampled states")
    if not s.states:
        raise NoSplit("it has no states")
    if jumps(s):
        raise NoSplit("its equations jump")
    depends = dependence(s.xdot, s.x)  # [k, j]: x_k' depends on x_j
    reach = closure(depends)
    moving = [i for i in range(len(s.states)) if not _constant_slopes(s, i)]
    alone = [i for i in moving if not any(reach[i, j] and reach[j, i] for j in others(s, i))]
    found = {i: g for i in alone if (g := along(s, i, reach)) is not None}
    groups = groups_along(found)
    # what feeds comes before what it feeds: M is block triangular
    linear = tuple(
        sorted(
            (i for i in range(len(s.states)) if i not in found),
            key=lambda i: (int(reach[i].sum()), i),
        )
    )
    matrices, remainders = _linear_part(s, linear)
    ports = _ports(s, linear, remainders, groups, reach)
    _check_switches(s, groups)
    return Split(s, linear, groups, ports, order_of(s, groups, ports, reach), matrices)


def jumps(s: Structure) -> bool:
    """Whether derivatives have operations that jump: their slopes do not tell what they depend on.

    Of equations without sampled states.
    """
    equations = ca.Function("f", s.arguments, [s.xdot])
    return any(equations.instruction_id(k) in _JUMPS for k in range(equations.n_instructions()))


def _constant_slopes(s: Structure, i: int) -> bool:
    """Whether x_i' is affine in states, inputs and time with constant coefficients."""
    everything = variables(s)
    slopes = ca.jacobian(s.xdot[i], everything)
    return not ca.depends_on(slopes, everything)


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
    given, coefficients = ca.vertcat(x, s.u), ca.horzcat(m, b)
    remainders = [
        _remainder(xdot[k], given, coefficients[k, :].T, c[k], everything) for k in range(len(rows))
    ]
    return (m, b, c), remainders


def _remainder(
    row: Expression,
    given: Expression,
    linear: Expression,
    constant: Expression,
    everything: Expression,
) -> Expression:
    """Return what `linear` and `constant` leave of a row.

    Where the row is affine in a variable, this is taken out by setting it to 0, so that nothing
    cancels in numbers.
    """
    slopes = ca.jacobian(row, given)
    bent = [j for j in range(given.numel()) if ca.depends_on(slopes[j], everything)]
    straight = [j for j in range(given.numel()) if j not in bent]
    rest = ca.substitute(row, given[straight], ca.SX.zeros(len(straight)))
    if not ca.depends_on(rest, everything):
        return ca.SX(0)
    return rest - constant - (linear[bent].T @ given[bent] if bent else 0)


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


def _check_switches(s: Structure, groups: Sequence[Group]) -> None:
    """Refuse kinks that are not those of a driver's rate: steps do not look for others."""
    rates = [s.xdot[g.driver] for g in groups]
    for name, expression in s.switches.items():
        if not any(ca.is_equal(expression, rate, 20) for rate in rates):
            raise NoSplit(f"its equations have a kink of their own ({name})")
