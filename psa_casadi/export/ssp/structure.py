"""SystemStructure.ssd: the parts of a system, their connectors, their wires and its drawing.

Source: SSP 1.0, section 5 (system structure description) and section 4.4 (common elements).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

from psa_casadi.characters import check_text
from psa_casadi.export.common.markup import (
    base_unit,
    describe,
    generation_tool,
    number,
    xml_text,
)
from psa_casadi.export.common.parameter_sets import parameter_set
from psa_casadi.export.common.templates import filled
from psa_casadi.export.ssp.drawing import OUTSIDE, Layout, Point, Port, Wire, WiredParts
from psa_casadi.model.compose import Model
from psa_casadi.units import parse_unit

#: Relative tolerance that its master asks of the parts.
TOLERANCE = 1e-6
#: Rows of its table of results.
_ROWS = 1000
#: What SSP calls otherwise than FMI does.
_PUBLISHED = {"version": "fileversion"}


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

    def ports(part: str) -> list[tuple[str, ...]]:
        places = [(name, kind, Port(part, name)) for name, kind in wiring.ports(part)]
        return [
            (name, kind, wiring.unit(p), *map(_place, layout.relative(p)))
            for name, kind, p in places
        ]

    parts = [
        {
            "name": box.name,
            "about": describe(wiring.parts[box.name]),
            "ports": ports(box.name),
            "corners": {n: _place(getattr(box, n)) for n in ("x1", "y1", "x2", "y2")},
        }
        for box in layout.boxes
    ]
    used = {wiring.unit(port) for wire in wiring.wires for port in (wire.start, wire.end)} - {""}
    names = (name.replace("_", " ") for name in wiring.parts)
    text = filled(
        "SystemStructure.ssd",
        name=wiring.name,
        published={
            _PUBLISHED.get(name, name): said for name, said in wiring.publication.stated.items()
        },
        tool=generation_tool(),
        about=f"{wiring.name.replace('_', ' ')}: {', '.join(names)}",
        ports=ports(OUTSIDE),
        bindings=bindings,
        parts=parts,
        wires=[_connection(*pair) for pair in zip(layout.wires, layout.paths, strict=True)],
        step=_decimal(step),
        tolerance=_decimal(TOLERANCE),
        units={name: base_unit(parse_unit(name)) for name in sorted(used)},
        stop_time=number(stop_time),
        interval=_decimal(stop_time / _ROWS),
    )
    check_text(text, "SystemStructure.ssd, an XML file,")
    return text


def _connection(wire: Wire, path: Sequence[Point]) -> tuple[dict[str, str], list[str]]:
    """Return the ends of a wire, and the coordinates of its inner corners."""
    ends = {}
    for side, port in (("start", wire.start), ("end", wire.end)):
        if port.part != OUTSIDE:
            ends[f"{side}Element"] = port.part
        ends[f"{side}Connector"] = port.name
    return ends, [" ".join(map(_place, along)) for along in zip(*path[1:-1], strict=True)]


def _decimal(value: float) -> str:
    """Return a number without exponent."""
    return f"{value:.15f}".rstrip("0")


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
