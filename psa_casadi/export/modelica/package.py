"""A Modelica package of a model: signals, connectors, examples, in one file of fixed text.

The class with pins and a flange says which signals of a model they stand for. A flange is a
two-port: what the stack does to its load, the load does to the stack. The paper's one-way cascade
is none, since its bonding layers do not push back on the wafers. The class has the reaction,
`reciprocal_coupling` at a gain of 1, and says so.
"""

import os
from pathlib import Path

import numpy as np

from psa_casadi.characters import check_text
from psa_casadi.effects.mechanics import RECIPROCAL_COUPLING
from psa_casadi.errors import Problems
from psa_casadi.export.common.icon import drawing_of
from psa_casadi.export.common.markup import time_scale
from psa_casadi.export.common.publication import refuse_foreign
from psa_casadi.export.modelica.class_text import (
    Ports,
    about,
    class_lines,
    documentation,
    equations_table,
    icon,
    size_text,
)
from psa_casadi.export.modelica.equations import is_symbol, variable_names
from psa_casadi.export.modelica.expression import (
    Identifiers,
    check_identifier,
    number,
    string,
    unit_text,
)
from psa_casadi.files import atomic_write
from psa_casadi.model.compose import Model
from psa_casadi.scales import stiffness_scale
from psa_casadi.variables import nominal_value

_PIN = "Modelica.Electrical.Analog.Interfaces"
_FLANGE = "Modelica.Mechanics.Translational.Interfaces"
#: Names of the connectors.
IDENTIFIERS = ("pin_p", "pin_n", "flange_a", "flange_b")

_WIRING = (
    "The pins are the terminals behind the amplifier's gain G: between them is G times the voltage"
    " command, and the current is what flows into the stack. The motion does not act back on the"
    " charge. The flange is the stack's output, its position the displacement from rest, with the"
    " other end clamped."
)


def has_ports(model: Model) -> bool:
    """Whether some signals of the model can be a pair of pins or a flange."""
    return bool(_electrical(model) or _output(model) or _tip(model))


def reciprocal(model: Model) -> Model:
    """Return the model with action and reaction between its two masses, if it has two."""
    if "cascade_mechanics" not in (c.name for c in model.components):
        return model
    return model.with_effect(RECIPROCAL_COUPLING).with_values({"reciprocal_gain": 1.0})


def acausal_lines(model: Model) -> list[str]:
    """Return the lines of the class `Acausal`."""
    connected = reciprocal(model)
    texts = [*about(connected), _WIRING if _output(connected) else "", _cascade_note(connected)]
    return class_lines(
        connected,
        "Acausal",
        "the model with connectors of the Modelica Standard Library 4",
        documentation(texts, equations_table(connected)),
        _ports(connected),
    )


def _ports(model: Model) -> Ports:
    declarations: list[str] = []
    equations = ["  // connectors"]
    inputs: set[str] = set()
    for given, own in (
        (_electrical(model), "voltage"),
        (_output(model), "load_force"),
        (_tip(model), "tip_position tip_velocity"),
    ):
        declarations += given[0] if given else ()
        equations += given[1] if given else ()
        inputs |= set(own.split()) if given else set()
    fixed = {"reciprocal_gain"} & set(model.parameter_names)
    return Ports(
        IDENTIFIERS, tuple(declarations), tuple(equations), frozenset(inputs), frozenset(fixed)
    )


Tied = tuple[tuple[str, ...], tuple[str, ...]]


def _has(model: Model, *names: str) -> bool:
    return {*names} <= {*model.input_names, *model.output_names}


def _electrical(model: Model) -> Tied | None:
    if not _has(model, "voltage", "current"):
        return None
    gain = "G*" if "G" in model.parameter_names else ""
    return (
        (_connector(f"{_PIN}.PositivePin pin_p", "positive terminal of the stack", -100, 50),
         _connector(f"{_PIN}.NegativePin pin_n", "negative terminal of the stack", -100, -50)),
        (f"  pin_p.v - pin_n.v = {gain}voltage;",
         "  pin_p.i = current;",
         "  pin_p.i + pin_n.i = 0;"),
    )  # fmt: skip


def _output(model: Model) -> Tied | None:
    if not _has(model, "displacement", "load_force"):
        return None
    flange = _connector(f"{_FLANGE}.Flange_b flange_b", "output of the stack", 100, 0)
    return (flange,), ("  flange_b.s = displacement;", "  flange_b.f = load_force;")


