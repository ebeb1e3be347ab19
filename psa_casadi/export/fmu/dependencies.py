"""What each output, derivative and event indicator depends on, read off the symbolic Jacobian."""

from functools import cache

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.export.common.variable_table import START_INDEX, starts_at_voltage
from psa_casadi.model.compose import Model, Structure

Key = tuple[str, int]


@cache
def dependencies(structure: Structure) -> dict[Key, dict[Key, str]]:
    """Return for each output, derivative and event indicator what it depends on, and how.

    Keys are (kind, index). The dependence is "constant" where the partial derivative is a number,
    "tunable" where it holds parameters only, else "dependent". Taken from the sparsity of the
    Jacobian with respect to time, states, inputs and parameters.

    At a sample instant a sampled state follows from these and from the sampled states before it,
    so that what depends on it depends on all of them; keys of kind "sampled" stand for the latter.
    """
    direct = _direct(structure)
    result: dict[Key, dict[Key, str]] = {}
    for unknown, found in direct.items():
        if unknown[0] != "next":
            sources = [direct["next", index] for kind, index in found if kind == "sampled"]
            through = {known: "dependent" for source in sources for known in source}
            result[unknown] = {**found, **through}
    return result


def at_the_start(model: Model) -> dict[Key, dict[Key, str]]:
    """Return the same while a model is initialised.

    Where it has the parameter `start_voltage`, states and voltage start as that has it.
    """
    found = dependencies(model.structure)
    if not starts_at_voltage(model):
        return found
    voltage = model.input_names.index("voltage")
    moved = {("input", voltage), *(("state", i) for i in range(len(model.state_names)))}
    through: dict[Key, str] = {("option", START_INDEX): "dependent"}
    return {u: {**how, **through} if moved & how.keys() else how for u, how in found.items()}


def without_sampled(found: dict[Key, str]) -> dict[Key, str]:
    """Return what a variable depends on after the initialisation, when no sampled state is set."""
    return {key: how for key, how in found.items() if key[0] != "sampled"}


def _direct(structure: Structure) -> dict[Key, dict[Key, str]]:
    """Return the same between instants, and what the sampled states ("next") follow from at one."""
    s = structure
    sizes = (("time", 1), ("state", len(s.states)), ("input", len(s.inputs)))
    groups = (*sizes, ("parameter", len(s.parameters)), ("sampled", len(s.sampled)))
    knowns: list[Key] = [(kind, i) for kind, size in groups for i in range(size)]
    unknowns: list[Key] = [("derivative", i) for i in range(len(s.states))]
    unknowns += [("output", i) for i in range(len(s.outputs))]
    unknowns += [("indicator", i) for i in range(len(s.switches))]
    unknowns += [("next", i) for i in range(len(s.sampled))]
    values = ca.vertcat(s.xdot, s.y, *s.switches.values(), s.znext)
    jacobian = ca.jacobian(values, ca.vertcat(s.time, s.x, s.u, s.p, s.z))
    tunable = {p.name for p in s.parameters}
    result: dict[Key, dict[Key, str]] = {u: {} for u in unknowns}
    rows, columns = jacobian.sparsity().get_triplet()
    for row, column, entry in zip(rows, columns, jacobian.nonzeros(), strict=True):
        result[unknowns[row]][knowns[column]] = _kind(entry, tunable)
    return result


def _kind(entry: Expression, tunable: set[str]) -> str:
    names = {str(symbol) for symbol in ca.symvar(entry)}
    if not names:
        return "constant"
    return "tunable" if names <= tunable else "dependent"
