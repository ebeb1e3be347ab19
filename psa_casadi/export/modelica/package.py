"""A Modelica package of a model: signals, connectors, examples, in one file of fixed text.

The class with pins and a flange says which signals of a model they stand for. A flange is a
two-port: what the stack does to its load, the load does to the stack. The paper's one-way cascade
is none, since its bonding layers do not push back on the wafers. The class has the reaction,
`reciprocal_coupling` at a gain of 1, and says so.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np
from markupsafe import Markup

from psa_casadi.characters import check_text
from psa_casadi.effects.mechanics import RECIPROCAL_COUPLING
from psa_casadi.errors import Problems
from psa_casadi.export.common.icon import ICONS, SIDE, drawing_of
from psa_casadi.export.common.markup import describe, generation_tool, time_scale
from psa_casadi.export.common.publication import refuse_foreign
from psa_casadi.export.common.templates import filled
from psa_casadi.export.modelica.class_text import (
    CONNECTORS,
    IDENTIFIERS,
    class_text,
    is_symbol,
    size_text,
    variable_names,
)
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
from psa_casadi.variables import Input, nominal_value

_WIRING = (
    "The pins are the terminals behind the amplifier's gain G: between them is G times the voltage"
    " command, and the current is what flows into the stack. The motion does not act back on the"
    " charge. The flange is the stack's output, its position the displacement from rest, with the"
    " other end clamped."
)
_USE = (
    "Signal needs no library. Acausal has pins and flanges of the Modelica Standard Library 4. All"
    " quantities are in SI units; "
)
_SAMPLING = (
    "The sampled states change at the multiples of their period from time 0 on, as sample(0, T)"
    " says, and are constant in between."
)
_RESTS = "states start at rest."
_MOVES = "states start at their start values, from where they move even if the inputs do not."


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
    connectors, drawing = connectors_of(exported), drawing_of(exported)
    signal = documentation(about(exported), equations_table(exported))
    classes = [class_text(exported, "Signal", "the model with plain inputs and outputs", signal)]
    if connectors:
        connected = reciprocal(exported)
        wiring = _WIRING if "output" in connectors else ""
        texts = [*about(connected), wiring, _cascade_note(connected)]
        meaning = "the model with connectors of the Modelica Standard Library 4"
        acausal = documentation(texts, equations_table(connected))
        classes.append(class_text(connected, "Acausal", meaning, acausal, connectors))
    rates = exported.structure.f(*exported.at_start())[0]
    rests = all(float(rate) == 0.0 for rate in rates.elements())
    used = _USE + (_RESTS if rests else _MOVES)
    sampled = [_SAMPLING] if exported.sampled_names else []
    version = model.publication.version
    whole = filled(
        "package.mo",
        name=name,
        classes=[text.rstrip("\n") for text in classes],
        connectors=connectors,
        experiment=_experiment(_span(exported)),
        sine=_sine(exported),
        wired=_wired(exported) if _can_be_wired(exported) else None,
        drawing=drawing,
        rectangles=[_rectangle(*shape) for shape in ICONS[drawing]],
        annotation=documentation([*about(exported), used, *sampled]),
        version=string(version) if version else "",
    )
    check_text(whole, f"The Modelica package {name}")
    return whole


def class_names(model: Model) -> tuple[str, ...]:
    """Return the names of the classes that a package of a model has, its icons left out."""
    acausal = ("Acausal",) if connectors_of(model) else ()
    driven = "Sine" if model.structure.inputs else "Free"
    wired = ("Examples.Wired",) if _can_be_wired(model) else ()
    return ("Signal", *acausal, f"Examples.{driven}", *wired)


def connectors_of(model: Model) -> tuple[str, ...]:
    """Return the connectors that some signals of the model can be."""
    known = {*model.input_names, *model.output_names}
    return tuple(c for c, (wanted, _) in CONNECTORS.items() if {*wanted} <= known)


def reciprocal(model: Model) -> Model:
    """Return the model with action and reaction between its two masses, if it has two."""
    if not _is_cascade(model):
        return model
    return model.with_effect(RECIPROCAL_COUPLING).with_values({"reciprocal_gain": 1.0})


def _is_cascade(model: Model) -> bool:
    return "cascade_mechanics" in (c.name for c in model.components)


def _cascade_note(model: Model) -> str:
    """Return what the reaction changes; empty for a single mass."""
    if not _is_cascade(model):
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
    interval = float(f"{span / 1000.0:.2g}")
    times = f"StartTime=0, StopTime={span!r}, Interval={interval!r}"
    return f"experiment({times}, Tolerance=1e-8)"


def _kept(model: Model, names: Mapping[str, str], inputs: Iterable[Input]) -> list[str]:
    """Return what holds inputs at their start values."""
    return [f"{names[i.name]}={number(i.start, i.name)}" for i in inputs]


def _sine(model: Model) -> dict[str, str]:
    """The first input swings from its start value by its usual size and back, four times."""
    if not model.structure.inputs:
        return {}
    first, *others = model.structure.inputs
    names = variable_names(model.structure, Identifiers())
    start = "" if first.start == 0 else f"{number(first.start, first.name)} + "
    swing = f"{start}0.5*height*(1 - cos(6.283185307179586*frequency*time))"
    return {
        "unit": string(unit_text(first.unit)),
        "height": size_text(nominal_value(first.nominal, model.values), first.name),
        "frequency": repr(float(f"{4 / _span(model):.2g}")),
        "inputs": ", ".join([f"{names[first.name]}={swing}", *_kept(model, names, others)]),
    }


def _can_be_wired(model: Model) -> bool:
    inputs = {"voltage", "load_force"} <= {*model.input_names}
    return inputs and {"current", "displacement"} <= {*model.output_names} and "k_L" in model.values


def _wired(model: Model) -> dict[str, str]:
    """A voltage source drives the stack, which pushes a mass through a spring and a damper.

    The spring has a tenth of the stack's stiffness, the mass a hundred times what moves of the
    stack, the damper makes the mass on the spring well damped.
    """
    values, inputs = reciprocal(model).values, {i.name: i for i in model.structure.inputs}
    stiffness = 0.1 * stiffness_scale(values)
    mass = 100.0 * (values["m_B"] + values["m_P"] if "m_B" in values else values["m"])
    damping = 0.6 * (stiffness * mass) ** 0.5
    swing = 0.5 * values.get("G", 1.0) * nominal_value(inputs["voltage"].nominal, values)
    span = float(f"{max(_span(model), 60.0 * (mass / stiffness) ** 0.5):.2g}")
    names = variable_names(model.structure, Identifiers(IDENTIFIERS))
    free = [i for n, i in inputs.items() if n not in ("voltage", "load_force")]
    loads = {"c": stiffness, "d": damping, "m": mass}
    return {
        "swing": repr(swing),
        "frequency": repr(float(f"{4 / span:.2g}")),
        "kept": ", ".join(_kept(model, names, free)),
        "experiment": _experiment(span),
        **{name: repr(float(f"{value:.3g}")) for name, value in loads.items()},
    }


def _rectangle(left: int, top: int, width: int, height: int, colour: str) -> tuple[str, str]:
    """Return extent and colour in a Modelica icon's coordinates, -100 to 100 with y upward."""
    x1, x2, y2, y1 = (
        round(200 * v / SIDE - 100, 1) for v in (left, left + width, top, top + height)
    )
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    extent = f"{{{{{x1:g}, {0.0 - y1:g}}}, {{{x2:g}, {0.0 - y2:g}}}}}"
    return extent, f"{{{red}, {green}, {blue}}}"