def _tip(model: Model) -> Tied | None:
    if not _has(model, "tip_position", "tip_velocity", "reaction_force"):
        return None
    flange = _connector(f"{_FLANGE}.Flange_a flange_a", "what the stack pushes on", -100, 0)
    return (
        (flange,),
        ("  tip_position = flange_a.s;",
         "  tip_velocity = der(flange_a.s);",
         "  flange_a.f = -reaction_force;"),
    )  # fmt: skip


def _connector(declaration: str, description: str, x: int, y: int) -> str:
    extent = f"{{{{{x - 10}, {y - 10}}}, {{{x + 10}, {y + 10}}}}}"
    return (
        f'  {declaration} "{description}"\n'
        f"    annotation(Placement(transformation(extent={extent})));"
    )


def _cascade_note(model: Model) -> str:
    """Return what the reaction changes; empty for a single mass."""
    if "cascade_mechanics" not in (c.name for c in model.components):
        return ""
    k_P, k_B = model.values["k_P"], model.values["k_B"]
    share = k_B / (k_P + k_B)
    return (
        "The paper's one-way cascade has no reaction of the bonding layers on the wafers, so that"
        " it cannot be a two-port. This class has it: reciprocal_gain = 1, action and reaction."
        f" With the same parameters the static stroke per force is k_B/(k_P + k_B) = {share:.4g}"
        " times that of the cascade at reciprocal_gain = 0, and the output's stiffness is that of"
        " wafers and bonding layers in series,"
        f" k_P k_B/(k_P + k_B) = {k_P * share:.4g} N/m in place of k_B = {k_B:.4g} N/m."
        " Where the parameters were found with the cascade, find them again"
        " with reciprocal_coupling at 1, or scale the forces (k_L, A, beta, gamma, delta, h_ref) by"
        " (k_P + k_B)/k_B for the same free stroke."
    )


_ANALOG = "Modelica.Electrical.Analog"
_MOTION = "Modelica.Mechanics.Translational.Components"

#: Where the parts of the wired example stand in its diagram.
_PLACES = {
    "stack": "transformation(extent={{-20, -20}, {20, 20}})",
    "source": "transformation(origin={-70, 0}, extent={{-20, -20}, {20, 20}}, rotation=270)",
    "ground": "transformation(extent={{-80, -60}, {-60, -40}})",
    "springDamper": "transformation(extent={{30, -10}, {50, 10}})",
    "mass": "transformation(extent={{60, -10}, {80, 10}})",
}
_BLUE, _GREEN = "0, 0, 255", "0, 127, 0"
_LOWER = "{-70, -30}, {-30, -30}, {-30, -10}, {-20, -10}"
_WIRES = (
    ("source.p", "stack.pin_p", "{-70, 20}, {-70, 30}, {-30, 30}, {-30, 10}, {-20, 10}", _BLUE),
    ("source.n", "stack.pin_n", f"{{-70, -20}}, {_LOWER}", _BLUE),
    ("ground.p", "stack.pin_n", f"{{-70, -40}}, {_LOWER}", _BLUE),
    ("stack.flange_b", "springDamper.flange_a", "{20, 0}, {30, 0}", _GREEN),
    ("springDamper.flange_b", "mass.flange_a", "{50, 0}, {60, 0}", _GREEN),
)


def example_lines(model: Model) -> list[str]:
    """Return the lines of the package `Examples`."""
    lines = ["package Examples " + string("ready to simulate"), *_indented(_sine(model))]
    if _can_be_wired(model):
        lines += _indented(_wired(model))
    return [*lines, "end Examples;"]


def example_names(model: Model) -> tuple[str, ...]:
    """Return the names of the examples that a model has."""
    driven = "Sine" if model.structure.inputs else "Free"
    return (driven, "Wired") if _can_be_wired(model) else (driven,)


def _indented(lines: list[str]) -> list[str]:
    return [f"  {line}" for line in lines]


def _span(model: Model) -> float:
    """Return the time to simulate [s]: 40 times what the model needs to settle.

    A stack is not quicker than the lag of its force and the charging of its capacitance.
    """
    try:
        scale = time_scale(model)
    except np.linalg.LinAlgError:  # the equations have no finite slope at rest
        scale = 1.0
    values = model.values
    lags = (values.get("tau", 0.0), values.get("R_s", 0.0) * values.get("C_p", 0.0))
    return float(f"{40.0 * max(scale, *lags):.2g}")


