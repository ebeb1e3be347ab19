"""What the descriptions of FMI 2.0 and FMI 3.0 have in common, from the variable table."""

import math
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from xml.etree import ElementTree as ET

import casadi as ca
import numpy as np

from psa_casadi.characters import check_text
from psa_casadi.export.common.variable_table import Variable
from psa_casadi.model.compose import Model
from psa_casadi.units import Unit, parse_unit

#: Log categories; the last one is shown only when debug logging is on.
LOG_CATEGORIES = {
    "logStatusWarning": "calls that succeeded, but look wrong",
    "logStatusDiscard": "steps and evaluations that failed and may be retried",
    "logStatusError": "calls that are not allowed or impossible",
    "logSolver": "cost of each communication step",
}

_CONTINUOUS = {"variability": "continuous"}

#: Causality, variability and initial of each kind of variable; the same words in both versions.
CAUSALITY = {
    "time": {"causality": "independent", **_CONTINUOUS},
    "state": {"causality": "local", **_CONTINUOUS, "initial": "exact"},
    "derivative": {"causality": "local", **_CONTINUOUS, "initial": "calculated"},
    "input": {"causality": "input", **_CONTINUOUS},
    "output": {"causality": "output", **_CONTINUOUS, "initial": "calculated"},
    "parameter": {"causality": "parameter", "variability": "tunable", "initial": "exact"},
    "option": {"causality": "parameter", "variability": "fixed", "initial": "exact"},
    "indicator": {"causality": "local", **_CONTINUOUS, "initial": "calculated"},
    "sampled": {"causality": "local", "variability": "discrete", "initial": "exact"},
}

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


def log_categories(root: ET.Element) -> None:
    """Append the LogCategories."""
    categories = ET.SubElement(root, "LogCategories")
    for name, meaning in LOG_CATEGORIES.items():
        ET.SubElement(categories, "Category", {"name": name, "description": meaning})


def default_span(model: Model) -> float:
    """Return how long the default experiment takes [s].

    Two digits are given, as the last ones of an eigenvalue differ from machine to machine.
    """
    return float(f"{40.0 * time_scale(model):.2g}")


def default_experiment(root: ET.Element, model: Model) -> None:
    """Append the DefaultExperiment: 40 times what the model needs to settle, in 1000 steps."""
    span = default_span(model)
    experiment = {"startTime": "0", "stopTime": number(span), "tolerance": "1e-05"}
    ET.SubElement(root, "DefaultExperiment", {**experiment, "stepSize": number(span / 1000.0)})


def unit_definitions(root: ET.Element, table: Iterable[Variable]) -> None:
    """Append the UnitDefinitions: each unit in use and each display unit, sorted."""
    displays: dict[str, set[str]] = {}
    for variable in table:
        if variable.unit:
            shown = displays.setdefault(variable.unit, set())
            shown |= {variable.display_unit} if variable.display_unit else set()
    definitions = ET.SubElement(root, "UnitDefinitions")
    for name in sorted(displays):
        unit = parse_unit(name)
        element = ET.SubElement(definitions, "Unit", {"name": name})
        if all(isinstance(power, int) for power in unit.exponents):  # FMI has no m2.5
            ET.SubElement(element, "BaseUnit", base_unit(unit))
        for shown_name in sorted(displays[name]):
            ET.SubElement(element, "DisplayUnit", _display(unit, shown_name))


def base_unit(unit: Unit) -> dict[str, str]:
    """Return a unit as FMI and SSP write it: exponents of the SI base units, factor, offset."""
    base = {symbol: str(power) for symbol, power in unit.base_exponents.items()}
    if unit.ratio != 1:
        base["factor"] = number(unit.factor)
    if unit.offset:
        base["offset"] = number(unit.offset)
    return base


def _display(unit: Unit, name: str) -> dict[str, str]:
    """Return the DisplayUnit: value shown = factor * value + offset."""
    shown = parse_unit(name)
    ratio = unit.ratio / shown.ratio
    attributes = {"name": name, "factor": number(float(ratio))}
    if unit.offset != shown.offset:
        attributes["offset"] = number((unit.offset - shown.offset) / shown.factor)
    return attributes


def type_name(unit: str) -> str | None:
    """Return the name of the type that variables of a unit have; None for a compound unit."""
    quantity = parse_unit(unit).quantity if unit else ""
    return quantity.title().replace(" ", "") if quantity else None


def types_in_use(table: Iterable[Variable]) -> dict[str, str]:
    """Return the unit of each type that variables have, by the type's name, sorted."""
    units = sorted({v.unit for v in table})
    return dict(sorted((name, unit) for unit in units if (name := type_name(unit))))


def value_attributes(variable: Variable) -> dict[str, str]:
    """Return the attributes of a Real (FMI 2) or Float64 (FMI 3) that speak of its value."""
    attributes = {}
    if variable.unit:
        attributes["unit"] = variable.unit
    if declared := type_name(variable.unit):
        attributes["declaredType"] = declared
    if variable.display_unit:
        attributes["displayUnit"] = variable.display_unit
    for name, bound in zip(("min", "max"), variable.bounds or (), strict=False):
        if math.isfinite(bound):
            attributes[name] = number(bound)
    if variable.nominal is not None:
        attributes["nominal"] = number(abs(variable.nominal))
    if variable.start is not None:
        attributes["start"] = number(variable.start)
    return attributes
