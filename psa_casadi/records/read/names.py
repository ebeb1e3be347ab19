"""What laboratories call the columns: `Time (s)`, `voltage_V`, `u/V`, `Spannung [V]`."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from psa_casadi.errors import InputError
from psa_casadi.records.read.columns import measures
from psa_casadi.units import UNITS, parse_unit

#: Other names of a column, in lower case with single spaces; single letters are symbols.
ALIASES: dict[str, tuple[str, ...]] = {
    "time": (
        "time", "t", "elapsed", "elapsed time", "timestamp", "time stamp", "x_value", "zeit",
    ),
    "voltage": (
        "voltage", "v", "u", "volt", "volts", "drive voltage", "input voltage", "output voltage",
        "command voltage", "applied voltage", "control voltage", "piezo voltage", "vin", "v_in",
        "u_in", "vpzt", "hv out", "hv output", "spannung",
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
        "vmon", "drive monitor", "output monitor", "piezo monitor", "amplifier monitor",
        "hv monitor", "monitorspannung",
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
#: With a unit behind it, a symbol that is a unit itself is a name too: `s/um`.
_WITH_UNIT = _COLUMN_OF | {"s": "displacement"}
#: A name and its unit: in brackets of any form, after a slash, comma, underscore or space.
_FORMS = (
    re.compile(r"(?P<name>.*?)\s*[\[({](?P<unit>[^\[\](){}]*)[\])}]"),
    re.compile(r"(?P<name>.*?)\s*(?:[/,]|\bin\b)\s*(?P<unit>\S+)"),
    re.compile(r"(?P<name>.*)[_ ](?P<unit>[^_ ]+)"),
)
_DIGITS = re.compile(r"[0-9.+-]")
#: The number of a channel at the end of a name; it is never a unit.
_CHANNEL = re.compile(r"(?<=\w)[ _]?\d+$")
#: A clock time is written in the place of the unit: `[hh:mm:ss.fff]`.
_CLOCK = re.compile(r"[ymd./ -]*h{1,2}:m{1,2}(:s{1,2}([.,:][sf0]+)?)?", re.I)
_WORD = re.compile(r"[^\W\d_]{2,}")
#: What stands in a row of units where a column has none.
_NO_UNIT = ("-", "\N{EN DASH}")


@dataclass(frozen=True)
class Name:
    """A header cell that is understood: its column, and the unit it names, if it names one."""

    column: str
    unit: str | None


@dataclass(frozen=True)
class _Part:
    """Name and unit of a cell by one form, and whether the unit is one for sure."""

    name: str
    unit: str
    is_sure: bool
    is_lone: bool = False


def understood(text: str) -> Name | None:
    """Return what a header cell stands for, or None where it is no column of a record.

    What follows an underscore or a space may belong to the name: `U_amp` and `V_min` are in no
    ampere and no minute.
    """
    name = _plain(text)
    whole = _COLUMN_OF.get(name) or _COLUMN_OF.get(_CHANNEL.sub("", name))
    if whole is not None:
        return Name(whole, None)
    for part in _parts(text):
        column = _WITH_UNIT.get(_plain(part.name))
        if column is not None and (part.is_sure or measures(column, part.unit)):
            return Name(column, part.unit)
    return None


def stated_unit(text: str, *, loosely: bool = False) -> str | None:
    """Return the unit that a header cell states, whatever its name; None where it states none.

    A cell may be the unit itself (`mV`). A lone letter is a symbol or an index as often, alone or
    behind an underscore or a space (`U_s`, `Channel A`): it counts only `loosely`, and where the
    name is that of a column.
    """
    known = understood(text)
    if known is not None:
        return known.unit
    for part in _parts(text):
        if part.name.strip() and part.is_sure and (loosely or not part.is_lone):
            return part.unit
    bare = _unquoted(text)
    is_unit = bare.lower() in _UNIT_OF or (len(bare) > 1 and _is_symbol(bare)) or "/" in bare
    return unit_named(bare) if is_unit else None


def unit_for(column: str, text: str) -> str | None:
    """Return the unit that a cell states where it is known to be a column.

    A quotient that does not measure it, as `C/nm` a displacement, is a name and its unit.
    """
    unit = stated_unit(text)
    if unit is None or parse_unit(unit).quantity or measures(column, unit):
        return unit
    return unit_named(text.rpartition("/")[2])


def name_without_unit(text: str) -> str:
    """Return the name in a cell without the unit that it states for sure."""
    parts = [part.name for part in _parts(text) if part.is_sure and not part.is_lone]
    return _unquoted(parts[0] if parts else text)


def words_of(text: str) -> frozenset[str]:
    """Return the words of two letters or more in the name of a cell, the last part of a path."""
    parts = [part.name for part in _parts(text) if part.is_sure]
    name = (parts[0] if parts else text).rstrip("/").rpartition("/")[2]
    return frozenset(_WORD.findall(name.lower()))


def column_named(word: str) -> str | None:
    """Return the column that a word is a name of, alone."""
    return _COLUMN_OF.get(word)


def _parts(text: str) -> Iterator[_Part]:
    """Yield name and unit of a cell by every form that fits.

    Behind a slash it is no unit for sure where the whole is one (`um/s`), behind an underscore or a
    space only as a symbol, which may be a lone letter.
    """
    bare = _unquoted(text)
    whole = unit_named(bare) is not None
    for k, form in enumerate(_FORMS):
        match = form.fullmatch(bare)
        if match is None or (k > 0 and match["unit"].isdecimal()):
            continue
        unit = unit_named(match["unit"], common=k > 0)
        if unit:
            is_sure = (True, not whole, _is_symbol(match["unit"]))[k]
            yield _Part(match["name"], unit, is_sure, is_lone=k == 2 and len(unit) == 1)


def _is_symbol(text: str) -> bool:
    """Whether a text is a unit's symbol, of a decimal multiple: `min` is a word as well."""
    unit = unit_named(text)
    if unit is None or text.strip().lower() in _UNIT_OF:
        return False
    parsed = parse_unit(unit)
    ends = {parsed.ratio.numerator, parsed.ratio.denominator}
    is_decimal = all(str(n).strip("0") == "1" for n in ends)
    return is_decimal and parsed.name in UNITS and parsed.name.isalpha()


