"""Cells of text as numbers: decimal signs, thousands, exponents, units, words for no reading."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psa_casadi.errors import InputError
from psa_casadi.records.read.columns import unit_named
from psa_casadi.units import FloatArray, parse_unit

#: What instruments and programs write where there is no reading, in lower case: Keysight's OVLD and
#: OL, PicoScope's infinity, Keyence's -FFFFFFF, MATLAB's and Excel's words, runs of one mark.
_MISSING = re.compile(
    r"""[+-]?(nan|n/?a|n\.a\.|\#n/?a|null|none|nil|missing|invalid|error|err|bad|no\ ?data|
        out\ of\ range|over|ovr|ovf|ovld|ovrng|overflow|overload|overrange|over\ range|under|
        underflow|underrange|o\.?l\.?|∞|infinity|f{4,}|1\.\#(inf|qnan|snan|ind)(00)?|\#(value!|div/0!|num!|null!|name\?))|
        [-+.*?_~\#–—]+""",
    re.I | re.X,
)
#: What SCPI instruments send for an overload and for no number.
_SCPI = (9.9e37, 9.91e37)
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?", re.I)
_FORTRAN = re.compile(r"(?<=[\d.])[dD](?=[+-]?\d+$)")
_GROUPS = re.compile(
    r"[+-]?[1-9]\d{0,2}(?P<mark>[ ,.'’\u00a0\u202f])\d{3}(?:(?P=mark)\d{3})*(?=\D|$)"
)
_WITH_UNIT = re.compile(r"(?P<number>[+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\d\s.,].*)")
SWAPPED = str.maketrans(".,", ",.")


@dataclass
class Parsed:
    """Numbers of one column, nan where there is none; which cells are no numbers or no reading."""

    values: FloatArray
    wrong: NDArray[np.bool_]
    missing: int


def is_number(text: str) -> bool:
    """Whether a text is a number as it may stand in a table, or an empty cell's word."""
    text = text.strip().strip('"').strip()
    return bool(
        _NUMBER.fullmatch(_FORTRAN.sub("e", text)) or text.lower() in ("nan", "inf", "-inf")
    )


def is_missing(text: str) -> bool:
    """Whether a text stands for a reading that is not there."""
    return not text.strip() or _MISSING.fullmatch(text.strip()) is not None


def unit_in(cells: Sequence[str]) -> str | None:
    """Return the unit that stands in the first cell that is a number with a unit, else None."""
    for cell in cells[:50]:
        if (match := _WITH_UNIT.fullmatch(cell.strip())) and not _FORTRAN.search(cell):
            return unit_named(match["unit"], common=False)
        if not is_missing(cell):
            return None
    return None


def decimal_sign(cells: Iterable[str]) -> str:
    """Return the decimal sign of cells: of the first that has one sign only, not between groups.

    Of two signs in one cell the last is the decimal one.
    """
    for cell in cells:
        bare = cell.strip()
        point, comma = bare.rfind("."), bare.rfind(",")
        if point >= 0 and comma >= 0:
            return "." if point > comma else ","
        if max(point, comma) >= 0 and is_number(bare):
            return "." if point >= 0 else ","
    return "."


def without_overload(values: FloatArray) -> Parsed:
    """Return numbers as a column, nan where an instrument sent that there is no reading."""
    over = np.isin(np.abs(values), _SCPI)
    values = np.where(over, math.nan, values) if over.any() else values
    return Parsed(values, np.zeros(values.size, np.bool_), int(np.isnan(values).sum()))


def numbers(cells: Sequence[str], point: str, unit: str) -> Parsed:
    """Return the numbers in texts with a decimal `point`; a cell's own unit is turned to `unit`."""
    plain = cells if point == "." else [c.translate(SWAPPED) for c in cells]
    try:
        values = np.array(list(map(float, plain)))
    except ValueError:
        values = np.zeros(0)
    if values.size == len(cells) and "_" not in "".join(cells):
        return without_overload(values)
    known = {cell: _number(cell, point, unit) for cell in set(cells)}
    found = [known[cell] for cell in cells]
    parsed = without_overload(np.array([math.nan if v is None else v for v in found]))
    wrong = np.array([v is None for v in found], dtype=np.bool_)
    return Parsed(parsed.values, wrong, parsed.missing - int(wrong.sum()))


def _number(cell: str, point: str, unit: str) -> float | None:
    """Return the number of a cell, nan where it says that there is none, else None."""
    text = _FORTRAN.sub("e", cell.strip())
    if is_missing(text):
        return math.nan
    if (groups := _GROUPS.match(text)) and groups["mark"] != point:
        text = groups[0].replace(groups["mark"], "") + text[groups.end() :]
    plain = text.translate(SWAPPED) if point == "," else text
    try:
        return None if "_" in text else float(plain)
    except ValueError:
        match = _WITH_UNIT.fullmatch(text)
    own = unit_named(match["unit"], common=False) if match else None
    value = _number(match["number"], point, unit) if match and own else None
    return None if value is None or own is None else _in_unit(value, own, unit)


def _in_unit(value: float, own: str, unit: str) -> float | None:
    """Return a cell's number in the unit of its column."""
    try:
        one, other = parse_unit(own), parse_unit(unit)
    except InputError:
        return None
    if one.dimension != other.dimension:
        return None
    return value if one == other else value * float(one.ratio / other.ratio)
