"""One Modelica class from a model: declarations by component, one equation per balance."""

import math
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence

from psa_casadi.export.common.icon import drawing_of
from psa_casadi.export.common.templates import filled
from psa_casadi.export.modelica.equations import (
    ModelEquations,
    Variable,
    model_equations,
    when_lines,
)
from psa_casadi.export.modelica.expression import comment, modifier, number, string, unit_text
from psa_casadi.model.compose import Model
from psa_casadi.variables import Input, Output, Parameter, State, nominal_value

_WIDTH = 100
#: What a connector stands for, and those of its signals that it determines.
CONNECTORS = {
    "pins": (("voltage", "current"), ("voltage",)),
    "output": (("displacement", "load_force"), ("load_force",)),
    "tip": (
        ("tip_position", "tip_velocity", "reaction_force"),
        ("tip_position", "tip_velocity"),
    ),
}
#: Names of the connectors.
IDENTIFIERS = ("pin_p", "pin_n", "flange_a", "flange_b")


def class_text(
    model: Model, name: str, description: str, annotation: str, connectors: Collection[str] = ()
) -> str:
    """Return the text of a model class; its icon is a stack's or a plain one.

    With `connectors` these stand in the place of inputs and outputs, and the gain of the reaction
    is fixed. Raises InputError for values that are not finite and for what Modelica cannot write.
    """
    s = model.structure
    equations = model_equations(model, IDENTIFIERS if connectors else ())
    names = equations.names
    given = {n for c in connectors for n in CONNECTORS[c][1]}
    shown = "Real" if connectors else "output Real"

    def declared(its: Iterable[Input | Output], prefix: str) -> list[str]:
        return [_declaration(model, it, names[it.name], prefix) for it in its]

    public = {names[o.name] for o in s.outputs}
    hidden = [v for v in (*equations.balances, *equations.parts) if v.name not in public]
    return filled(
        "class.mo",
        name=name,
        description=description,
        annotation=annotation,
        connectors=connectors,
        gained="G" in model.parameter_names,
        drawing=drawing_of(model),
        declarations=[
            *declared((i for i in s.inputs if i.name not in given), "input Real"),
            *declared(s.outputs, shown),
            *_components(model, names, fixed=("reciprocal_gain",) if connectors else ()),
        ],
        hidden=[
            *declared((i for i in s.inputs if i.name in given), "Real"),
            *(_variable(v) for v in hidden),
            *(_variable(v, "discrete Real") for v in equations.sampled_parts),
        ],
        equations=_equation_lines(model, equations),
    )


def _components(model: Model, names: Mapping[str, str], fixed: Collection[str]) -> list[str]:
    """Return parameters, states and sampled states under a comment that names their component."""
    lines: list[str] = []
    states = {s.name: s for s in model.structure.states}
    for component in model.components:
        own: list[tuple[Parameter | State, str]] = [
            (p, "final parameter Real" if p.name in fixed else "parameter Real")
            for p in component.parameters
        ]
        own += [(states[s.name], "Real") for s in component.states]
        own += [(s, "discrete Real") for s in component.sampled]
        if own:
            lines.append("  " + comment(f"{component.name}: {component.description}"))
            lines += [_declaration(model, it, names[it.name], prefix) for it, prefix in own]
    return lines


def _declaration(
    model: Model, it: Input | Output | Parameter | State, name: str, prefix: str
) -> str:
    shown = string(unit_text(it.display_unit)) if it.display_unit else None
    stated, value = {"unit": string(unit_text(it.unit)), "displayUnit": shown}, ""
    if isinstance(it, Parameter):
        for end, bound in zip(("min", "max"), it.bounds, strict=True):
            if not math.isinf(bound):
                stated[end] = number(bound, f"A bound of '{it.name}'")
        value = " = " + number(model.values[it.name], f"Parameter '{it.name}'")
    else:
        if not isinstance(it, Output):
            kind = "input" if isinstance(it, Input) else "state"
            stated["start"] = number(it.start, f"The start of {kind} '{it.name}'")
        if isinstance(it, State):
            stated["fixed"] = "true"
        stated["nominal"] = size_text(nominal_value(it.nominal, model.values), it.name)
    return f"  {prefix} {name}{modifier(stated.items())}{value} {string(it.description)};"


def size_text(size: float, name: str) -> str:
    """Return the usual size of a variable with three digits."""
    number(size, f"The usual size of '{name}'")
    return repr(float(f"{abs(size):.3g}"))


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
