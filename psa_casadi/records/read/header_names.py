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
        "current position", "actual position", "real position", "weg", "auslenkung",
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
#: Units as instruments write them out, in lower case.
UNIT_WORDS = {
    "s": ("sec", "secs", "second", "seconds", "sekunden"),
    "ms": ("msec", "millisecond", "milliseconds"),
    "us": ("usec", "microsecond", "microseconds"),
    "V": ("volt", "volts"),
    "mV": ("millivolt", "millivolts"),
    "m": ("meter", "meters", "metre", "metres"),
    "mm": ("millimeter", "millimeters", "millimetre", "millimetres"),
    "um": ("micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"),
    "nm": ("nanometer", "nanometers", "nanometre", "nanometres"),
    "N": ("newton", "newtons"),
    "A": ("amp", "amps", "ampere", "amperes"),
    "mA": ("milliamp", "milliamps"),
    "degC": ("celsius", "deg c", "degrees celsius"),
}
_UNIT_OF = {word: unit for unit, words in UNIT_WORDS.items() for word in words}
#: What names the place of a channel behind the quantity: `Current Position of axis 1`.
_OF_A_PLACE = re.compile(r" of [\w ]*?(axis|chan|channel)\s*:?\s*\w+$")
_COLUMN_OF = {alias: column for column, names in ALIASES.items() for alias in names}
#: A name and its unit: in brackets of any form, after a slash, comma, underscore or space.
_FORMS = (
    re.compile(r"(?P<name>.*?)\s*[\[({](?P<unit>[^\[\](){}]*)[\])}]"),
    re.compile(r"(?P<name>.*?)\s*[/,]\s*(?P<unit>\S+)"),
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
        unit = unit_named(match["unit"])
        if column is not None and unit is not None:
            return Name(column, unit)
    return None


def columns_known(cells: Sequence[str]) -> int:
    """Return how many different columns of a record a row of cells names."""
    return len({name.column for name in map(understood, cells) if name is not None})


def unit_named(text: str) -> str | None:
    """Return the unit that a text names, by its symbol or written out; None where it names none."""
    unit = _UNIT_OF.get(text.strip().lower(), text.strip())
    try:
        parse_unit(unit)
    except InputError:
        return None
    return unit or None


def units_row(cells: Sequence[str]) -> list[str] | None:
    """Return the units that a row below the names gives, in brackets or bare; None if it is none.

    Every cell that is filled must be a unit, and two at least.
    """
    bare = [c.strip().strip("\"'").strip("[](){}").strip() for c in cells]
    filled = [c for c in bare if c]
    units = [None if _DIGITS.search(c[:1]) else unit_named(c) for c in filled]
    if len(filled) < 2 or None in units:
        return None
    return [(unit_named(c) or "") if c else "" for c in bare]


def _plain(name: str) -> str:
    plain = re.sub(r"\s+", " ", name.strip().strip("\"'").strip().lower().replace("-", " "))
    return _OF_A_PLACE.sub("", plain)
