"""terminalsAndIcons.xml: which variables belong to one connection, and what an FMU looks like.

Source: FMI 3.0.2, section 2.4.9 (terminals and icons).
"""

from typing import NamedTuple

from psa_casadi.export.common.icon import ICONS, drawing_of, png, svg
from psa_casadi.export.common.markup import xml_text
from psa_casadi.model.compose import Model

FOLDER = "terminalsAndIcons"
#: Colour of the wires of a connection, by its icon.
_COLOURS = {"mechanical": "91 102 111", "electrical": "0 114 178"}


class Terminal(NamedTuple):
    """A connection: its name, meaning, icon, side, and its variables.

    `members` are (name of the variable, name in the connection, kind); two terminals connect by
    the names in the connection. A force or a current is a flow ("inflow" into this model,
    "outflow" from it): flows add up to zero. Everything else is a "signal".
    """

    name: str
    description: str
    icon: str
    side: float
    members: tuple[tuple[str, str, str], ...]


TERMINALS: tuple[Terminal, ...] = (
    Terminal(
        "electrical", "voltage in, current out: the amplifier's input and what the stack draws",
        "electrical", -100.0,
        (("voltage", "voltage", "signal"), ("current", "current", "inflow")),
    ),
    Terminal(
        "mechanical", "force of the load in, motion of the output out", "mechanical", 100.0,
        (("displacement", "position", "signal"), ("velocity", "velocity", "signal"),
         ("load_force", "force", "inflow")),
    ),
    Terminal(
        "tip", "motion of the stack's output in, force on the stack out", "mechanical", -100.0,
        (("tip_position", "position", "signal"), ("tip_velocity", "velocity", "signal"),
         ("reaction_force", "force", "outflow")),
    ),
)  # fmt: skip


def terminals_of(model: Model) -> tuple[Terminal, ...]:
    """Return the terminals whose variables are all inputs or outputs of the model."""
    known = {*model.input_names, *model.output_names}
    return tuple(t for t in TERMINALS if {variable for variable, _, _ in t.members} <= known)


def terminals_and_icons(model: Model) -> str:
    """Return the XML text of terminalsAndIcons.xml."""
    drawn = [
        (t, {"x1": f"{t.side - 10:g}", "y1": "-10", "x2": f"{t.side + 10:g}", "y2": "10"})
        for t in terminals_of(model)
    ]
    return xml_text("terminalsAndIcons.xml", terminals=drawn, colours=_COLOURS)


def terminal_entries(model: Model) -> dict[str, bytes]:
    """Return the files of the folder terminalsAndIcons by their place in the archive."""
    entries = {f"{FOLDER}/terminalsAndIcons.xml": terminals_and_icons(model).encode("utf-8")}
    for name, drawing in [
        ("icon", drawing_of(model)),
        *((t.icon, t.icon) for t in terminals_of(model)),
    ]:
        entries[f"{FOLDER}/{name}.png"] = png(ICONS[drawing])
        entries[f"{FOLDER}/{name}.svg"] = svg(ICONS[drawing]).encode("utf-8")
    return entries
