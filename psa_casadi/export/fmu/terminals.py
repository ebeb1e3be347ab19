"""terminalsAndIcons.xml: which variables belong to one connection, and what an FMU looks like.

Source: FMI 3.0.2, section 2.4.9 (terminals and icons).
"""

from dataclasses import dataclass
from xml.etree import ElementTree as ET

from psa_casadi.export.common.icon import ICONS, drawing_of, png, svg
from psa_casadi.export.common.markup import xml_text
from psa_casadi.model.compose import Model

FOLDER = "terminalsAndIcons"


@dataclass(frozen=True)
class Terminal:
    """A connection: its name, meaning, icon, colour, side, and its variables.

    `members` are (name of the variable, name in the connection, kind); two terminals connect by
    the names in the connection. A force or a current is a flow ("inflow" into this model,
    "outflow" from it): flows add up to zero. Everything else is a "signal".
    """

    name: str
    description: str
    icon: str
    colour: str
    side: float
    members: tuple[tuple[str, str, str], ...]


_MECHANICAL, _ELECTRICAL = "91 102 111", "0 114 178"

TERMINALS: tuple[Terminal, ...] = (
    Terminal(
        "electrical",
        "voltage in, current out: the amplifier's input and what the stack draws",
        "electrical",
        _ELECTRICAL,
        -100.0,
        (("voltage", "voltage", "signal"), ("current", "current", "inflow")),
    ),
    Terminal(
        "mechanical",
        "force of the load in, motion of the output out",
        "mechanical",
        _MECHANICAL,
        100.0,
        (
            ("displacement", "position", "signal"),
            ("velocity", "velocity", "signal"),
            ("load_force", "force", "inflow"),
        ),
    ),
    Terminal(
        "tip",
        "motion of the stack's output in, force on the stack out",
        "mechanical",
        _MECHANICAL,
        -100.0,
        (
            ("tip_position", "position", "signal"),
            ("tip_velocity", "velocity", "signal"),
            ("reaction_force", "force", "outflow"),
        ),
    ),
)


def terminals_of(model: Model) -> tuple[Terminal, ...]:
    """Return the terminals whose variables are all inputs or outputs of the model."""
    known = {*model.input_names, *model.output_names}
    return tuple(t for t in TERMINALS if {variable for variable, _, _ in t.members} <= known)


def terminals_and_icons(model: Model) -> str:
    """Return the XML text of terminalsAndIcons.xml."""
    root = ET.Element("fmiTerminalsAndIcons", {"fmiVersion": "3.0"})
    drawing = ET.SubElement(root, "GraphicalRepresentation")
    corners = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
    ET.SubElement(drawing, "CoordinateSystem", {**corners, "suggestedScalingFactorTo_mm": "0.1"})
    ET.SubElement(drawing, "Icon", corners)
    terminals = terminals_of(model)
    if terminals:
        listed = ET.SubElement(root, "Terminals")
        for terminal in terminals:
            _terminal(listed, terminal)
    return xml_text(root)


def _terminal(parent: ET.Element, terminal: Terminal) -> None:
    element = ET.SubElement(
        parent,
        "Terminal",
        {"name": terminal.name, "matchingRule": "plug", "description": terminal.description},
    )
    for variable, member, kind in terminal.members:
        attributes = {"variableName": variable, "memberName": member, "variableKind": kind}
        ET.SubElement(element, "TerminalMemberVariable", attributes)
    ET.SubElement(
        element,
        "TerminalGraphicalRepresentation",
        {
            "defaultConnectionColor": terminal.colour,
            "defaultConnectionStrokeSize": "1",
            "x1": f"{terminal.side - 10:g}",
            "y1": "-10",
            "x2": f"{terminal.side + 10:g}",
            "y2": "10",
            "iconBaseName": terminal.icon,
        },
    )


def terminal_entries(model: Model) -> dict[str, bytes]:
    """Return the files of the folder terminalsAndIcons by their place in the archive."""
    drawings = {"icon": drawing_of(model)} | {t.icon: t.icon for t in terminals_of(model)}
    shapes = {name: ICONS[drawing] for name, drawing in drawings.items()}
    entries = {f"{FOLDER}/terminalsAndIcons.xml": terminals_and_icons(model).encode("utf-8")}
    entries |= {f"{FOLDER}/{n}.png": png(s) for n, s in shapes.items()}
    return entries | {f"{FOLDER}/{n}.svg": svg(s).encode("utf-8") for n, s in shapes.items()}