def _experiment(span: float) -> str:
    times = f"StartTime=0, StopTime={span!r}, Interval={float(f'{span / 1000.0:.2g}')!r}"
    return f"  annotation(experiment({times}, Tolerance=1e-8));"


def _sine(model: Model) -> list[str]:
    """The first input swings from its start value by its usual size and back, four times."""
    if not model.structure.inputs:
        head = 'model Free "from the start values, with no input"'
        return [head, "  extends Icons.Example;", "  Signal device;", _experiment(_span(model)),
                "end Free;"]  # fmt: skip
    first, *others = model.structure.inputs
    names = variable_names(model.structure, Identifiers())
    start = "" if first.start == 0 else f"{number(first.start, first.name)} + "
    size = size_text(nominal_value(first.nominal, model.values), first.name)
    swing = f"{start}0.5*height*(1 - cos(6.283185307179586*frequency*time))"
    kept = [f"{names[i.name]}={number(i.start, i.name)}" for i in others]
    return [
        'model Sine "a sine from rest on the first input, the others constant"',
        "  extends Icons.Example;",
        f"  parameter Real height(unit={string(unit_text(first.unit))}) = {size}",
        '    "how far the input swings";',
        f'  parameter Real frequency(unit="Hz") = {float(f"{4 / _span(model):.2g}")!r} "of it";',
        f"  Signal device({', '.join([f'{names[first.name]}={swing}', *kept])});",
        _experiment(_span(model)),
        "end Sine;",
    ]


def _can_be_wired(model: Model) -> bool:
    inputs = {"voltage", "load_force"} <= set(model.input_names)
    return inputs and {"current", "displacement"} <= set(model.output_names) and "k_L" in (
        model.values
    )  # fmt: skip


def _wired(model: Model) -> list[str]:
    """A voltage source drives the stack, which pushes a mass through a spring and a damper.

    The spring has a tenth of the stack's stiffness, the mass a hundred times what moves of the
    stack, the damper makes the mass on the spring well damped.
    """
    values = reciprocal(model).values
    stiffness = 0.1 * stiffness_scale(values)
    mass = 100.0 * (values["m_B"] + values["m_P"] if "m_B" in values else values["m"])
    damping = 0.6 * (stiffness * mass) ** 0.5
    peak = nominal_value(model.structure.inputs[model.input_names.index("voltage")].nominal, values)
    swing = 0.5 * values.get("G", 1.0) * peak
    span = float(f"{max(_span(model), 60.0 * (mass / stiffness) ** 0.5):.2g}")
    frequency = float(f"{4 / span:.2g}")
    c, d, m = (float(f"{v:.3g}") for v in (stiffness, damping, mass))
    free = [i for i in model.structure.inputs if i.name not in ("voltage", "load_force")]
    names = variable_names(model.structure, Identifiers(IDENTIFIERS))
    kept = ", ".join(f"{names[i.name]}={number(i.start, i.name)}" for i in free)
    places = {name: f"annotation(Placement({place}))" for name, place in _PLACES.items()}
    return [
        'model Wired "voltage source, stack, spring and damper, mass"',
        "  extends Icons.Example;",
        f"  Acausal stack({kept})" if kept else "  Acausal stack",
        f"    {places['stack']};",
        f"  {_ANALOG}.Sources.SineVoltage source(V={swing!r}, f={frequency!r}, offset={swing!r},",
        f"    phase=-1.5707963267948966) {places['source']};",
        f"  {_ANALOG}.Basic.Ground ground",
        f"    {places['ground']};",
        f"  {_MOTION}.SpringDamper springDamper(c={c!r}, d={d!r})",
        f"    {places['springDamper']};",
        f"  {_MOTION}.Mass mass(m={m!r}, s(start=0, fixed=true), v(start=0, fixed=true))",
        f"    {places['mass']};",
        "equation",
        *(line for wire in _WIRES for line in _connect(*wire)),
        _experiment(span),
        "end Wired;",
    ]


def _connect(left: str, right: str, points: str, colour: str) -> tuple[str, str]:
    line = f"annotation(Line(points={{{points}}}, color={{{colour}}}))"
    return f"  connect({left}, {right})", f"    {line};"


_USE = (
    "Signal needs no library. Acausal has pins and flanges of the Modelica Standard Library 4. All"
    " quantities are in SI units; "
)
_SAMPLING = (
    "The sampled states change at the multiples of their period from time 0 on, as sample(0, T)"
    " says, and are constant in between."
)


