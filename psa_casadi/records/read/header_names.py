"""What laboratories call the columns: `Time (s)`, `voltage_V`, `u/V`, `Spannung [V]`."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from psa_casadi.errors import InputError
from psa_casadi.units import parse_unit

#: Other names of a column, in lower case with single spaces; single letters are symbols.
ALIASES: dict[str, tuple[str, ...]] = {
    "time": ("time", "t", "elapsed time", "timestamp", "time stamp", "x_value", "zeit"),
    "voltage": (
        "voltage", "v", "u", "volt", "volts", "drive voltage", "input voltage", "output voltage",
        "command voltage", "applied voltage", "control voltage", "piezo voltage", "vin", "v_in",
        "u_in", "vpzt", "spannung",
    ),
    "displacement": (
        "displacement", "x", "y", "d", "z", "disp", "position", "pos", "travel", "stroke",
        "elongation", "extension", "deflection", "sensor position", "measured position",
        "current position", "actual position", "weg", "auslenkung",
    ),
    "load_force": ("load_force", "load force", "force", "load", "f", "kraft"),
    "current": ("current", "i", "drive current", "strom"),
    "temperature": ("temperature", "temp", "temperatur"),
    "monitor_voltage": (
        "monitor_voltage", "monitor voltage", "voltage monitor", "monitor", "v_mon", "u_mon",
        "vmon", "monitorspannung",
    ),
    "charge": ("charge", "q", "ladung"),
    "displacement_2": (
        "displacement_2", "displacement 2", "second displacement", "x2", "x_2", "y2",
    ),
    "strain": ("strain", "strain gauge", "dehnung"),
}  # fmt: skip
_COLUMN_OF = {alias: column for column, names in ALIASES.items() for alias in names}
#: A name and its unit: in brackets of any form, after a slash, an underscore or a space.
_FORMS = (
    re.compile(r"(?P<name>.*?)\s*[\[({](?P<unit>[^\[\](){}]*)[\])}]"),
    re.compile(r"(?P<name>.*?)\s*/\s*(?P<unit>\S+)"),
    re.compile(r"(?P<name>.*)[_ ](?P<unit>[^_ ]+)"),
)
_DIGITS = re.compile(r"[0-9.+-]")


@dataclass(frozen=True)
class Name:
    """A header cell that is understood: its column, and the unit it names, if it names one."""

    column: str
    unit: str | None


def understood(text: str) -> Name | None:
    """Return what a header cell stands for, or None where it is no column of a record."""
    whole = _COLUMN_OF.get(_plain(text))
    if whole is not None:
        return Name(whole, None)
    for form in _FORMS:
        match = form.fullmatch(text.strip().strip("\"'"))
        if match is None:
            continue
        column = _COLUMN_OF.get(_plain(match["name"]))
        if column is not None and is_unit(match["unit"]):
            return Name(column, match["unit"].strip())
    return None


def columns_known(cells: Sequence[str]) -> int:
    """Return how many different columns of a record a row of cells names."""
    return len({name.column for name in map(understood, cells) if name is not None})


def is_unit(text: str) -> bool:
    """Whether a text is a unit that is known here."""
    try:
        parse_unit(text.strip())
    except InputError:
        return False
    return bool(text.strip())


def units_row(cells: Sequence[str]) -> list[str] | None:
    """Return the units that a row below the names gives, in brackets or bare; None if it is none.

    Every cell that is filled must be a unit, and two at least.
    """
    bare = [c.strip().strip("\"'").strip("[](){}").strip() for c in cells]
    filled = [c for c in bare if c]
    found = len(filled) >= 2 and all(is_unit(c) and not _DIGITS.search(c[:1]) for c in filled)
    return bare if found else None


def _plain(name: str) -> str:
    return re.sub(r"\s+", " ", name.strip().strip("\"'").strip().lower().replace("-", " "))