def columns_known(cells: Sequence[str]) -> int:
    """Return how many different columns of a record a row of cells names.

    Where every cell has a name and a unit, each quantity counts as a column.
    """
    known = len({name.column for name in map(understood, cells) if name is not None})
    units = [stated_unit(c) if unit_named(_unquoted(c)) is None else None for c in cells]
    if known >= 2 or None in units:
        return known
    return len({parse_unit(unit).quantity for unit in units if unit} - {""})


def unit_named(text: str, *, common: bool = True) -> str | None:
    """Return the unit that a text names, by its symbol or written out; None where it names none.

    `common` looks at the units of the table alone: a word of a name is easily one of all others.
    """
    unit = _UNIT_OF.get(text.strip().lower(), text.strip())
    if _CLOCK.fullmatch(unit):
        return "s"
    try:
        parse_unit(unit, common=common)
    except InputError:
        return None
    return unit or None


def units_row(cells: Sequence[str]) -> list[str] | None:
    """Return the units that a row below the names gives, in brackets or bare; None if it is none.

    Every cell that is filled must be a unit, and two at least; a dash stands for none.
    """
    bare = [_unquoted(c).strip("[](){}").strip() for c in cells]
    bare = ["" if c in _NO_UNIT else c for c in bare]
    filled = [c for c in bare if c]
    if len(filled) < 2 or any(_DIGITS.search(c[:1]) for c in filled):
        return None
    if not any(map(unit_named, filled)) or None in [unit_named(c, common=False) for c in filled]:
        return None
    return [(unit_named(c, common=False) or "") if c else "" for c in bare]


def _plain(name: str) -> str:
    plain = re.sub(r"\s+", " ", _unquoted(name).rstrip(".").lower().replace("-", " "))
    return _OF_A_PLACE.sub("", plain)


def _unquoted(text: str) -> str:
    return text.strip().strip("\"'").strip()
