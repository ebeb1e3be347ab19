"""One Modelica class from a model: declarations by component, one equation per balance."""

import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from psa_casadi.export.common.icon import ICONS, SIDE, Rectangle, drawing_of
from psa_casadi.export.common.markup import describe, generation_tool
from psa_casadi.export.modelica.equations import (
    ModelEquations,
    Variable,
    model_equations,
    when_lines,
)
from psa_casadi.export.modelica.expression import (
    comment,
    escaped,
    modifier,
    number,
    string,
    unit_text,
)
from psa_casadi.model.compose import Model
from psa_casadi.variables import Input, Output, Parameter, State, nominal_value

_WIDTH = 100


@dataclass(frozen=True)
class Ports:
    """What a class has in place of plain inputs: connectors and the equations that tie them.

    `inputs` are the model's inputs that the connectors determine, `fixed` the parameters that
    cannot be changed.
    """

    identifiers: tuple[str, ...] = ()
    declarations: tuple[str, ...] = ()
    equations: tuple[str, ...] = ()
    inputs: frozenset[str] = frozenset()
    fixed: frozenset[str] = frozenset()


def class_lines(
    model: Model, name: str, description: str, annotation: str, ports: Ports | None = None
) -> list[str]:
    """Return the lines of a model class; its icon is a stack's or a plain one.

    Raises InputError for values that are not finite and for what Modelica cannot write.
    """
    ports = ports or Ports()
    equations = model_equations(model, ports.identifiers)
    lines = [f"  extends Icons.{drawing_of(model).capitalize()};", *ports.declarations]
    lines += [*_signals(model, equations, ports), *_components(model, equations, ports)]
    hidden = _protected(model, equations, ports)
    lines += ["protected", *hidden] if hidden else []
    lines += ["equation", *_equation_lines(model, equations), *ports.equations]
    lines.append(f"  annotation({annotation});")
    return [f"model {name} {string(description)}", *lines, f"end {name};"]


def _signals(model: Model, equations: ModelEquations, ports: Ports) -> list[str]:
    structure, names = model.structure, equations.names
    lines = [
        _input(model, i, names[i.name]) for i in structure.inputs if i.name not in ports.inputs
    ]
    prefix = "output Real" if not ports.declarations else "Real"
    return lines + [_output(model, o, names[o.name], prefix) for o in structure.outputs]


def _input(model: Model, it: Input, name: str, prefix: str = "input Real") -> str:
    start = number(it.start, f"The start of input '{it.name}'")
    nominal = _nominal(model, it)
    attributes = (*_units(it), ("start", start), ("nominal", nominal))
    return f"  {prefix} {name}{modifier(attributes)} {string(it.description)};"


def _output(model: Model, it: Output, name: str, prefix: str) -> str:
    attributes = (*_units(it), ("nominal", _nominal(model, it)))
    return f"  {prefix} {name}{modifier(attributes)} {string(it.description)};"


def _units(it: Input | Output | Parameter | State) -> tuple[tuple[str, str | None], ...]:
    shown = string(unit_text(it.display_unit)) if it.display_unit else None
    return ("unit", string(unit_text(it.unit))), ("displayUnit", shown)


def _nominal(model: Model, it: Input | Output | State) -> str:
    return size_text(nominal_value(it.nominal, model.values), it.name)


def size_text(size: float, name: str) -> str:
    """Return the usual size of a variable with three digits."""
    number(size, f"The usual size of '{name}'")
    return repr(float(f"{abs(size):.3g}"))


def _components(model: Model, equations: ModelEquations, ports: Ports) -> list[str]:
    """Return parameters, states and sampled states under a comment that names their component."""
    lines = []
    names, states = equations.names, {s.name: s for s in model.structure.states}
    for component in model.components:
        own = [_parameter(model, p, names[p.name], ports) for p in component.parameters]
        own += [_state(model, states[s.name], names[s.name]) for s in component.states]
        own += [_state(model, s, names[s.name], "discrete Real") for s in component.sampled]
        if own:
            lines += ["  " + comment(f"{component.name}: {component.description}"), *own]
    return lines


def _parameter(model: Model, it: Parameter, name: str, ports: Ports) -> str:
    low, high = (
        number(bound, f"A bound of '{it.name}'") if not math.isinf(bound) else None
        for bound in it.bounds
    )
    attributes = (*_units(it), ("min", low), ("max", high))
    value = number(model.values[it.name], f"Parameter '{it.name}'")
    prefix = "final parameter Real" if it.name in ports.fixed else "parameter Real"
    return f"  {prefix} {name}{modifier(attributes)} = {value} {string(it.description)};"


def _state(model: Model, it: State, name: str, prefix: str = "Real") -> str:
    start = number(it.start, f"The start of state '{it.name}'")
    attributes = (
        *_units(it),
        ("start", start),
        ("fixed", "true"),
        ("nominal", _nominal(model, it)),
    )
    return f"  {prefix} {name}{modifier(attributes)} {string(it.description)};"


def _protected(model: Model, equations: ModelEquations, ports: Ports) -> list[str]:
    lines = [
        _input(model, i, equations.names[i.name], "Real")
        for i in model.structure.inputs
        if i.name in ports.inputs
    ]
    public = {equations.names[o.name] for o in model.structure.outputs}
    hidden = [v for v in (*equations.balances, *equations.parts) if v.name not in public]
    lines += [_variable(v) for v in hidden]
    return lines + [_variable(v, "discrete Real") for v in equations.sampled_parts]


