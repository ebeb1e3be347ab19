"""What headers mean: columns by name and unit, and `--columns`, which overrides them."""

import difflib
import os
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import UNITS, parse_unit, units_of
from psa_casadi.records.record import COLUMNS, Column


@dataclass(frozen=True)
class Field:
    """The place of a column in the file, and the unit of its numbers."""

    index: int
    unit: str


@dataclass(frozen=True)
class Source:
    """The array that holds a column, and its unit; None if the file or the column implies it.

    A `scale` is what 1 in the file is: 10 with the unit um is 10 um, as of a sensor's volts.
    """

    array: str
    unit: str | None
    scale: float | None = None

    def __str__(self) -> str:
        """Return it as `--columns` has it."""
        scale = "" if self.scale is None else f"{self.scale:g}"
        return self.array if self.unit is None else f"{self.array}:{scale}{self.unit}"


#: Which array of a file is which column: sources by the name of the column.
ColumnMap = Mapping[str, Source]

#: Where nobody names a unit, a column is taken to be in this one; a displacement never is.
SI_UNITS = {name: c.unit for name, c in COLUMNS.items() if "length" not in c.quantities}


def ready_line(sources: ColumnMap, sample_time: float | None = None, table: str = "") -> str:
    """Return the options that say which array is which column, and the sample time, for a shell."""
    named = [f"table={table}"] if table else []
    line = ",".join([*named, *(f"{name}={source}" for name, source in sources.items())])
    if os.name == "nt" or _SPECIAL.search(line):  # a comma is an operator of PowerShell
        line = f'"{line}"'
    options = [f"--columns {line}"] if line else []
    options += [f"--sample-time {sample_time:g}"] if sample_time is not None else []
    yours = ["your units"] if sources else []
    yours += ["your time between samples [s]"] if sample_time is not None else []
    scale = "; ':10um' means that 1 in the file is 10 um"
    scale = scale if any(source.scale is not None for source in sources.values()) else ""
    return f"{' '.join(options)} (with {' and '.join(yours)}{scale})" if yours else options[0]


def usual_source(name: str, array: str, unit: str | None = None) -> Source:
    """Return an array as the source of a column: in the unit that it states, else in the usual one.

    A stated unit that measures something else, as of a sensor's volts, waits for a scale.
    """
    usual = SI_UNITS.get(name, "um")
    if unit is None:
        return Source(array, usual)
    return Source(array, unit) if measures(name, unit) else Source(array, usual, 1.0)


def measures(name: str, unit: str) -> bool:
    """Whether a unit measures what a column holds, so that its numbers can be converted."""
    try:
        parsed = parse_unit(unit)
    except InputError:
        return False
    quantities = COLUMNS[name].quantities
    if parsed.quantity:
        return parsed.quantity in quantities
    return any(parsed.dimension == parse_unit(units_of(q)[0]).dimension for q in quantities)


_SPECIAL = re.compile(r"[^\w.,=:+/%@-]")


def mismatch(column: Column, unit: str) -> tuple[str, str]:
    """Return that a unit does not measure what the column holds, and what to do about it."""
    accepted = ", ".join(name for q in column.quantities for name in units_of(q))
    what = f"the unit '{unit}' does not measure {column.quantities[0]}"
    return what, f"correct it to one of {accepted}"


def check_unit(column: Column, unit: str | None, where: str, problems: Problems) -> None:
    """Demand a unit that measures what the column holds."""
    accepted = ", ".join(name for q in column.quantities for name in units_of(q))
    if unit is None or not unit.strip():
        problems.add(
            f"{where}: has no unit; write it in brackets, such as '{column.example}', or behind the"
            f" name in --columns, {column.name}=NAME:UNIT (units: {accepted})."
        )
        return
    try:
        parse_unit(unit, column.quantities[0])
    except InputError as error:
        problems.add(f"{where}: {error}")
        return
    if not measures(column.name, unit):
        problems.add(f"{where}: {'; '.join(mismatch(column, unit))}.")


