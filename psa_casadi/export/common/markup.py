"""What the descriptions of FMI 2.0 and FMI 3.0 have in common, and pages of HTML."""

import re
from collections.abc import Iterable
from xml.etree import ElementTree as ET

import casadi as ca
import numpy as np

from psa_casadi.common.characters import check_text
from psa_casadi.common.units import FloatArray, Unit
from psa_casadi.export.common.templates import filled
from psa_casadi.model.component import Expression
from psa_casadi.model.compose import Model
from psa_casadi.version import __version__

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
    """Return the model's description, else those of its components."""
    return model.description or "; ".join(c.description for c in model.components)


def describe(model: Model) -> str:
    """Return what the model is, how far its forces can be trusted, and its notes."""
    parts = (what_it_is(model), force_scale(model), *model.provenance.notes)
    return ". ".join(p.rstrip(".") for p in parts if p) + "."


def generation_tool() -> str:
    """Return name and version of this package."""
    return f"psa_casadi {__version__}"


def time_scale(model: Model) -> float:
    """Return the time in seconds that the model's slowest ordinary mode needs to settle.

    It is 4 / |lambda| of the smallest eigenvalue of df/dx at rest that is at least 1e-4 of the
    largest: slow creep and held hysteresis do not count. With sampled states, which are held in
    df/dx, it is at least 25 sample periods.
    """
    s = model.structure
    sampled = 25.0 * model.values[s.period] if s.period else 0.0
    if not s.states:
        return sampled
    rates = np.abs(np.linalg.eigvals(at_rest(model, ca.jacobian(s.xdot, s.x))))
    ordinary = rates[rates > 1e-4 * rates.max(initial=0.0)]
    return max(float(4.0 / ordinary.min()) if ordinary.size else 1.0, sampled)


def at_rest(model: Model, expression: Expression) -> FloatArray:
    """Return the value of an expression of the model where time, states and inputs are 0."""
    s = model.structure
    zeros = [np.zeros(len(part)) for part in (s.states, s.inputs)]
    held = [np.zeros(len(s.sampled))] if s.sampled else []
    function = ca.Function("at_rest", s.arguments, [ca.densify(expression)])
    return np.array(function(0.0, *zeros, model.parameter_vector(), *held))


def number(value: float) -> str:
    """Return the shortest text that reads back as the same double."""
    return repr(float(value))


def xml_text(template: str, **options: object) -> str:
    """Return an XML document from a template, indented anew; it ends with a line end.

    Raises InputError for a character that XML cannot carry, which a parser would stop at.
    """
    text = filled(template, **options)
    check_text(text, f"{re.findall(r'<(?:[a-z]+:)?([A-Za-z]+)', text)[0]}, an XML file,")
    for prefix, space in re.findall(r'xmlns:([a-z-]+)="([^"]+)"', text):
        ET.register_namespace(prefix, space)
    root = ET.fromstring(text)
    for element in root.iter():
        if (element.text or "").isspace():
            element.text = None
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def default_span(model: Model) -> float:
    """Return how long the default experiment takes [s].

    It has two digits, as the last ones of an eigenvalue differ from machine to machine.
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


def page(title: str, parts: Iterable[str], what: str) -> str:
    """Return a page of parts that are HTML already; empty ones are left out.

    Raises InputError for a character that HTML cannot carry; `what` names the page then.
    """
    text = filled("page.html", title=title, parts=list(parts))
    check_text(text, what)
    return text