def export_modelica(
    model: Model,
    path: str | os.PathLike[str],
    *,
    name: str = "PiezoStack",
    include_sensor: bool = False,
) -> Path:
    """Write a model as a Modelica package and return its path.

    The package has `Signal` (inputs and outputs), `Acausal` (pins and flange, where the model has
    the signals for them) and `Examples`. Sensor and environment stay out unless `include_sensor`.
    The same model gives the same text. The file is written whole or not at all.

    Raises InputError for an impossible name, values that are not finite, a text with a character
    that no document can carry, and an operation that Modelica does not have.
    """
    atomic_write(path, modelica_text(model, name=name, include_sensor=include_sensor))
    return Path(path)


def modelica_text(model: Model, *, name: str = "PiezoStack", include_sensor: bool = False) -> str:
    """Return the text that `export_modelica` writes; raises what it raises."""
    check_identifier(name, "a Modelica package")
    refuse_foreign(model.structure, "Modelica")
    exported = model if include_sensor else model.plant()
    _refuse(exported)
    lines = [f"package {name} {string('model of a device, written by psa_casadi')}"]
    for part in _parts(exported):
        lines += ["", *(f"  {line}" if line else line for line in "\n".join(part).split("\n"))]
    uses = ', uses(Modelica(version="4.0.0"))' if has_ports(exported) else ""
    number = model.publication.version
    version = f", version={string(number)}" if number else ""
    sampled = [_SAMPLING] if exported.sampled_names else []
    text = documentation([*about(exported), _USE + _starts(exported), *sampled])
    whole = "\n".join([*lines, "", f"  annotation({text}{version}{uses});", f"end {name};", ""])
    check_text(whole, f"The Modelica package {name}")
    return whole


def class_names(model: Model) -> tuple[str, ...]:
    """Return the names of the classes that a package of a model has, its icons left out."""
    acausal = ("Acausal",) if has_ports(model) else ()
    return ("Signal", *acausal, *(f"Examples.{name}" for name in example_names(model)))


def _starts(model: Model) -> str:
    """Say whether the states rest where they start; an input starts at its own value."""
    s = model.structure
    groups = [[v.start for v in group] for group in (s.states, s.inputs)]
    held = [[v.start for v in s.sampled]] if s.sampled else []
    rates = s.f(0.0, *groups, model.parameter_vector(), *held)[0]
    if all(float(rate) == 0.0 for rate in rates.elements()):
        return "states start at rest."
    return "states start at their start values, from where they move even if the inputs do not."


def _parts(model: Model) -> list[list[str]]:
    signal = class_lines(
        model,
        "Signal",
        "the model with plain inputs and outputs",
        documentation(about(model), equations_table(model)),
    )
    parts = [signal]
    if has_ports(model):
        parts.append(acausal_lines(model))
    return [*parts, example_lines(model), _icons(drawing_of(model))]


def _icons(drawing: str) -> list[str]:
    shown = {"stack": "a stack of wafers", "block": "a plain block"}[drawing]
    drawn = [f"  {line}" for line in icon(drawing)]
    play = "Polygon(points={{-40, 60}, {60, 0}, {-40, -60}}, fillPattern=FillPattern.Solid)"
    ellipse = "Ellipse(extent={{-100, -100}, {100, 100}})"
    return [
        'package Icons "drawings"',
        f'  partial model {drawing.capitalize()} "{shown}"',
        *drawn,
        f"  end {drawing.capitalize()};",
        '  partial model Example "an example"',
        f"    annotation(Icon(graphics={{{ellipse}, {play}}}));",
        "  end Example;",
        "end Icons;",
    ]


def _refuse(model: Model) -> None:
    """Refuse a model that has no state, or outputs that share a name with another variable."""
    problems = Problems()
    if not (model.structure.states or model.structure.sampled):
        problems.add(f"The model '{model.name}' has no state; add a component that has one.")
    others = {*model.input_names, *model.state_names, *model.parameter_names, *model.sampled_names}
    for name in sorted(others.intersection(model.output_names)):
        problems.add(
            f"Two variables of '{model.name}' are named '{name}', which Modelica does not allow;"
            " rename one."
        )
    for name in sorted(
        model.structure.balance_table.keys() & model.structure.out.keys() & {*model.output_names}
    ):
        if not is_symbol(model.structure.out[name], name):
            problems.add(
                f"The output '{name}' of '{model.name}' differs from the balance of that name;"
                " rename the output."
            )
    problems.raise_if_any()