def documentation(paragraphs: Sequence[str], table: str = "") -> str:
    """Return a Documentation annotation of paragraphs, plain texts, and a table in HTML."""
    body = "".join(f"<p>{escape(p, quote=False)}</p>\n" for p in paragraphs if p)
    return f"Documentation(info={string(f'<html>{chr(10)}{body}{table}</html>')})"


def equations_table(model: Model) -> str:
    """Return an HTML table of the components: what they are, their equations, their sources."""
    told = (
        (c.name, c.description, c.equation_text, c.source.rstrip(".")) for c in model.components
    )
    rows = [[Markup(escape(cell, quote=False)) for cell in row] for row in told]
    return filled("equations.html", components=rows)


def about(model: Model) -> list[str]:
    """Return what the model is, who publishes it on what terms, and which program wrote it."""
    said = "; ".join(f"{name}: {text}" for name, text in model.publication.stated.items())
    return [describe(model), said, f"Written by {generation_tool()}."]


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
    out, balances = model.structure.out, model.structure.balance_table.keys()
    for name in sorted(balances & out.keys() & {*model.output_names}):
        if not is_symbol(out[name], name):
            problems.add(
                f"The output '{name}' of '{model.name}' differs from the balance of that name;"
                " rename the output."
            )
    problems.raise_if_any()
