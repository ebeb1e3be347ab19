"""The package `Examples`: a sine on the signals, and the stack wired to a load."""

import numpy as np

from psa_casadi.export.common.markup import time_scale
from psa_casadi.export.modelica.acausal import IDENTIFIERS, reciprocal
from psa_casadi.export.modelica.class_text import size_text
from psa_casadi.export.modelica.equations import variable_names
from psa_casadi.export.modelica.words import Identifiers, number, string, unit_text
from psa_casadi.model.compose import Model
from psa_casadi.scales import stiffness_scale
from psa_casadi.variables import nominal_value

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
