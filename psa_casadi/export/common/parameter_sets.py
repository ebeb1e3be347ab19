"""The parameters of a model as a parameter set that system tools read (SSV).

Source: SSP 1.0, section 6 (system structure parameter values).
"""

from collections.abc import Mapping, Sequence
from xml.etree import ElementTree as ET

from psa_casadi.export.common.markup import base_unit, generation_tool, number, xml_text
from psa_casadi.model.compose import Model
from psa_casadi.units import parse_unit

_VALUES = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
_COMMON = "http://ssp-standard.org/SSP1/SystemStructureCommon"


def parameter_set(
    model: Model,
    values: Mapping[str, float] | None = None,
    *,
    name: str | None = None,
    states: Mapping[str, float] | None = None,
) -> str:
    """Return the values of all parameters in SI units, with their 95 % intervals where known.

    With `values`, those of these parameters only, which stand in the set of that `name`. `states`
    are start values of states to add.
    """
    ET.register_namespace("ssv", _VALUES)
    ET.register_namespace("ssc", _COMMON)
    attributes = {"version": "1.0", "name": name or model.name, "generationTool": generation_tool()}
    root = ET.Element(f"{{{_VALUES}}}ParameterSet", attributes)
    listed = ET.SubElement(root, f"{{{_VALUES}}}Parameters")
    intervals = model.provenance.intervals
    chosen = model.values if values is None else values
    used: set[str] = set()
    for p in model.structure.parameters:
        if p.name not in chosen:
            continue
        meaning = p.description
        if p.name in intervals and values is None:
            found = intervals[p.name]
            meaning += f"; 95 % interval {found.low:.6g} to {found.high:.6g} {p.unit}"
        _real(listed, p.name, meaning, chosen[p.name], p.unit)
        used.add(p.unit)
    for q in model.structure.states:
        if q.name in (states or {}):
            _real(listed, q.name, f"start of the {q.description}", (states or {})[q.name], q.unit)
            used.add(q.unit)
    _units(root, sorted(used))
    return xml_text(root)


def _real(listed: ET.Element, name: str, meaning: str, value: float, unit: str) -> None:
    attributes = {"name": name, "description": meaning}
    element = ET.SubElement(listed, f"{{{_VALUES}}}Parameter", attributes)
    ET.SubElement(element, f"{{{_VALUES}}}Real", {"value": number(value), "unit": unit})


def _units(root: ET.Element, names: Sequence[str]) -> None:
    units = ET.SubElement(root, f"{{{_VALUES}}}Units") if names else root
    for name in names:
        unit = ET.SubElement(units, f"{{{_COMMON}}}Unit", {"name": name})
        ET.SubElement(unit, f"{{{_COMMON}}}BaseUnit", base_unit(parse_unit(name)))
