"""What the descriptions of FMI 2.0 and FMI 3.0 have in common, and pages of HTML."""

import html
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from xml.etree import ElementTree as ET

import casadi as ca
import numpy as np

from psa_casadi.characters import check_text
from psa_casadi.model.compose import Model
from psa_casadi.units import Unit

_FORCE_SCALE = {
    "assumed": "The force scale is assumed: only quantities scaled to displacement are identified;"
    " forces, masses, damping and stiffness share one unknown factor.",
    "given": "The force scale is fixed by a stiffness from outside the records.",
}


def force_scale(model: Model) -> str:
    """Return a sentence on how far the model's forces can be trusted; empty where it has none."""
    known = "k_L" in model.values
    return _FORCE_SCALE.get(model.provenance.force_scale, "") if known else ""


def what_it_is(model: Model) -> str:
    """Return the model's own description, else those of its components."""
    return model.description or "; ".join(c.description for c in model.components)


def describe(model: Model) -> str:
    """Return what the model is, how far its forces can be trusted, and its notes."""
    parts = (what_it_is(model), force_scale(model), *model.provenance.notes)
    return ". ".join(p.rstrip(".") for p in parts if p) + "."


def generation_tool() -> str:
    """Return name and version of this package."""
    try:
        return f"psa_casadi {version('psa-casadi')}"
    except PackageNotFoundError:
        return "psa_casadi"


def time_scale(model: Model) -> float:
    """Return the time in seconds that the model's slowest ordinary mode needs to settle.

    It is 4 / |lambda| of the smallest eigenvalue of df/dx at rest that is at least 1e-4 of the
    largest: slow creep and held hysteresis do not count. With sampled states, which are held in
    df/dx, it is at least 25 sample periods.
    """
    s = model.structure
    sampled = 25.0 * model.values[s.period] if s.period else 0.0
    return max(_continuous_scale(model), sampled) if s.states else sampled


def _continuous_scale(model: Model) -> float:
    s = model.structure
    slopes = ca.Function("slopes", s.arguments, [ca.jacobian(s.xdot, s.x)])
    rest = np.zeros(len(s.states))
    held = [np.zeros(len(s.sampled))] if s.sampled else []
    matrix = np.array(slopes(0.0, rest, np.zeros(len(s.inputs)), model.parameter_vector(), *held))
    rates = np.abs(np.linalg.eigvals(matrix))
    ordinary = rates[rates > 1e-4 * rates.max(initial=0.0)]
    return float(4.0 / ordinary.min()) if ordinary.size else 1.0


def number(value: float) -> str:
    """Return the shortest text that reads back as the same double."""
    return repr(float(value))


def xml_text(root: ET.Element) -> str:
    """Return an indented XML document that ends with a line end.

    Raises InputError for a character that XML cannot carry, which a parser would stop at.
    """
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode")
    check_text(text, f"{root.tag.rpartition('}')[2]}, an XML file,")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def default_span(model: Model) -> float:
    """Return how long the default experiment takes [s].

    Two digits are given, as the last ones of an eigenvalue differ from machine to machine.
    """
    return float(f"{40.0 * time_scale(model):.2g}")


def base_unit(unit: Unit) -> dict[str, str]:
    """Return a unit as FMI and SSP write it: exponents of the SI base units, factor, offset."""
    base = {symbol: str(power) for symbol, power in unit.base_exponents.items()}
    if unit.ratio != 1:
        base["factor"] = number(unit.factor)
    if unit.offset:
        base["offset"] = number(unit.offset)
    return base


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


def page(title: str, parts: Iterable[str], what: str) -> str:
    """Return a page of parts that are HTML already; empty ones are left out.

    Raises InputError for a character that HTML cannot carry; `what` names the page then.
    """
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>\n{_STYLE}</style>'
    body = "\n".join(p for p in parts if p)
    check_text(body, what)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def table_of(
    heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()
) -> str:
    """Return a table of texts, escaped; columns of `numbers` are aligned to the right."""
    top = "".join(f"<th>{html.escape(h)}</th>" for h in heads)
    lines = [f"<tr>{top}</tr>"]
    for row in rows:
        openings = ['<td class="number">' if i in numbers else "<td>" for i in range(len(row))]
        cells = [f"{o}{html.escape(c)}</td>" for o, c in zip(openings, row, strict=True)]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"
