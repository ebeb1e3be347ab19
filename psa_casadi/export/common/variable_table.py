"""The variables of an exported model in the order of their value references."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import rate_unit
from psa_casadi.model.compose import Model
from psa_casadi.model.shapes import velocity_scale
from psa_casadi.model.variables import Input, Output, State, nominal_value


@dataclass(frozen=True)
class Variable:
    """One variable as FMI describes it, in SI units.

    `kind` is time, state, derivative, input, output, parameter, indicator (zero where a derivative
    has a kink), sampled (a state that changes at sample instants only) or option (how the FMU
    starts and takes its inputs, no part of the model); `index` is its place in the vector of its
    kind; the value reference is the place in the table, from 1 on. Only a state, an input, a
    parameter, an option and a sampled state have a `start`; a derivative has no nominal; an
    indicator, of which only the sign counts, has neither unit nor nominal.
    """

    name: str
    kind: str
    index: int
    unit: str
    description: str
    display_unit: str | None = None
    start: float | None = None
    nominal: float | None = None
    bounds: tuple[float, float] | None = None


#: Share of the largest velocity, stroke times resonance, that runs reach: solvers of importers take
#: their absolute tolerance from the nominal value of a state. With 1 CVode's velocity erred by its
#: whole range, with 0.01 CVode gave up on the ringing of an underdamped stack.
_REACHED = 0.1
#: How an importer without derivatives of inputs (FMI 3.0) gets along with coarse steps.
INPUT_LINE = Variable(
    "input_line", "option", 0, "1",
    "co-simulation: 1 continues inputs along the line through their last two values, 0 holds them",
    None, 0.0, 1.0, (0.0, 1.0),
)  # fmt: skip


#: Name and place, among the options, of the parameter that settles an instance at a voltage.
START_VOLTAGE, START_INDEX = "start_voltage", 1
#: The parameters that are no part of a model.
OPTIONS = (INPUT_LINE.name, START_VOLTAGE)


def starts_at_voltage(model: Model) -> bool:
    """Whether an FMU of the model has the parameter `start_voltage`.

    It has a voltage to be held at, and nothing in it waits for a sample instant.
    """
    return "voltage" in model.input_names and not model.structure.sampled


def variable_table(model: Model) -> tuple[Variable, ...]:
    """Return time, states, derivatives, inputs, outputs, parameters, indicators, sampled states.

    Last come the options: where there are inputs `input_line` of co-simulation, and `start_voltage`
    where a voltage is among them.

    This is the layout of `fmi_data.h`. The indicator of a switch is named `switch.<name>`, as FMI's
    structured names have parentheses for der() only.

    Raises InputError if two variables share a name or the model has no state.
    """
    s, values = model.structure, model.values

    def declared(kind: str, listed: Sequence[State | Input | Output]) -> Iterator[Variable]:
        for i, q in enumerate(listed):
            share = _REACHED if kind == "state" and q.nominal is velocity_scale else 1.0
            start = None if isinstance(q, Output) else q.start
            size = share * nominal_value(q.nominal, values)
            yield Variable(q.name, kind, i, q.unit, q.description, q.display_unit, start, size)

    table = [
        Variable("time", "time", 0, "s", "simulation time"),
        *declared("state", s.states),
        *(
            Variable(f"der({q.name})", "derivative", i, rate_unit(q.unit),
                     f"rate of {q.description}")
            for i, q in enumerate(s.states)
        ),
        *declared("input", s.inputs),
        *declared("output", s.outputs),
        *(
            Variable(q.name, "parameter", i, q.unit, q.description, q.display_unit, values[q.name],
                     abs(values[q.name]) or q.typical(values), q.bounds)
            for i, q in enumerate(s.parameters)
        ),
        *(
            Variable(f"switch.{name}", "indicator", i, "",
                     f"zero where derivatives have a kink: {name.replace('_', ' ')}")
            for i, name in enumerate(s.switches)
        ),
        *declared("sampled", s.sampled),
        *([INPUT_LINE] if s.inputs else []),
    ]  # fmt: skip
    if starts_at_voltage(model):
        voltage = next(v for v in table if v.kind == "input" and v.name == "voltage")
        meaning = (
            "voltage at which it starts settled; at this value with the start values stated here"
        )
        option = replace(
            voltage, name=START_VOLTAGE, kind="option", index=START_INDEX, description=meaning
        )
        table.append(option)
    _refuse(model, table)
    return tuple(table)


def _refuse(model: Model, table: list[Variable]) -> None:
    names = [v.name for v in table]
    problems = [
        f"Two variables of '{model.name}' are named '{name}', which FMI does not allow; rename one."
        for name in sorted({n for n in names if names.count(n) > 1})
    ]
    problems += [
        f"A variable of '{model.name}' is named {name!r}; quotes, backslashes and control"
        " characters cannot stand in the sources of an FMU: rename it."
        for name in names
        if re.search(r'["\\\x00-\x1f\ud800-\udfff]', name)
    ]
    if not (model.structure.states or model.structure.sampled):
        problems.append(f"The model '{model.name}' has no state; add a component that has one.")
    if problems:
        raise InputError(problems)
