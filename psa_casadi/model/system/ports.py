"""The ports of wired parts: which output feeds which input, checked, and the names outside."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.errors import Problems
from psa_casadi.model.compose import Model
from psa_casadi.units import parse_unit
from psa_casadi.variables import Input, Output

#: A port: the name of a part and of one of its inputs or outputs.
Port = tuple[str, str]


@dataclass(frozen=True)
class Plan:
    """Which output feeds each wired input; names outside by port; the parameter of the period."""

    sources: Mapping[Port, Port]
    inputs: Mapping[Port, str]
    outputs: Mapping[Port, str]
    period: str | None


def port_text(port: Port) -> str:
    """Return a port as it is written in a wire."""
    return ".".join(port)


def plan_of(
    parts: Mapping[str, Model],
    wires: Sequence[tuple[str, str]],
    inputs: Mapping[str, str] | None,
    outputs: Mapping[str, str] | None,
) -> Plan:
    """Check wires and names outside and return what they say.

    Raises InputError with all mistakes: names that are no identifiers, ports that do not exist, an
    input with two sources, units that differ, periods that differ.
    """
    problems = Problems()
    _check_names([*parts, *(inputs or ()), *(outputs or ())], problems)
    sources = _sources(parts, wires, problems)
    plan = Plan(
        sources,
        _inputs(parts, inputs, sources, problems),
        _outputs(parts, outputs, problems),
        _period(parts, problems),
    )
    problems.raise_if_any()
    return plan


def _check_names(names: Sequence[str], problems: Problems) -> None:
    for name in names:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
            problems.add(
                f"'{name}' cannot name a part or a port; use letters, digits, underscores, no digit"
                " first."
            )


def _sources(
    parts: Mapping[str, Model], wires: Sequence[tuple[str, str]], problems: Problems
) -> dict[Port, Port]:
    found: dict[Port, Port] = {}
    for start, end in wires:
        source = _port(parts, start, "output", problems)
        target = _port(parts, end, "input", problems)
        if source is None or target is None:
            continue
        if target in found:
            problems.add(
                f"The input '{end}' has two sources, '{port_text(found[target])}' and '{start}';"
                " leave one out."
            )
        given, wanted = _unit(parts, source, "output"), _unit(parts, target, "input")
        if not _same(given, wanted):
            problems.add(
                f"The wire from '{start}' [{given}] to '{end}' [{wanted}] joins different units;"
                " wire ports of one unit, or put a part between them."
            )
        found[target] = source
    return found


def _port(parts: Mapping[str, Model], text: str, kind: str, problems: Problems) -> Port | None:
    """Return a port by its text, or None after noting what is wrong with it."""
    name, dot, variable = text.partition(".")
    if name not in parts or not dot:
        problems.add(
            f"'{text}' names no part; write part.{kind}, the parts are {', '.join(parts)}."
        )
        return None
    model = parts[name]
    known = model.output_names if kind == "output" else model.input_names
    if variable not in known:
        listed = ", ".join(known) or "none"
        problems.add(f"'{text}' is no {kind}; the {kind}s of '{name}' are: {listed}.")
        return None
    return name, variable


def _same(one: str, other: str) -> bool:
    first, second = parse_unit(one), parse_unit(other)
    return (first.dimension, first.ratio, first.offset) == (
        second.dimension,
        second.ratio,
        second.offset,
    )


def _unit(parts: Mapping[str, Model], port: Port, kind: str) -> str:
    s = parts[port[0]].structure
    every: tuple[Input | Output, ...] = s.inputs if kind == "input" else s.outputs
    return next(v.unit for v in every if v.name == port[1])


def _inputs(
    parts: Mapping[str, Model],
    inputs: Mapping[str, str] | None,
    sources: Mapping[Port, Port],
    problems: Problems,
) -> dict[Port, str]:
    """Return the names outside of the inputs that have one."""
    if inputs is None:
        every = [(part, n) for part, model in parts.items() for n in model.input_names]
        return {port: "_".join(port) for port in every if port not in sources}
    found: dict[Port, str] = {}
    for name, text in inputs.items():
        port = _port(parts, text, "input", problems)
        if port is None:
            continue
        other = port_text(sources[port]) if port in sources else found.get(port)
        if other is not None:
            problems.add(f"The input '{text}' has two sources, '{other}' and '{name}';"
                         " leave one out.")  # fmt: skip
        found[port] = name
    return found


def _outputs(
    parts: Mapping[str, Model], outputs: Mapping[str, str] | None, problems: Problems
) -> dict[Port, str]:
    """Return the names outside of the outputs that have one; one name each."""
    if outputs is None:
        every = [(part, n) for part, model in parts.items() for n in model.output_names]
        return {port: "_".join(port) for port in every}
    found: dict[Port, str] = {}
    for name, text in outputs.items():
        port = _port(parts, text, "output", problems)
        if port is None:
            continue
        if port in found:
            problems.add(f"The output '{text}' is named twice outside, '{found[port]}' and"
                         f" '{name}'; leave one out.")  # fmt: skip
        found[port] = name
    return found


def _period(parts: Mapping[str, Model], problems: Problems) -> str | None:
    """Return the parameter that is the period of all sampled parts: that of the first of them."""
    periods = {
        f"{name}_{model.structure.period}": model.values[model.structure.period]
        for name, model in parts.items()
        if model.structure.period is not None
    }
    if len(set(periods.values())) > 1:
        listed = ", ".join(f"{name} = {value:g} s" for name, value in periods.items())
        problems.add(f"The sampled parts have different periods: {listed}; give them one.")
    return next(iter(periods), None)
