"""The parameter sets of a system: one for each part, and one for the values that parts share.

A parameter that several parts have under one name, with one unit and one value, stands once, in
the set of the system; a mapping hands it to the parts. So an observer keeps the parameters of the
stack that it observes, whoever changes them.

Source: SSP 1.0, sections 6 (parameter values) and 7 (parameter mapping).
"""

from collections.abc import Mapping
from xml.etree import ElementTree as ET

from psa_casadi.export.common.markup import generation_tool, xml_text
from psa_casadi.export.common.parameter_sets import parameter_set
from psa_casadi.export.ssp.drawing import OUTSIDE
from psa_casadi.export.ssp.structure import Binding
from psa_casadi.model.compose import Model

_VALUES = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
_MAPPING = "http://ssp-standard.org/SSP1/SystemStructureParameterMapping"
_COMMON = "http://ssp-standard.org/SSP1/SystemStructureCommon"
_FOLDER = "resources"


def shared_parameters(parts: Mapping[str, Model]) -> dict[str, tuple[str, ...]]:
    """Return the parts of each shared parameter by its name: same name, unit and value."""
    owners: dict[tuple[str, str, float], list[str]] = {}
    for part, model in parts.items():
        for p in model.structure.parameters:
            owners.setdefault((p.name, p.unit, model.values[p.name]), []).append(part)
    names = [name for name, _, _ in owners]
    return {
        name: tuple(found)
        for (name, _, _), found in owners.items()
        if len(found) > 1 and names.count(name) == 1
    }


def parameter_files(
    parts: Mapping[str, Model], name: str
) -> tuple[dict[str, bytes], tuple[Binding, ...]]:
    """Return the files of all parameter sets by their place in the archive, and their bindings."""
    shared = shared_parameters(parts)
    sets = {part: ET.fromstring(parameter_set(model)) for part, model in parts.items()}
    units = {
        u.get("name", ""): u for root in sets.values() for u in root.iter(f"{{{_COMMON}}}Unit")
    }
    entries: dict[str, bytes] = {}
    bindings = []
    lifted: dict[str, ET.Element] = {}
    for part, root in sets.items():
        listed = root.find(f"{{{_VALUES}}}Parameters")
        for element in [] if listed is None else list(listed):
            if part in shared.get(element.get("name", ""), ()) and listed is not None:
                lifted.setdefault(element.get("name", ""), element)
                listed.remove(element)
        if listed is None or not len(listed):
            continue
        _keep_units(root)
        place = f"{_FOLDER}/{part}.ssv"
        entries[place] = xml_text(root).encode("utf-8")
        bindings.append(Binding(part, place))
    if lifted:
        values, mapping = f"{_FOLDER}/shared.ssv", f"{_FOLDER}/shared.ssm"
        entries[values] = _shared_set(name, lifted, units).encode("utf-8")
        entries[mapping] = _mapping(shared).encode("utf-8")
        bindings.append(Binding(OUTSIDE, values, mapping))
    return entries, tuple(bindings)


def _shared_set(
    name: str, lifted: Mapping[str, ET.Element], units: Mapping[str, ET.Element]
) -> str:
    attributes = {"version": "1.0", "name": f"{name}_shared", "generationTool": generation_tool()}
    root = ET.Element(f"{{{_VALUES}}}ParameterSet", attributes)
    listed = ET.SubElement(root, f"{{{_VALUES}}}Parameters")
    listed.extend([lifted[n] for n in sorted(lifted)])
    used = sorted(_units_of(root))
    if used:
        ET.SubElement(root, f"{{{_VALUES}}}Units").extend([units[n] for n in used])
    return xml_text(root)


def _mapping(shared: Mapping[str, tuple[str, ...]]) -> str:
    ET.register_namespace("ssm", _MAPPING)
    attributes = {"version": "1.0", "generationTool": generation_tool()}
    root = ET.Element(f"{{{_MAPPING}}}ParameterMapping", attributes)
    for name in sorted(shared):
        for part in shared[name]:
            target = {"source": name, "target": f"{part}.{name}"}
            ET.SubElement(root, f"{{{_MAPPING}}}MappingEntry", target)
    return xml_text(root)


def _keep_units(root: ET.Element) -> None:
    """Remove the units that no parameter has any more."""
    used = _units_of(root)
    for units in root.findall(f"{{{_VALUES}}}Units"):
        for unit in list(units):
            if unit.get("name") not in used:
                units.remove(unit)
        if not len(units):
            root.remove(units)


def _units_of(root: ET.Element) -> set[str]:
    return {e.get("unit", "") for e in root.iter(f"{{{_VALUES}}}Real")} - {""}
