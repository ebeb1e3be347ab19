"""The parameters of a model as a parameter set that system tools read (SSV).

Source: SSP 1.0, section 6 (system structure parameter values).
"""

from xml.etree import ElementTree as ET

from psa_casadi.export.common.markup import base_unit, generation_tool, number, xml_text
from psa_casadi.model.compose import Model
from psa_casadi.units import parse_unit

_VALUES = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
_COMMON = "http://ssp-standard.org/SSP1/SystemStructureCommon"


def parameter_set(model: Model) -> str:
    """Return the values of all parameters in SI units, with their 95 % intervals where known."""
    ET.register_namespace("ssv", _VALUES)
    ET.register_namespace("ssc", _COMMON)
    attributes = {"version": "1.0", "name": model.name, "generationTool": generation_tool()}
    root = ET.Element(f"{{{_VALUES}}}ParameterSet", attributes)
    listed = ET.SubElement(root, f"{{{_VALUES}}}Parameters")
    intervals = model.provenance.intervals
    for p in model.structure.parameters:
        meaning = p.description
        if p.name in intervals:
            found = intervals[p.name]
            meaning += f"; 95 % interval {found.low:.6g} to {found.high:.6g} {p.unit}"
        element = ET.SubElement(
            listed, f"{{{_VALUES}}}Parameter", {"name": p.name, "description": meaning}
        )
        value = {"value": number(model.values[p.name]), "unit": p.unit}
        ET.SubElement(element, f"{{{_VALUES}}}Real", value)
    names = sorted({p.unit for p in model.structure.parameters})
    if names:
        units = ET.SubElement(root, f"{{{_VALUES}}}Units")
        for name in names:
            unit = ET.SubElement(units, f"{{{_COMMON}}}Unit", {"name": name})
            ET.SubElement(unit, f"{{{_COMMON}}}BaseUnit", base_unit(parse_unit(name)))
    return xml_text(root)
