"""documentation/index.html: what is inside the FMU, in words, from the model's declarations."""

import html
import math
import re
from collections.abc import Iterable, Sequence

from psa_casadi.export.common.icon import ICONS, drawing_of, svg
from psa_casadi.export.common.markup import force_scale, generation_tool, what_it_is
from psa_casadi.export.common.variable_table import Variable, variable_table
from psa_casadi.export.fmu.reference_results import FOLDER, NOTES
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import STACKS, Figure
from psa_casadi.units import convert

ENTRY = "documentation/index.html"

_STYLE = """\
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 svg { width: 3rem; height: 3rem; vertical-align: middle; margin-right: .6rem; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th, td { text-align: left; vertical-align: top; padding: .25rem .8rem .25rem 0; }
tr { border-bottom: 1px solid #8884; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
code { font-size: .95em; }
p.note { border-left: .25rem solid #e69f00; padding-left: .8rem; }
"""

_USE = """\
Co-simulation integrates with an error-controlled, L-stable method to the tolerance that the
importer gives (1e-6 if it gives none). Model exchange leaves that to the importer; the event
indicators say where derivatives have a kink, which a solver with loose tolerances may ignore.
Parameters are tunable: they can be set between steps. Directional derivatives with respect to
states, inputs and parameters are exact."""


_SAMPLING = """\
The sampled states change at the instants k {period}, k a whole number, on the absolute time axis
(now every {value}), and are held in between. In model exchange the instants are time events. In
co-simulation the steps of the solver end at them, wherever the communication points are; an instant
that is a communication point belongs to the step that starts there: outputs read at that point
already follow from the inputs set there, which may be set again before the step."""


_INPUTS = """\
Over a communication step each input moves at the rate that the importer gave it for the step (FMI
2.0: fmi2SetRealInputDerivatives); without one it is held, and a smooth signal arrives half a step
late. FMI 3.0 has no such rates. To err by 0.1 % of the range of a sine of frequency f, one that is
held needs steps of 1/(1600 f). With the parameter input_line = 1, which can be set until the
initialization ends, an input goes on along the line through the last two values it was given (over
a step longer than the last one, by as much as over that); then 1/(200 f) does, and the error falls
with the square of the step. What is left is that the signal bends: at the end of a step the line
is off by the square of the step times the second derivative, most where the signal turns, and
hysteresis remembers that it went too far. The first step is held, and so is the one after event
mode. Values before and after a jump have no line in common: enter event mode at a jump, or leave
the option at 0. Between 0 and 1 that share of the slope counts. Model exchange knows no steps and
ignores the option."""


