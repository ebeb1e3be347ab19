"""documentation/index.html: what is inside the FMU, in words, from the model's declarations."""

import math
import re
from collections.abc import Collection, Sequence

import numpy as np

from psa_casadi.common.characters import check_text
from psa_casadi.common.units import convert
from psa_casadi.export.common.icon import ICONS, drawing_of, svg
from psa_casadi.export.common.markup import force_scale, generation_tool, time_scale, what_it_is
from psa_casadi.export.common.publication import LICENSE_ENTRY
from psa_casadi.export.common.templates import filled
from psa_casadi.export.common.variable_table import Variable, starts_at_voltage, variable_table
from psa_casadi.export.fmu.evidence import META_DATA, PAGE, RELATED
from psa_casadi.export.fmu.reference_run import FOLDER, NOTES, SHARE, STEPS_PER_PERIOD, HeldStep
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import STACKS

ENTRY = "documentation/index.html"
#: Movement within the time that the model needs to settle, over the nominal size, that is none.
_AT_REST = 1e-6
#: Descriptions of files of the archive; the first two are always there.
_FILES = {
    "sources/README.txt": "how to compile the sources: one line, no other library",
    LICENSE_ENTRY: "the terms of the model, and the notices of the C code",
    NOTES: "a run to try an importer on, with the outputs to expect",
    f"{FOLDER}/parameters.ssv": "the parameter values as a parameter set (SSP 1.0)",
    PAGE: RELATED[PAGE][2],
    META_DATA: RELATED[META_DATA][2],
}
_ALWAYS = tuple(_FILES)[:2]
_KINDS = {
    "input": "Inputs",
    "output": "Outputs",
    "state": "States",
    "sampled": "Sampled states",
}


def documentation(
    model: Model,
    *,
    places: Collection[str] = (),
    step: HeldStep | None = None,
    use: str = "",
) -> str:
    """Return a page that needs no other file: equations, sources, tables.

    `places` are those of the files of the archive that it may name; `step` is the communication
    step that was measured on the reference run; `use` describes the integration where no solver
    does it.
    Raises InputError for a character that HTML cannot carry.
    """
    table, s = variable_table(model), model.structure
    rates, outputs = (np.array(v).ravel() for v in s.f(*model.at_start()))
    moved = np.abs(rates) * time_scale(model) / model.state_nominals()
    stated = model.publication.stated.items()
    starts = {v.name: v.start for v in table}
    starts |= dict(zip(model.output_names, outputs.tolist(), strict=True))
    interface = {
        title: [
            (v.name, v.unit, _text(v.nominal, v, 3), _text(starts[v.name], v), v.description)
            for v in table
            if v.kind == kind
        ]
        for kind, title in _KINDS.items()
    }
    text = filled(
        "documentation.html",
        model=model,
        title=model.name,
        drawing=svg(ICONS[drawing_of(model)]).partition("\n")[2].strip(),
        what_it_is=what_it_is(model),
        force_scale=force_scale(model),
        published="; ".join(f"{name}: {text}" for name, text in stated),
        use=use,
        period=next((v for v in table if v.name == s.period), None),
        quantity=_text,
        step=step,
        steps=STEPS_PER_PERIOD,
        share=SHARE,
        voltage=next((i.start for i in s.inputs if i.name == "voltage"), None),
        rests=np.max(moved, initial=0.0) < _AT_REST,
        settles=starts_at_voltage(model),
        interface=interface,
        indicators=[(v.name, v.description) for v in table if v.kind == "indicator"],
        components=_components(model),
        parameters=_parameters(model, table),
        files=[it for it in _FILES.items() if it[0] in places or it[0] in _ALWAYS],
        tool=generation_tool(),
    )
    check_text(text, "The page on the model")
    return text


def equations(model: Model) -> str:
    """Return the table of a model's components, with their equations and sources."""
    return filled("equations.html", components=_components(model)).rstrip("\n")


def _components(model: Model) -> list[tuple[str, ...]]:
    return [(c.name, c.description, c.equation_text, c.source) for c in model.components]


def _text(value: float | None, variable: Variable, digits: int = 6) -> str:
    """Return a value in the unit it is best read in."""
    if value is None:
        return ""
    unit = variable.display_unit or variable.unit
    text = f"{convert(value, variable.unit, unit):.{digits}g}"
    return text if unit == "1" else f"{text} {unit}"


def _parameters(model: Model, table: Sequence[Variable]) -> dict[str, object]:
    """Return heads and rows; a source is that of a value that is still the named stack's."""
    named = [k for k in STACKS.values() if re.sub(r"\W", "_", k.name) == model.name]
    figures = {n: f for k in named for n, f in k.values.items() if model.values.get(n) == f.value}
    rows = []
    for v in (v for v in table if v.kind == "parameter"):
        result, figure = model.provenance.intervals.get(v.name), figures.get(v.name)
        interval = f"{_text(result.low, v)} to {_text(result.high, v)}" if result else ""
        low, high = (_text(b, v) if math.isfinite(b) else "" for b in v.bounds or ())
        source = ("assumed: " if figure.assumed else "") + figure.source if figure else ""
        row = (v.name, _text(v.start, v), interval, f"{low} to {high}", v.description, source)
        rows.append(row)
    heads = ("name", "value", "95 % interval", "allowed", "meaning", "source of the value")
    kept = [i for i, _ in enumerate(heads) if i < 2 or any(r[i] for r in rows)]
    return {"heads": [heads[i] for i in kept], "rows": [[r[i] for i in kept] for r in rows]}
