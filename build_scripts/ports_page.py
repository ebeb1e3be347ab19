"""Hook of mkdocs: the page of ports is made from the models that are exported."""

from collections.abc import Iterable, Iterator
from typing import Any

from build_scripts.effects_page import markdown_table
from psa_casadi.design.mechanism.mechanism import port_model
from psa_casadi.model.component import Component
from psa_casadi.model.components import COMPONENTS
from psa_casadi.model.compose import Model, Structure
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.nanopositioner import nanopositioner
from psa_casadi.model.parts import PARTS, part_model
from psa_casadi.model.stacks import stack_model
from psa_casadi.model.variables import Input, Output
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table

PAGE = "ports.md"
STACK = "P-885.51"
#: Components that a further column of a record adds.
_SENSORS = ("monitor", "second_sensor", "strain_gauge")
_HEAD = ("port", "", "unit", "start", "positive where", "meaning")
#: What is going on where a port is positive, by its name. Outward is the way a stack grows.
_LONGER, _GROWS = "the stack is longer", "the stack grows"
_RESISTS = "it pulls the stack outward; what resists the stack is negative"
POSITIVE = {
    "voltage": _LONGER,
    "load_force": "it pulls outward; a weight on the stack or a spring that it presses is negative",
    "temperature": "always: absolute",
    "current": "charge flows into the stack",
    "charge": "the voltage is",
    "displacement": _LONGER,
    "measured_displacement": _LONGER,
    "displacement_2": _LONGER,
    "strain": _LONGER,
    "velocity": _GROWS,
    "blocked_force": "the stack pushes outward",
    "monitor_voltage": "the voltage is",
    "outside_validity": "the model extrapolates; never negative",
    "tip_position": _LONGER,
    "tip_velocity": _GROWS,
    "tip_acceleration": "the stack gains speed outward",
    "prestress_force": _RESISTS,
    "reaction_force": _RESISTS,
    "dissipated_energy": "never negative",
    "wanted": "the stack is to grow",
    "stage_position": "the stage has moved outward",
    "stack_displacement": _LONGER,
    "reference": "the stage is to move outward",
    "position": "what is measured has moved outward",
    "command": "the stack is to grow (of a positive gain)",
    "compensated_command": "the stack is to grow",
    "hysteresis_force": "it lengthens the stack",
    "output_voltage": "the stack is longer",
    "load_current": "charge flows into the load",
    "load_charge": "the voltage at the load is",
    "sensed_charge": "the charge on the load is",
    "correction": "the stack is to grow",
    "prediction_error": "more was measured than predicted",
}


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return the text of a page, the one of ports with all of them below."""
    return "\n\n".join([markdown, *sections()]) if page.file.src_uri == PAGE else markdown


def sections() -> Iterator[str]:
    """Yield the ports of a stack, of what can be added to it, of the parts and of the system."""
    stack = stack_model(STACK).plant()
    yield "## A stack\n\n`psa export fmu --stack NAME` or `--model MODEL.json`; Modelica and C too."
    yield port_table(stack)
    yield "## A stack with more\n\nThese are added to the ports above."
    yield markdown_table(Table(("with", *_HEAD), tuple(_further(stack))))
    yield "## Parts\n\n`psa export fmu --part NAME`, or `psa.part_model` with your values."
    for name, kind in PARTS.items():
        yield f"### `{name}`\n\n{kind.description[0].upper()}{kind.description[1:]}."
        yield port_table(part_model(name))
    loop = nanopositioner(STACK)
    yield (
        f"## The closed loop\n\n`psa export ssp`: {loop.description}. Its parts"
        f" ({', '.join(loop.parts)}) have the ports above."
    )
    yield port_table(loop.model())


def port_table(model: Model) -> str:
    """Return the inputs and outputs of a model in Markdown."""
    return markdown_table(
        Table(_HEAD, tuple(_rows(model.structure.inputs, model.structure.outputs)))
    )


def _rows(inputs: Iterable[Input], outputs: Iterable[Output]) -> Iterator[tuple[str, ...]]:
    """Yield the row of each port; an estimate has the sign of its quantity."""
    ports: list[tuple[str, str, Input | Output]] = []
    ports += [("in", number(p.start, 5), p) for p in inputs]
    ports += [("out", "follows", q) for q in outputs]
    for way, start, q in ports:
        positive = "what is estimated is" if q.name.endswith("_hat") else POSITIVE[q.name]
        yield f"`{q.name}`", way, q.unit, start, positive, q.description


def _further(stack: Model) -> Iterator[tuple[str, ...]]:
    """Yield the ports that effects, options and sensors add to a stack, with what adds them."""
    whole, outside = stack_model(STACK), "`--include-sensor`"
    adding: list[tuple[str, Component | Structure]] = [
        *((f"effect `{e.name}`", e) for e in EFFECTS.values()),
        (outside, whole.structure),
        ("`psa design mechanism --port`", port_model(whole).structure),
        ("`--validity-output`", COMPONENTS["validity"]),
        *(("a record with the column", COMPONENTS[n]) for n in _SENSORS),
    ]
    for adds, source in adding:
        how = adds if getattr(source, "in_plant", True) else f"{adds}, {outside}"
        inputs = [p for p in source.inputs if p.name not in stack.input_names]
        outputs = [q for q in source.outputs if q.name not in stack.output_names]
        yield from ((how, *row) for row in _rows(inputs, outputs))
