"""The file modelDescription.xml of FMI 2.0, written from the variable table.

Source: FMI 2.0.5, sections 2.2 (schema), 3.3.1 (model exchange) and 4.3.1 (co-simulation).
"""

import math
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from xml.etree import ElementTree as ET

import casadi as ca
import numpy as np

from psa_casadi.export.dependencies import dependencies
from psa_casadi.export.variable_table import Variable, variable_table
from psa_casadi.model.compose import Model, Structure
from psa_casadi.units import Unit, parse_unit

#: Log categories; the last one is shown only when debug logging is on.
LOG_CATEGORIES = {
    "logStatusWarning": "calls that succeeded, but look wrong",
    "logStatusDiscard": "steps and evaluations that failed and may be retried",
    "logStatusError": "calls that are not allowed or impossible",
    "logSolver": "cost of each communication step",
}

_CAUSALITY = {
    "time": {"causality": "independent", "variability": "continuous"},
    "state": {"causality": "local", "variability": "continuous", "initial": "exact"},
    "derivative": {"causality": "local", "variability": "continuous", "initial": "calculated"},
    "input": {"causality": "input", "variability": "continuous"},
    "output": {"causality": "output", "variability": "continuous", "initial": "calculated"},
    "parameter": {"causality": "parameter", "variability": "tunable", "initial": "exact"},
}

_FORCE_SCALE = {
    "assumed": "The force scale is assumed: only quantities scaled to displacement are identified;"
    " forces, masses, damping and stiffness share one unknown factor.",
    "given": "The force scale is fixed by a stiffness from outside the records.",
}


def model_description(model: Model, identifier: str, token: str, sources: Sequence[str]) -> str:
    """Return the XML text; `token` is the GUID, `sources` the C files in the folder sources."""
    table = variable_table(model)
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": "2.0",
            "modelName": model.name,
            "guid": token,
            "description": describe(model),
            "generationTool": generation_tool(),
            "variableNamingConvention": "structured",
            "numberOfEventIndicators": "0",
        },
    )
    _interfaces(root, identifier, sources)
    _units(root, table)
    _types(root, table)
    categories = ET.SubElement(root, "LogCategories")
    for name, meaning in LOG_CATEGORIES.items():
        ET.SubElement(categories, "Category", {"name": name, "description": meaning})
    span = 40.0 * time_scale(model)
    experiment = {"startTime": "0", "stopTime": _number(span), "tolerance": "1e-06"}
    ET.SubElement(root, "DefaultExperiment", {**experiment, "stepSize": _number(span / 1000.0)})
    variables = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(table):
        _variable(variables, reference, variable)
    _structure(ET.SubElement(root, "ModelStructure"), model.structure, table)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def describe(model: Model) -> str:
    """Return what the model is, what it contains and how far its forces can be trusted."""
    parts = [model.description or "; ".join(c.description for c in model.components)]
    if "k_L" in model.values:
        parts.append(_FORCE_SCALE.get(model.provenance.force_scale, ""))
    return ". ".join(p.rstrip(".") for p in (*parts, *model.provenance.notes) if p) + "."


def generation_tool() -> str:
    """Return name and version of this package."""
    try:
        return f"psa_casadi {version('psa-casadi')}"
    except PackageNotFoundError:
        return "psa_casadi"


def time_scale(model: Model) -> float:
    """Return the time in seconds that the model's slowest ordinary mode needs to settle.

    It is 4 / |lambda| of the smallest eigenvalue of df/dx at rest that is at least 1e-4 of the
    largest: slow creep and held hysteresis do not count.
    """
    s = model.structure
    slopes = ca.Function("slopes", [s.time, s.x, s.u, s.p], [ca.jacobian(s.xdot, s.x)])
    rest = np.zeros(len(s.states))
    matrix = np.array(slopes(0.0, rest, np.zeros(len(s.inputs)), model.parameter_vector()))
    rates = np.abs(np.linalg.eigvals(matrix))
    ordinary = rates[rates > 1e-4 * rates.max(initial=0.0)]
    return float(4.0 / ordinary.min()) if ordinary.size else 1.0


def _number(value: float) -> str:
    return repr(float(value))


