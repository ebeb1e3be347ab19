"""SystemStructure.ssd: the parts of a system, their connectors, their wires and its drawing.

Source: SSP 1.0, section 5 (system structure description) and section 4.4 (common elements).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree as ET

from psa_casadi.export.common.markup import (
    base_unit,
    describe,
    generation_tool,
    number,
    xml_text,
)
from psa_casadi.export.common.parameter_sets import parameter_set
from psa_casadi.export.ssp.drawing import OUTSIDE, Box, Layout, Port, Wire
from psa_casadi.model.compose import Model
from psa_casadi.units import parse_unit
from psa_casadi.variables import Publication

SSD = "http://ssp-standard.org/SSP1/SystemStructureDescription"
SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"
#: Namespace of the annotations of OMSimulator, which knows them by the prefix "oms" only.
OMS = "https://raw.githubusercontent.com/OpenModelica/OMSimulator/master/schema/oms.xsd"
#: Relative tolerance that its master asks of the parts.
TOLERANCE = 1e-6
#: Rows of its table of results.
_ROWS = 1000
SSV_TYPE = "application/x-ssp-parameter-set"
SSM_TYPE = "application/x-ssp-parameter-mapping"
#: What SSP calls otherwise than FMI does.
_PUBLISHED = {"version": "fileversion"}


@dataclass(frozen=True)
class WiredParts:
    """A system as SSP sees it: models by the names of the parts, wires, and its own ports.

    A wire from or to `OUTSIDE` makes a port of the system, with the unit of the part's port.
    """

    name: str
    parts: Mapping[str, Model]
    wires: tuple[Wire, ...]
    publication: Publication = field(default_factory=Publication)

    def unit(self, port: Port) -> str:
        """Return the unit of a port; that of the system is the unit of what it is wired to."""
        if port.part == OUTSIDE:
            ends = [w.end for w in self.wires if w.start == port]
            port = ends[0] if ends else next(w.start for w in self.wires if w.end == port)
        s = self.parts[port.part].structure
        units = {v.name: v.unit for v in s.inputs} | {v.name: v.unit for v in s.outputs}
        return units[port.name]

    def ports(self, part: str) -> tuple[tuple[str, str], ...]:
        """Return (name, kind) of the connected ports of a part, or of the system, inputs first."""
        ends = dict.fromkeys(w.end.name for w in self.wires if w.end.part == part)
        starts = dict.fromkeys(w.start.name for w in self.wires if w.start.part == part)
        if part == OUTSIDE:
            ends, starts = starts, ends
        return (*((n, "input") for n in ends), *((n, "output") for n in starts))


@dataclass(frozen=True)
class Binding:
    """Files in the archive that set parameters: of one part, or of the system (`OUTSIDE`)."""

    part: str
    values: str
    mapping: str | None = None


def structure_description(
    wiring: WiredParts,
    layout: Layout,
    bindings: Sequence[Binding],
    stop_time: float,
    step: float,
) -> str:
    """Return the XML text of SystemStructure.ssd; FMUs are `resources/<part>.fmu`.

    SSP 1.0 has no place for a communication step: `step` [s] stands in an annotation that
    OMSimulator reads, and without which it opens no archive. A SystemGeometry is one that it
    refuses; without it the drawing extends over all elements, as the standard has it.
    """
    ET.register_namespace("ssd", SSD)
    ET.register_namespace("ssc", SSC)
    ET.register_namespace("oms", OMS)
    said = {_PUBLISHED.get(name, name): text for name, text in wiring.publication.stated.items()}
    attributes = {"version": "1.0", "name": wiring.name, **said}
    root = _element(
        None, "SystemStructureDescription", {**attributes, "generationTool": generation_tool()}
    )
    system = _element(root, "System", {"name": wiring.name, "description": _about(wiring)})
    _connectors(system, OUTSIDE, wiring, layout)
    _bindings(system, OUTSIDE, bindings)
    elements = _element(system, "Elements", {})
    for box in layout.boxes:
        _component(elements, box, wiring, layout, bindings)
    _connections(system, layout)
    _master(system, step)
    _units(root, {wiring.unit(port) for wire in wiring.wires for port in (wire.start, wire.end)})
    experiment = _element(
        root, "DefaultExperiment", {"startTime": "0.0", "stopTime": number(stop_time)}
    )
    interval = _decimal(stop_time / _ROWS)
    results = {"resultFile": f"{wiring.name}.csv", "loggingInterval": interval, "bufferSize": "10"}
    _information(experiment, results)
    return xml_text(root)


def _element(parent: ET.Element | None, name: str, attributes: dict[str, str]) -> ET.Element:
    tag = f"{{{SSD}}}{name}"
    return ET.Element(tag, attributes) if parent is None else ET.SubElement(parent, tag, attributes)


def _about(wiring: WiredParts) -> str:
    return (
        f"{wiring.name.replace('_', ' ')}: {', '.join(n.replace('_', ' ') for n in wiring.parts)}"
    )


def _connectors(parent: ET.Element, part: str, wiring: WiredParts, layout: Layout) -> None:
    ports = wiring.ports(part)
    if not ports:
        return
    listed = _element(parent, "Connectors", {})
    for name, kind in ports:
        port = Port(part, name)
        connector = _element(listed, "Connector", {"name": name, "kind": kind})
        unit = wiring.unit(port)
        ET.SubElement(connector, f"{{{SSC}}}Real", {"unit": unit} if unit else {})
        x, y = layout.relative(port)
        _element(connector, "ConnectorGeometry", {"x": _place(x), "y": _place(y)})


def _component(
    parent: ET.Element, box: Box, wiring: WiredParts, layout: Layout, bindings: Sequence[Binding]
) -> None:
    attributes = {
        "name": box.name,
        "description": describe(wiring.parts[box.name]),
        "type": "application/x-fmu-sharedlibrary",
        "source": f"resources/{box.name}.fmu",
        "implementation": "CoSimulation",
    }
    element = _element(parent, "Component", attributes)
    _connectors(element, box.name, wiring, layout)
    _element(element, "ElementGeometry", _corners(box.x1, box.y1, box.x2, box.y2))
    _bindings(element, box.name, bindings)


def _bindings(parent: ET.Element, part: str, bindings: Sequence[Binding]) -> None:
    own = [b for b in bindings if b.part == part]
    if not own:
        return
    listed = _element(parent, "ParameterBindings", {})
    for binding in own:
        attributes = {"type": SSV_TYPE, "source": binding.values}
        element = _element(listed, "ParameterBinding", attributes)
        if binding.mapping is not None:
            _element(element, "ParameterMapping", {"type": SSM_TYPE, "source": binding.mapping})


def _connections(parent: ET.Element, layout: Layout) -> None:
    listed = _element(parent, "Connections", {})
    for wire, path in zip(layout.wires, layout.paths, strict=True):
        attributes = {}
        for side, port in (("start", wire.start), ("end", wire.end)):
            if port.part != OUTSIDE:
                attributes[f"{side}Element"] = port.part
            attributes[f"{side}Connector"] = port.name
        connection = _element(listed, "Connection", attributes)
        inner = path[1:-1]
        if inner:
            points = {
                "pointsX": " ".join(_place(x) for x, _ in inner),
                "pointsY": " ".join(_place(y) for _, y in inner),
            }
            _element(connection, "ConnectionGeometry", points)


def _master(system: ET.Element, step: float) -> None:
    """Append the annotation of a master with fixed steps, as OMSimulator writes it."""
    information = _information(system, {})
    attributes = {
        "description": "oms-ma",
        "stepSize": _decimal(step),
        "relativeTolerance": _decimal(TOLERANCE),
    }
    ET.SubElement(information, f"{{{OMS}}}FixedStepMaster", attributes)


def _information(parent: ET.Element, attributes: dict[str, str]) -> ET.Element:
    """Append OMSimulator's annotation on a simulation."""
    listed = _element(parent, "Annotations", {})
    annotation = ET.SubElement(listed, f"{{{SSC}}}Annotation", {"type": "org.openmodelica"})
    own = ET.SubElement(annotation, f"{{{OMS}}}Annotations")
    return ET.SubElement(own, f"{{{OMS}}}SimulationInformation", attributes)


def _decimal(value: float) -> str:
    """Return a number without exponent."""
    return f"{value:.15f}".rstrip("0")


def _units(root: ET.Element, names: Iterable[str]) -> None:
    listed = _element(root, "Units", {})
    for name in sorted(n for n in names if n):
        unit = ET.SubElement(listed, f"{{{SSC}}}Unit", {"name": name})
        ET.SubElement(unit, f"{{{SSC}}}BaseUnit", base_unit(parse_unit(name)))


def _corners(x1: float, y1: float, x2: float, y2: float) -> dict[str, str]:
    return {n: _place(v) for n, v in (("x1", x1), ("y1", y1), ("x2", x2), ("y2", y2))}


def _place(value: float) -> str:
    return f"{round(value, 6):.6g}"


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
