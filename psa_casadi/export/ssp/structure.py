"""SystemStructure.ssd: the parts of a system, their connectors, their wires and its drawing.

Source: SSP 1.0, section 5 (system structure description) and section 4.4 (common elements).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

from psa_casadi.characters import check_text
from psa_casadi.export.common import markup
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

    def connection(wire: Wire, path: Sequence[Point]) -> tuple[dict[str, str], list[str]]:
        """Return the ends of a wire, and the coordinates of its inner corners."""
        ends = {}
        for side, port in (("start", wire.start), ("end", wire.end)):
            if port.part != OUTSIDE:
                ends[f"{side}Element"] = port.part
            ends[f"{side}Connector"] = port.name
        return ends, [" ".join(map(_place, along)) for along in zip(*path[1:-1], strict=True)]

    def ports(part: str) -> list[tuple[str, ...]]:
        found = [(Port(part, name), kind) for name, kind in wiring.ports(part)]
        return [
            (p.name, kind, wiring.unit(p), *map(_place, layout.relative(p))) for p, kind in found
        ]

    parts = [
        {
            "name": box.name,
            "about": markup.describe(wiring.parts[box.name]),
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
        tool=markup.generation_tool(),
        about=f"{wiring.name.replace('_', ' ')}: {', '.join(names)}",
        ports=ports(OUTSIDE),
        bindings=bindings,
        parts=parts,
        wires=[connection(*pair) for pair in zip(layout.wires, layout.paths, strict=True)],
        step=_decimal(step),
        tolerance=_decimal(TOLERANCE),
        units={name: markup.base_unit(parse_unit(name)) for name in sorted(used)},
        stop_time=markup.number(stop_time),
        interval=_decimal(stop_time / _ROWS),
    )
    check_text(text, "SystemStructure.ssd, an XML file,")
    return text


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
        own = []
        for element in root.iter(f"{{{_VALUES}}}Parameter"):
            named = element.get("name", "")
            if part in shared.get(named, ()):
                lifted.setdefault(named, element)
            else:
                own.append(element)
        if own:
            place = f"{_FOLDER}/{part}.ssv"
            entries[place] = _set_text(parts[part].name, own, units)
            bindings.append(Binding(part, place))
    if lifted:
        values, mapping = f"{_FOLDER}/shared.ssv", f"{_FOLDER}/shared.ssm"
        elements = [lifted[n] for n in sorted(lifted)]
        entries[values] = _set_text(f"{name}_shared", elements, units)
        ET.register_namespace("ssm", _MAPPING)
        attributes = {"version": "1.0", "generationTool": markup.generation_tool()}
        root = ET.Element(f"{{{_MAPPING}}}ParameterMapping", attributes)
        for source in sorted(shared):
            for part in shared[source]:
                target = {"source": source, "target": f"{part}.{source}"}
                ET.SubElement(root, f"{{{_MAPPING}}}MappingEntry", target)
        entries[mapping] = markup.xml_text(root).encode("utf-8")
        bindings.append(Binding(OUTSIDE, values, mapping))
    return entries, tuple(bindings)


def _set_text(name: str, elements: Sequence[ET.Element], units: Mapping[str, ET.Element]) -> bytes:
    """Return a parameter set of some parameters, with the units that they have."""
    attributes = {"version": "1.0", "name": name, "generationTool": markup.generation_tool()}
    root = ET.Element(f"{{{_VALUES}}}ParameterSet", attributes)
    ET.SubElement(root, f"{{{_VALUES}}}Parameters").extend(elements)
    used = {e.get("unit", "") for e in root.iter(f"{{{_VALUES}}}Real")} - {""}
    if used:
        ET.SubElement(root, f"{{{_VALUES}}}Units").extend([units[n] for n in sorted(used)])
    return markup.xml_text(root).encode("utf-8")
