"""A page to play with a stack: any voltage, any of the effects, nothing installed."""

import os
from typing import Any

from psa_casadi.components import BASE
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.export.web import web_module
from psa_casadi.files import atomic_write
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.live_data import live_data
from psa_casadi.report.page.live_fmu import fmu_figures, fmu_parts

#: The stack that a page has where no model is given, and where the answer to a step ends [kHz].
STACK, _BAND = "P-885.51", 100.0


def write_playground(path: str | os.PathLike[str], model: Model | None = None) -> None:
    """Write a page that runs a stack, by default the P-885.51, with every effect to switch on.

    Raises InputError for a model that is no stack, or a `path` that cannot be written to;
    MachineError without the `ziglang` compiler.
    """
    atomic_write(path, playground(model))


def playground(model: Model | None = None) -> str:
    """Return the page; see `write_playground`."""
    given = stack_model(STACK) if model is None else model
    if "voltage" not in given.input_names or "displacement" not in given.output_names:
        raise InputError(
            [f"The model '{given.name}' has no voltage input or no displacement output: no stack."]
        )
    whole = given.with_declared_starts()
    for effect in EFFECTS.values():
        if not {p.name for p in effect.parameters} & set(whole.parameter_names):
            whole = whole.with_effect(effect)
    title = next((n for n in STACKS if stack_model(n).name == given.name), given.name)
    page = Document(f"Play with {title}", ["every effect", "no network"])
    page.paragraph(
        "A piezo stack that runs in this page: give it a voltage, switch effects on, change what it"
        " is made of.",
        "verdict",
    )
    page.live(lambda: _told(given, whole, title))
    return page.text()


def _told(given: Model, whole: Model, title: str) -> dict[str, Any]:
    stacks = [_stack(given, whole, title, given.description)]
    # the terms of a model that states some are not those of other stacks
    if not given.publication.stated and {c.name for c in given.components} >= {
        c.name for c in BASE
    }:
        others = [name for name in STACKS if name != title]
        stacks += [
            _stack(stack_model(name), whole, name, STACKS[name].description) for name in others
        ]
    return {
        "kind": "playground",
        **live_data(whole, web_module(whole)),
        "stacks": stacks,
        "fmu": fmu_parts(whole),
        "of_effects": [p.name for c in whole.effects for p in c.parameters],
        "band": _BAND,
    }


def _stack(model: Model, whole: Model, name: str, description: str) -> dict[str, Any]:
    base = {p.name for c in whole.components if c.gain is None for p in c.parameters}
    values = {n: v for n, v in model.values.items() if n in base}
    chosen = whole.with_values(values)
    return {
        "name": name,
        "description": description,
        "values": values,
        "rated": model.values.get("u_rated", 1.0),
        "nominals": chosen.state_nominals().tolist(),
        "error_sizes": chosen.error_sizes().tolist(),
        "fmu": fmu_figures(chosen, model),
    }