#: The key that chooses a table among the names of columns.
TABLE = "table"
#: Its value that takes each table of a file as a record.
ALL = "all"
#: What a name may not hold that `--columns` is to name.
MARKS = re.compile(r"[,:=\[\]]+")
_PART = re.compile(
    r"(?P<name>[^=]*)=(?P<array>[^\[\]]*?)(?::(?P<unit>[^:\[\]]*)|\[(?P<in>[^]]*)\])?"
)
#: A unit with what 1 in the file is in it.
_SCALED = re.compile(r"(?P<scale>[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?)\s*(?P<unit>[^\d\s].*)")
_FORM = "write NAME=ARRAY:UNIT, several joined by commas, such as time=t:ms,displacement=y:um"


def parse_columns(text: str, names: Collection[str] = ()) -> ColumnMap:
    """Return the sources in `NAME=ARRAY:UNIT,...` (`NAME=ARRAY[UNIT]` is read too).

    NAME is a column of a record. ARRAY is a column's name in the header of a CSV or Parquet file,
    or a MATLAB array: a field of a structure is written `log.u`, the second column of a matrix
    `m.2`. Without UNIT the header's unit counts, else the SI unit; a displacement is never
    guessed. A number before UNIT is what 1 in the file is, whatever the header states: `10um` for
    the volts of a sensor of 10 um/V. `FILE@NAME=ARRAY:UNIT` holds for one file by its name.
    `table=NAME` takes one of several tables of a file (sheets, groups, blocks, segments of time) by
    its name or number, `table=all` each as a record. `names` are the columns of a record on any
    model besides the time; without them it is one of a stack.

    Raises:
        InputError: every part that is not of this form, names no column or no unit of it.
    """
    sources: dict[str, Source] = {}
    problems = Problems()
    known = ["time", *names] if names else [*COLUMNS]
    of_key = {_key(n): n for n in known} | {n: n for n in known}
    for part in text.split(","):
        where = f"--columns, '{part.strip()}'"
        match = _PART.fullmatch(part.strip())
        if match is None or not match["array"].strip():
            problems.add(f"{where}: is not understood; {_FORM}.")
            continue
        file, at, column = match["name"].strip().rpartition("@")
        name = of_key.get(column.strip()) or of_key.get(_key(column)) or _key(column)
        key = f"{file.strip()}{at}{name}"
        unit = match["unit"] if match["in"] is None else match["in"]
        if name == TABLE:
            sources[key] = Source(part.partition("=")[2].strip(), None)
        elif name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
            meant = f"is '{near[0]}' meant? There are" if near else "there are"
            problems.add(f"{where}: '{name}' is no column of a record; {meant} {', '.join(known)}.")
        elif key in sources:
            problems.add(f"{where}: '{key}' is specified twice; remove one of the two.")
        else:
            scaled = _SCALED.fullmatch(unit.strip()) if unit else None
            scale = float(scaled["scale"]) if scaled else None
            unit = scaled["unit"] if scaled else unit
            if unit is not None and not names:
                check_unit(COLUMNS[name], unit, where, problems)
            if scale is not None and not 0.0 < abs(scale) < float("inf"):
                problems.add(
                    f"{where}: the scale {scale:g} leaves nothing of the numbers; correct it."
                )
            sources[key] = Source(match["array"].strip(), unit, scale)
    problems.raise_if_any()
    return sources


def columns_of(wanted: ColumnMap, file: str) -> ColumnMap:
    """Return the sources of one file: those with its name, else those of all files."""
    of_file = {k.removeprefix(f"{file}@"): v for k, v in wanted.items() if k.startswith(f"{file}@")}
    return of_file or {k: v for k, v in wanted.items() if "@" not in k}


def files_named(wanted: ColumnMap) -> set[str]:
    """Return the names of the files that have separate sources."""
    return {key.rpartition("@")[0] for key in wanted if "@" in key}


#: What laboratories call columns and units, and what their programs keep.
WORDS: dict[str, dict[str, Any]] = tomllib.loads(
    files("psa_casadi.records.read").joinpath("words.toml").read_text(encoding="utf-8")
)
#: Units as instruments write them out, in lower case, each with its plural.
_SPELLED = {"s": ("second", "sec"), "V": ("volt",), "m": ("meter", "metre"), "N": ("newton",),
            "A": ("ampere", "amp")}  # fmt: skip