def _interfaces(root: ET.Element, identifier: str, sources: Iterable[str]) -> None:
    common = {
        "modelIdentifier": identifier,
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
        "providesDirectionalDerivative": "true",
    }
    stepping = {
        "canHandleVariableCommunicationStepSize": "true",
        "canInterpolateInputs": "true",
        "maxOutputDerivativeOrder": "1",
    }
    files = sorted(sources)
    for tag, more in (("ModelExchange", {}), ("CoSimulation", stepping)):
        element = ET.SubElement(root, tag, {**common, **more})
        listed = ET.SubElement(element, "SourceFiles")
        for name in files:
            ET.SubElement(listed, "File", {"name": name})


def _units(root: ET.Element, table: Iterable[Variable]) -> None:
    displays: dict[str, set[str]] = {}
    for variable in table:
        shown = displays.setdefault(variable.unit, set())
        if variable.display_unit:
            shown.add(variable.display_unit)
    definitions = ET.SubElement(root, "UnitDefinitions")
    for name in sorted(displays):
        unit = parse_unit(name)
        element = ET.SubElement(definitions, "Unit", {"name": name})
        base = {symbol: str(power) for symbol, power in unit.base_exponents.items()}
        if unit.ratio != 1:
            base["factor"] = _number(unit.factor)
        if unit.offset:
            base["offset"] = _number(unit.offset)
        ET.SubElement(element, "BaseUnit", base)
        for shown_name in sorted(displays[name]):
            ET.SubElement(element, "DisplayUnit", _display(unit, shown_name))


def _display(unit: Unit, name: str) -> dict[str, str]:
    """Return the DisplayUnit: value shown = factor * value + offset."""
    shown = parse_unit(name)
    ratio = unit.ratio / shown.ratio
    attributes = {"name": name, "factor": _number(float(ratio))}
    if unit.offset != shown.offset:
        attributes["offset"] = _number((unit.offset - shown.offset) / shown.factor)
    return attributes


def _type_name(unit: str) -> str | None:
    quantity = parse_unit(unit).quantity
    return quantity.title().replace(" ", "") if quantity else None


def _types(root: ET.Element, table: Iterable[Variable]) -> None:
    named = {name: unit for unit in sorted({v.unit for v in table}) if (name := _type_name(unit))}
    definitions = ET.SubElement(root, "TypeDefinitions")
    for name, unit in sorted(named.items()):
        simple = ET.SubElement(definitions, "SimpleType", {"name": name})
        ET.SubElement(simple, "Real", {"quantity": name, "unit": unit})


def _variable(parent: ET.Element, reference: int, variable: Variable) -> None:
    scalar = ET.SubElement(
        parent,
        "ScalarVariable",
        {
            "name": variable.name,
            "valueReference": str(reference),
            "description": variable.description,
            **_CAUSALITY[variable.kind],
        },
    )
    attributes = {"unit": variable.unit}
    declared = _type_name(variable.unit)
    if declared:
        attributes["declaredType"] = declared
    if variable.display_unit:
        attributes["displayUnit"] = variable.display_unit
    for name, bound in zip(("min", "max"), variable.bounds or (), strict=False):
        if math.isfinite(bound):
            attributes[name] = _number(bound)
    if variable.nominal is not None:
        attributes["nominal"] = _number(abs(variable.nominal))
    if variable.start is not None:
        attributes["start"] = _number(variable.start)
    if variable.kind == "derivative":
        attributes["derivative"] = str(variable.index + 2)
    ET.SubElement(scalar, "Real", attributes)


def _structure(parent: ET.Element, structure: Structure, table: Sequence[Variable]) -> None:
    found = dependencies(structure)
    places = {(v.kind, v.index): place for place, v in enumerate(table, start=1)}
    outputs = [("output", i) for i in range(len(structure.outputs))]
    rates = [("derivative", i) for i in range(len(structure.states))]
    for tag, unknowns in (("Outputs", outputs), ("Derivatives", rates), ("InitialUnknowns", None)):
        element = ET.SubElement(parent, tag)
        for unknown in unknowns or sorted([*outputs, *rates], key=places.__getitem__):
            known = {places[k]: kind for k, kind in found[unknown].items()}
            attributes = {
                "index": str(places[unknown]),
                "dependencies": " ".join(str(k) for k in sorted(known)),
            }
            if unknowns is not None:
                attributes["dependenciesKind"] = " ".join(known[k] for k in sorted(known))
            ET.SubElement(element, "Unknown", attributes)
