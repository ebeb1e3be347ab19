"""A Modelica package of a model: signals, connectors, examples, in one file of fixed text."""

import os
from pathlib import Path

from psa_casadi.characters import check_text
from psa_casadi.errors import Problems
from psa_casadi.export.common.foreign import refuse_foreign
from psa_casadi.export.common.icon import drawing_of
from psa_casadi.export.modelica.acausal import acausal_lines, has_ports
from psa_casadi.export.modelica.annotations import about, documentation, equations_table, icon
from psa_casadi.export.modelica.class_text import class_lines
from psa_casadi.export.modelica.equations import is_symbol
from psa_casadi.export.modelica.examples import example_lines, example_names
from psa_casadi.export.modelica.words import check_identifier, string
from psa_casadi.files import atomic_write
from psa_casadi.model.compose import Model

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