_MULTIPLES = {"": "", "m": "milli", "u": "micro", "n": "nano"}
_UNIT_OF = {
    f"{spelled}{word}{end}": f"{prefix}{unit}"
    for unit, words in _SPELLED.items()
    for word in words
    for prefix, spelled in _MULTIPLES.items()
    for end in ("", "s")
} | WORDS["units"]
#: What names the place of a channel behind the quantity: `Current Position of axis 1`.
_OF_A_PLACE = re.compile(r" of [\w ]*?(axis|chan|channel)\s*:?\s*\w+$")
#: The column that a word names by itself.
COLUMN_OF = {alias: name for name, aliases in WORDS["columns"].items() for alias in aliases}
#: With a unit behind it, a symbol that is a unit itself is a name too: `s/um`.
_WITH_UNIT = COLUMN_OF | {"s": "displacement"}
#: A name and its unit: in brackets of any form, after a slash, comma, underscore or space.
_FORMS = (
    re.compile(r"(?P<name>.*?)\s*[\[({](?P<unit>[^\[\](){}]*)[\])}]"),
    re.compile(r"(?P<name>.*?)\s*(?:[/,]|\bin\b)\s*(?P<unit>\S+)"),
    re.compile(r"(?P<name>.*)[_ ](?P<unit>[^_ ]+)"),
)
_BRACKETED = re.compile(r"(?P<name>.*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?")
_DIGITS = re.compile(r"[0-9.+-]")
#: The number of a channel at the end of a name; it is never a unit.
_CHANNEL = re.compile(r"(?<=\w)[ _]?\d+$")
#: A clock time is written in the place of the unit: `[hh:mm:ss.fff]`.
_CLOCK = re.compile(r"[ymd./ -]*h{1,2}:m{1,2}(:s{1,2}([.,:][sf0]+)?)?", re.I)
_WORD = re.compile(r"[^\W\d_]{2,}")
#: What a row of units has for a column without one.
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
    """Return what a header cell means, or None if it is no column of a record.

    What follows an underscore or a space may belong to the name: `U_amp` and `V_min` are in no
    ampere and no minute.
    """
    name = _plain(text)
    if whole := COLUMN_OF.get(name) or COLUMN_OF.get(_CHANNEL.sub("", name)):
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


def name_and_unit(text: str) -> tuple[str, str | None]:
    """Return the name in a cell and the unit behind it in square brackets, None without these."""
    match = _BRACKETED.fullmatch(text.strip())
    return (match["name"], match["unit"]) if match else (text.strip(), None)


def names_and_units(text: str) -> Iterator[tuple[str, str | None]]:
    """Yield what may be the name and the unit in a cell: the whole, then by every form that fits.

    Text in square brackets is a unit, known or not.
    """
    yield _unquoted(text), None
    name, unit = name_and_unit(_unquoted(text))
    if unit is not None:
        bare = unit.strip()
        yield name, "1" if bare in _NO_UNIT else unit_named(bare, common=False) or bare or None
    for part in _parts(text):
        yield part.name, part.unit


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

    Every cell that is filled must be a unit, and two at least; a dash means none.
    """
    bare = [_unquoted(c).strip("[](){}").strip() for c in cells]
    bare = ["" if c in _NO_UNIT else c for c in bare]
    filled = [c for c in bare if c]
    if len(filled) < 2 or any(_DIGITS.search(c[:1]) for c in filled):
        return None
    if not any(map(unit_named, filled)) or None in [unit_named(c, common=False) for c in filled]:
        return None
    return [(unit_named(c, common=False) or "") if c else "" for c in bare]


def _key(name: str) -> str:
    return re.sub(r"[\s-]+", "_", name.strip().lower())


def _plain(name: str) -> str:
    plain = re.sub(r"\s+", " ", _unquoted(name).rstrip(".").lower().replace("-", " "))
    return _OF_A_PLACE.sub("", plain)


def _unquoted(text: str) -> str:
    return text.strip().strip("\"'").strip()