def _variable(it: Variable, prefix: str = "Real") -> str:
    attributes = [("unit", string(it.unit) if it.unit else None)]
    if prefix != "Real":
        attributes += [("start", "0.0"), ("fixed", "true")]
    return f"  {prefix} {it.name}{modifier(attributes)} {string(it.description)};"


def _equation_lines(model: Model, equations: ModelEquations) -> list[str]:
    lines = []
    if equations.parts:
        lines.append("  // what several equations use")
        lines += _flat(_wrapped(f"{v.name} = {v.text}") for v in equations.parts)
    if equations.balances:
        lines.append("  // balances: sums of what the components add")
        lines += _flat(_balance(v) for v in equations.balances)
    for component in model.components:
        if component.states:
            lines.append("  " + comment(f"{component.name}: {component.source.rstrip('.')}"))
            own = [s.name for s in component.states]
            lines += _flat(
                _wrapped(f"der({equations.names[n]}) = {equations.derivatives[n]}") for n in own
            )
    if model.structure.period is not None:
        parts = [_wrapped(f"{v.name} = {v.text}") for v in equations.sampled_parts]
        following = equations.following.items()
        sides = {n: _wrapped(f"{equations.names[n]} = {text}") for n, text in following}
        lines += when_lines(model, equations.names[model.structure.period], parts, sides)
    if equations.outputs:
        lines.append("  // outputs")
        lines += _flat(
            _wrapped(f"{equations.names[n]} = {text}") for n, text in equations.outputs.items()
        )
    return lines


def _flat(groups: Iterable[Sequence[str]]) -> list[str]:
    return [line for group in groups for line in group]


def _balance(it: Variable) -> list[str]:
    """Return a balance in one line, or with a line and a component's name for each term."""
    owners = ", ".join(dict.fromkeys(owner for _, owner in it.terms if owner))
    line = f"  {it.name} = {it.text}; // {owners}" if owners else f"  {it.name} = {it.text};"
    if len(line) <= _WIDTH or len(it.terms) < 2:
        return [line] if len(line) <= _WIDTH else _wrapped(f"{it.name} = {it.text}")
    lines = [f"  {it.name} ="]
    for i, (text, owner) in enumerate(it.terms):
        end = ";" if i == len(it.terms) - 1 else ""
        parts = _wrapped(text, "    ", end)
        lines += [*parts[:-1], f"{parts[-1]} // {owner}" if owner else parts[-1]]
    return lines


def _wrapped(text: str, indent: str = "  ", end: str = ";") -> list[str]:
    """Break an equation at spaces; Modelica takes a line's end for one."""
    return textwrap.wrap(
        text + end,
        width=_WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + "  ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def icon(name: str) -> list[str]:
    """Return the lines of an Icon annotation of one of the drawings in `ICONS`, and its label."""
    label = 'Text(extent={{-150, 140}, {150, 105}}, textString="%name", textColor={0, 0, 255})'
    shapes = [*map(_rectangle, ICONS[name]), label]
    lines = [f"    {shape}," for shape in shapes]
    lines[-1] = lines[-1].removesuffix(",")
    return ["  annotation(Icon(graphics={", *lines, "  }));"]


def _rectangle(shape: Rectangle) -> str:
    """Return a rectangle in a Modelica icon's coordinates, -100 to 100 with y upward."""
    left, right = (_across(x) for x in (shape.left, shape.left + shape.width))
    top, bottom = (0.0 - _across(y) for y in (shape.top, shape.top + shape.height))
    red, green, blue = (int(shape.colour[i : i + 2], 16) for i in (1, 3, 5))
    colour = f"{{{red}, {green}, {blue}}}"
    corners = f"{{{{{left:g}, {bottom:g}}}, {{{right:g}, {top:g}}}}}"
    fill = f"lineColor={colour}, fillColor={colour}, fillPattern=FillPattern.Solid"
    return f"Rectangle(extent={corners}, {fill})"


def _across(place: int) -> float:
    """Return where a place between 0 and SIDE is between -100 and 100."""
    return round(200 * place / SIDE - 100, 1)


def documentation(paragraphs: Sequence[str], table: str = "") -> str:
    """Return a Documentation annotation of paragraphs, plain texts, and a table in HTML."""
    body = "".join(f"<p>{escaped(p)}</p>\n" for p in paragraphs if p)
    return f"Documentation(info={string(f'<html>{chr(10)}{body}{table}</html>')})"


def equations_table(model: Model) -> str:
    """Return an HTML table of the components: what they are, their equations, their sources."""
    heads = "".join(f"<th>{h}</th>" for h in ("component", "what it is", "equation", "source"))
    rows = [
        (c.name, c.description, c.equation_text, c.source.rstrip(".")) for c in model.components
    ]
    lines = [f"<tr>{''.join(f'<td>{escaped(cell)}</td>' for cell in row)}</tr>" for row in rows]
    return "\n".join(["<table>", f"<tr>{heads}</tr>", *lines, "</table>", ""])


def about(model: Model) -> list[str]:
    """Return what the model is, who publishes it on what terms, and which program wrote it."""
    said = "; ".join(f"{name}: {text}" for name, text in model.publication.stated.items())
    return [describe(model), said, f"Written by {generation_tool()}."]