def documentation(model: Model, *, reference_run: bool = True) -> str:
    """Return a page of its own, without any file beside it: equations, sources, tables.

    `reference_run` says whether the archive holds one, with its notes.
    """
    table = variable_table(model)
    name = html.escape(model.name)
    drawing = svg(ICONS[drawing_of(model)]).partition("\n")[2].strip()
    scale = force_scale(model)
    parts = [
        f"<h1>{drawing}{name}</h1>",
        f"<p>{html.escape(what_it_is(model))}</p>",
        f'<p class="note">{html.escape(scale)}</p>' if scale else "",
        *(f"<p>{html.escape(note)}</p>" for note in model.provenance.notes),
        "<h2>Use</h2>",
        f"<p>{_USE}</p>",
        f"<p>{_INPUTS}</p>" if model.input_names else "",
        _sampling(model, table),
        *_interface(table),
        "<h2>Equations</h2>",
        _equations(model),
        "<h2>Parameters</h2>",
        _parameters(model, table),
        "<h2>Files</h2>",
        _files(reference_run),
        f"<p>Written by {html.escape(generation_tool())}.</p>",
    ]
    head = f'<meta charset="utf-8"><title>{name}</title><style>\n{_STYLE}</style>'
    body = "\n".join(p for p in parts if p)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _rows(heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return a table of texts, escaped; columns of `numbers` are aligned to the right."""
    top = "".join(f"<th>{html.escape(h)}</th>" for h in heads)
    lines = [f"<tr>{top}</tr>"]
    for row in rows:
        openings = ['<td class="number">' if i in numbers else "<td>" for i in range(len(row))]
        cells = [f"{o}{html.escape(c)}</td>" for o, c in zip(openings, row, strict=True)]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"


def _shown(value: float | None, variable: Variable, digits: int = 6) -> str:
    """Return a value in the unit it is best read in."""
    if value is None:
        return ""
    unit = variable.display_unit or variable.unit
    shown = f"{convert(value, variable.unit, unit):.{digits}g}"
    return shown if unit == "1" else f"{shown} {unit}"


def _sampling(model: Model, table: Sequence[Variable]) -> str:
    period = next((v for v in table if v.name == model.structure.period), None)
    if period is None:
        return ""
    return f"<p>{_SAMPLING.format(period=period.name, value=_shown(period.start, period))}</p>"


def _interface(table: Sequence[Variable]) -> list[str]:
    kinds = (
        ("input", "Inputs"), ("output", "Outputs"), ("state", "States"),
        ("sampled", "Sampled states"),
    )  # fmt: skip
    parts = []
    for kind, title in kinds:
        chosen = [v for v in table if v.kind == kind]
        rows = [(v.name, v.unit, _shown(v.nominal, v, 3), v.description) for v in chosen]
        if rows:
            parts += [f"<h2>{title}</h2>", _rows(("name", "unit", "usual size", ""), rows, (2,))]
    indicators = [(v.name, v.description) for v in table if v.kind == "indicator"]
    if indicators:
        parts += ["<h2>Event indicators</h2>", _rows(("name", ""), indicators)]
    return parts


def _equations(model: Model) -> str:
    rows = [(c.name, c.description, c.equation_text, c.source) for c in model.components]
    return _rows(("component", "what it is", "equation", "source"), rows)


def _figures(model: Model) -> dict[str, Figure]:
    """Return the sources of the values that are still those of the named stack."""
    for stack in STACKS.values():
        if re.sub(r"\W", "_", stack.name) == model.name:
            values = model.values
            return {n: f for n, f in stack.values.items() if values.get(n) == f.value}
    return {}


def _parameters(model: Model, table: Sequence[Variable]) -> str:
    intervals, figures = model.provenance.intervals, _figures(model)
    rows = []
    for v in (v for v in table if v.kind == "parameter"):
        found = intervals.get(v.name)
        interval = f"{_shown(found.low, v)} to {_shown(found.high, v)}" if found else ""
        low, high = (_shown(b, v) if math.isfinite(b) else "" for b in v.bounds or ())
        figure = figures.get(v.name)
        source = ("assumed: " if figure.assumed else "") + figure.source if figure else ""
        name_and_value = (v.name, _shown(v.start, v), interval)
        rows.append((*name_and_value, f"{low} to {high}", v.description, source))
    heads = ("name", "value", "95 % interval", "allowed", "meaning", "source of the value")
    kept = [i for i, _ in enumerate(heads) if i < 2 or any(r[i] for r in rows)]
    chosen = [[r[i] for i in kept] for r in rows]
    return _rows([heads[i] for i in kept], chosen, (1,))


def _files(reference_run: bool) -> str:
    entries = [("sources/README.txt", "how to compile the sources: one line, no other library")]
    if reference_run:
        entries += [
            (NOTES, "a run to try an importer on, with the outputs to expect"),
            (f"{FOLDER}/parameters.ssv", "the parameter values as a parameter set (SSP 1.0)"),
        ]
    items = (
        f'<li><a href="../{place}"><code>{place}</code></a>: {meaning}</li>'
        for place, meaning in entries
    )
    return "<ul>\n" + "\n".join(items) + "\n</ul>"
