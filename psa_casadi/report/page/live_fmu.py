"""A model as a page can hand it out: the sources of its FMU, with values that are set there.

A page has no compiler. It holds the FMU of FMI 3.0 as `export_fmu` writes it, but for the binaries
and what speaks of one set of values: reference runs, tables of parameters, MODEL.json.
"""

from dataclasses import replace
from typing import Any

from psa_casadi.errors import InputError
from psa_casadi.export.common.markup import default_span, describe, page
from psa_casadi.export.common.publication import LICENSE_ENTRY, license_text
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.documentation import ENTRY as DOCUMENTATION_ENTRY
from psa_casadi.export.fmu.documentation import equations
from psa_casadi.export.fmu.sources import exported_texts, switch_scales
from psa_casadi.export.fmu.terminals import terminal_entries
from psa_casadi.model.compose import Model
from psa_casadi.report.page.packed import packed
from psa_casadi.variables import Provenance

#: What stands in the texts for the model's name.
NAME = "psa_name_in_page"
_README = "sources/README.txt"
#: Kinds of variables whose usual size follows from the values of parameters.
_SIZED = ("state", "input", "output", "option")


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
    entries |= {
        DOCUMENTATION_ENTRY: _documentation(blank).encode(),
        LICENSE_ENTRY: license_text(blank, 3).encode(),
        "modelDescription.xml": xml.encode(),
    }
    marks = [m.encode() for m in (NAME, token)]
    files = [[n, len(e), any(m in e for m in marks)] for n, e in sorted(entries.items())]
    content = b"".join(entry for _, entry in sorted(entries.items()))
    return {"name": NAME, "token": token, "files": files, "packed": packed(content)}


def _documentation(model: Model) -> str:
    """Return a page of the equations, which hold whatever the values are."""
    parts = [
        f"<h1>{NAME}</h1>",
        "<p>Start values are in modelDescription.xml; an effect is off while its gain is 0.</p>",
        f'<p>To compile the sources: <a href="../{_README}">{_README}</a>. The terms:'
        f' <a href="../{LICENSE_ENTRY}">{LICENSE_ENTRY}</a>.</p>',
        "<h2>Equations</h2>",
        equations(model),
    ]
    return page(NAME, parts, "The page on the model")


def fmu_figures(model: Model, about: Model) -> dict[str, Any]:
    """Return what an FMU of the model has from its values, but for the values themselves, in SI.

    It is what `about` is: usual sizes by name, the noise of the switches, the span of the
    default experiment [s], a description.
    """
    table = variable_table(model)
    states = [abs(v.nominal or 1.0) for v in table if v.kind == "state"]
    return {
        "sizes": {v.name: abs(v.nominal) for v in table if v.kind in _SIZED and v.nominal},
        "scales": switch_scales(model, states),
        "span": default_span(model),
        "description": describe(about),
    }
