"""A Modelica package of a model: signals, connectors, examples, in one file of fixed text.

The class with pins and a flange replaces signals of a model by them. A flange is a
two-port: what the stack does to its load, the load does to the stack. The paper's one-way cascade
is none, since its bonding layers do not push back on the wafers. The class has the reaction,
`reciprocal_coupling` at a gain of 1, and its documentation states it.
"""

import os
import re
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path

import numpy as np
from markupsafe import Markup

from psa_casadi.common.characters import check_text
from psa_casadi.common.errors import Problems
from psa_casadi.common.files import atomic_write
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
from psa_casadi.model.compose import Model
from psa_casadi.model.effects.mechanics import reciprocal_coupling
from psa_casadi.model.shapes import stiffness_scale
from psa_casadi.model.variables import Input, nominal_value


def export_modelica(
    model: Model,
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    include_sensor: bool = False,
) -> Path:
    """Write a model as a Modelica package and return its path.

    Without a `name` it has that of `package_name`. The package has `Signal` (inputs and outputs),
    `Acausal` (pins and flange, where the model has the signals for them) and `Examples`. Sensor and
    environment stay out unless `include_sensor`. The same model gives the same text. The file is
    written whole or not at all.

    Raises InputError for an impossible name, values that are not finite, a text with a character
    that no document can carry, and an operation that Modelica does not have.
    """
    atomic_write(path, modelica_text(model, name=name, include_sensor=include_sensor))
    return Path(path)


def package_name(model: Model) -> str:
    """Return PiezoStack for a stack, else the model's name as Modelica writes it: VanDerPol."""
    if drawing_of(model) == "stack":
        return "PiezoStack"
    return "".join(word[:1].upper() + word[1:] for word in re.split(r"[\W_]+", model.name))


def modelica_text(model: Model, *, name: str | None = None, include_sensor: bool = False) -> str:
    """Return the text that `export_modelica` writes; raises what it raises."""
    name = package_name(model) if name is None else name
    check_identifier(name, "a Modelica package")
    refuse_foreign(model.structure, "Modelica")
    exported = model if include_sensor else model.plant()
    _refuse(exported)
    connectors, drawing = connectors_of(exported), drawing_of(exported)
    signal = documentation(exported, components=components_of(exported))
    classes = [class_text(exported, "Signal", "the model with plain inputs and outputs", signal)]
    if connectors:
        connected = reciprocal(exported)
        meaning = "the model with connectors of the Modelica Standard Library 4"
        acausal = documentation(
            connected, components=components_of(connected), wiring="output" in connectors,
            cascade=_is_cascade(connected),
        )  # fmt: skip
        classes.append(class_text(connected, "Acausal", meaning, acausal, connectors))
    rates = exported.structure.f(*exported.at_start())[0]
    rests = all(float(rate) == 0.0 for rate in rates.elements())
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
        annotation=documentation(exported, rests=rests, sampled=bool(exported.sampled_names)),
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
    return model.with_effect(reciprocal_coupling).with_values({"reciprocal_gain": 1.0})


def _is_cascade(model: Model) -> bool:
    return "cascade_mechanics" in (c.name for c in model.components)


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


def _kept(names: Mapping[str, str], inputs: Iterable[Input]) -> list[str]:
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
        "inputs": ", ".join([f"{names[first.name]}={swing}", *_kept(names, others)]),
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
        "kept": ", ".join(_kept(names, free)),
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


def documentation(model: Model, **more: object) -> str:
    """Return a Documentation annotation: what a model is, who publishes it, and `more` of it.

    That is a table of `components`; the `wiring` of pins and flange; the reaction in a `cascade`;
    of the package whether the states are at `rests`, and whether some are `sampled`.
    """
    terms = "; ".join(f"{name}: {text}" for name, text in model.publication.stated.items())
    about = [t for t in (describe(model), terms, f"Written by {generation_tool()}.") if t]
    every = dict.fromkeys(("components", "wiring", "cascade", "rests", "sampled")) | more
    text = filled("modelica.html", about=map(_plain, about), values=model.values, **every)
    return f"Documentation(info={string(text.rstrip())})"


def components_of(model: Model) -> list[list[str]]:
    """Return the components: what they are, their equations, their sources."""
    output = (
        (c.name, c.description, c.equation_text, c.source.rstrip(".")) for c in model.components
    )
    return [[_plain(cell) for cell in row] for row in output]


def _plain(text: str) -> Markup:
    """Return a text for HTML, with its quotes as they are."""
    return Markup(escape(text, quote=False))


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
