"""A page to play with a stack: any voltage, any of the effects, nothing installed.

A page has no compiler. It holds the FMU of FMI 3.0 as `export_fmu` writes it, but for the binaries
and what speaks of one set of values: reference runs, tables of parameters, MODEL.json.
"""

import os
from dataclasses import replace
from typing import Any

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_write
from psa_casadi.export.common.markup import default_span, describe, page
from psa_casadi.export.common.publication import LICENSE_ENTRY, license_text
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.documentation import ENTRY as DOCUMENTATION_ENTRY
from psa_casadi.export.fmu.documentation import equations
from psa_casadi.export.fmu.sources import exported_texts, switch_scales
from psa_casadi.export.fmu.terminals import terminal_entries
from psa_casadi.export.web import web_module
from psa_casadi.model.components import BASE
from psa_casadi.model.compose import Model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.model.variables import Provenance
from psa_casadi.report.page.document import packed, render
from psa_casadi.report.page.live import live_data

#: The stack of a page without a model, and the end of the frequency response [kHz].
STACK, _BAND = "P-885.51", 100.0
#: The placeholder of the model's name in the texts.
NAME = "psa_name_in_page"
_README = "sources/README.txt"
#: Kinds of variables whose usual size follows from the values of parameters.
_SIZED = ("state", "input", "output", "option")


def write_playground(path: str | os.PathLike[str], model: Model | None = None) -> None:
    """Write a page that runs a stack, by default the P-885.51, with every effect to switch on.

    Raises InputError for a model that is no stack, or a `path` that cannot be written to;
    MachineError without the `ziglang` compiler.
    """
    atomic_write(path, playground(model))


def playground(model: Model | None = None) -> str:
    """Return the page; see `write_playground`."""
    stack = stack_model(STACK) if model is None else model
    if "voltage" not in stack.input_names or "displacement" not in stack.output_names:
        raise InputError(
            [f"The model '{stack.name}' has no voltage input or no displacement output: no stack."]
        )
    whole = stack.with_declared_starts()
    for effect in EFFECTS.values():
        if not {p.name for p in effect.parameters} & set(whole.parameter_names):
            whole = whole.with_effect(effect)
    title = next((n for n in STACKS if stack_model(n).name == stack.name), stack.name)
    stacks = [_stack(stack, whole, title, stack.description)]
    # the terms of a model that states some are not those of other stacks
    names = {c.name for c in stack.components}
    if not stack.publication.stated and names >= {c.name for c in BASE}:
        others = [name for name in STACKS if name != title]
        stacks += [_stack(stack_model(n), whole, n, STACKS[n].description) for n in others]
    data = {
        "kind": "playground",
        **live_data(whole, web_module(whole)),
        "stacks": stacks,
        "fmu": fmu_parts(whole),
        "of_effects": [p.name for c in whole.effects for p in c.parameters],
        "band": _BAND,
    }
    badges = ["every effect", "no network"]
    return render("playground.html", f"Play with {title}", badges, data=data)


def _stack(model: Model, whole: Model, name: str, description: str) -> dict[str, Any]:
    base = {p.name for c in whole.base for p in c.parameters}
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


def fmu_parts(model: Model) -> dict[str, Any] | None:
    """Return what live_fmu.js makes an FMU of; None for a model that no FMU describes.

    `files` lists place, length [bytes] and whether it is edited, in the order in which they are
    `packed`; `token` is the one in the texts.
    """
    blank = replace(model, name=NAME, provenance=Provenance(), evidence=None)
    try:
        token, texts, xml = exported_texts(blank, NAME, fmi=3)
    except InputError:
        return None
    entries = {f"sources/{n}": t.encode() for n, t in texts.items()} | terminal_entries(blank)
    parts = [
        f"<h1>{NAME}</h1>",
        "<p>Start values are in modelDescription.xml; an effect is off while its gain is 0.</p>",
        f'<p>To compile the sources: <a href="../{_README}">{_README}</a>. The terms:'
        f' <a href="../{LICENSE_ENTRY}">{LICENSE_ENTRY}</a>.</p>',
        "<h2>Equations</h2>",
        equations(blank),  # which hold whatever the values are
    ]
    entries |= {
        DOCUMENTATION_ENTRY: page(NAME, parts, "The page on the model").encode(),
        LICENSE_ENTRY: license_text(blank, 3).encode(),
        "modelDescription.xml": xml.encode(),
    }
    marks = [m.encode() for m in (NAME, token)]
    files = [[n, len(e), any(m in e for m in marks)] for n, e in sorted(entries.items())]
    content = b"".join(entry for _, entry in sorted(entries.items()))
    return {"name": NAME, "token": token, "files": files, "packed": packed(content)}


def fmu_figures(model: Model, about: Model) -> dict[str, Any]:
    """Return what an FMU of the model has from its values, but for the values themselves, in SI.

    It is what `about` is: usual sizes by name, the noise of the switches, the span of the
    default experiment [s], a description.
    """
    variables = variable_table(model)
    states = [abs(v.nominal or 1.0) for v in variables if v.kind == "state"]
    return {
        "sizes": {v.name: abs(v.nominal) for v in variables if v.kind in _SIZED and v.nominal},
        "scales": switch_scales(model, states),
        "span": default_span(model),
        "description": describe(about),
    }
