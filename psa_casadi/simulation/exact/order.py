"""In which order ports and groups of states are evaluated."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.component import Expression
from psa_casadi.model.structure import Structure
from psa_casadi.simulation.exact.dependence import BoolArray, dependence
from psa_casadi.simulation.exact.paths import Group

#: A group (its index), a port, or ports that are solved for together (their indices).
Item = tuple[str, tuple[int, ...]]


class NoSplit(Exception):  # noqa: N818 - it says that a form does not fit, which is no mistake
    """The model does not have the form of exact steps; the message says why."""


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
    feeds = [_feeds(groups, ports, item) for item in items]
    reads = [_reads(s, groups, ports, item) for item in items]
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


def _feeds(groups: Sequence[Group], ports: Sequence[Port], item: Item) -> list[int]:
    kind, members = item
    if kind == "group":
        return list(groups[members[0]].states)
    return [ports[k].state for k in members]


def _reads(s: Structure, groups: Sequence[Group], ports: Sequence[Port], item: Item) -> list[int]:
    kind, members = item
    if kind == "group":
        group = groups[members[0]]
        inside = np.any(dependence(group.slopes, s.x), axis=0)
        return [int(j) for j in np.flatnonzero(inside) if j not in group.states] + [group.driver]
    inside = np.any([dependence(ports[k].value, s.x)[0] for k in members], axis=0)
    return [int(j) for j in np.flatnonzero(inside)]
