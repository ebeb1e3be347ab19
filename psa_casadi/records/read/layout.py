"""Where a text file holds its header and its numbers: below a preamble, with units in a row."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

from psa_casadi.records.read.header_names import columns_known, units_row

#: Lines in which a header is looked for.
_MOST_LINES = 500
_SPACES, _BEFORE_UNIT = re.compile(r"[ \t]+"), re.compile(r"\s+(?=[\[(])")
_NUMBER = re.compile(
    r"\s*\"?\s*([+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?|nan|-?inf)\s*\"?\s*", re.I
)


@dataclass(frozen=True)
class Layout:
    """The header's cells (none where the numbers have no header), and the line they begin at.

    `first` is the index of the first line of numbers, `header_line` that of the header.
    """

    header: tuple[str, ...]
    delimiter: str
    header_line: int
    first: int


def layout(lines: Sequence[str]) -> Layout | None:
    """Return where header and numbers are; None where there is nothing but comments.

    The header is the first line that names two columns of a record, in a comment too if numbers
    follow; where none does, it is the first line that is no comment, and where that one holds
    numbers there is no header. A row of units below is joined to the names.
    """
    start = next((k for k, line in enumerate(lines) if _told(line)), None)
    if start is None:
        return None
    plain = _named(lines, [start])
    place = plain if plain is not None else _named(lines, range(min(len(lines), _MOST_LINES)))
    delimiter = delimiter_of(lines[start if place is None else place].lstrip("#"))
    if place is None:
        header = cells_of(lines[start], delimiter, spaced=True)
        if len(header) > 1 and all(_NUMBER.fullmatch(c) for c in header):
            return Layout((), delimiter, start, start)
        return Layout(tuple(header), delimiter, start, start + 1)
    header = cells_of(lines[place].lstrip("# "), delimiter, spaced=True)
    below = place + 1
    if below < len(lines):
        units = units_row(cells_of(lines[below].lstrip("# "), delimiter))
        if units is not None and len(units) == len(header):
            header = [f"{n.strip()} [{u}]" if u else n for n, u in zip(header, units, strict=True)]
            below += 1
    return Layout(tuple(header), delimiter, place, below)


def cells_of(line: str, delimiter: str, *, spaced: bool = False) -> list[str]:
    """Return the cells of a line; the delimiter " " stands for any number of spaces.

    `spaced` says that a space may stand before a quoted cell.
    """
    if delimiter == " ":
        return _SPACES.split(_BEFORE_UNIT.sub("", line.strip()))
    if '"' not in line:
        return line.split(delimiter)
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=spaced), [])
    except csv.Error:  # a cell of more than 128 KiB, as where a quote never ends
        return line.split(delimiter)


def delimiter_of(line: str) -> str:
    """Return the one of comma, semicolon and tab that a line holds most often, else a space."""
    most = max(",;\t", key=line.count)
    return most if most in line else " "


def _told(line: str) -> bool:
    return bool(line.strip()) and not line.startswith("#")


def _named(lines: Sequence[str], places: Sequence[int]) -> int | None:
    """Return the first of the places that names two columns, and has more lines below."""
    for k in places:
        line = lines[k].lstrip("# ")
        for delimiter in dict.fromkeys((delimiter_of(line), " ")):
            if columns_known(cells_of(line, delimiter)) >= 2 and _numbers_follow(lines, k):
                return k
    return None


def _numbers_follow(lines: Sequence[str], k: int) -> bool:
    """Whether a line of numbers comes within three lines of line k, where that is a comment."""
    if not lines[k].startswith("#"):
        return True
    return any(
        _NUMBER.fullmatch(cells_of(line, delimiter_of(line))[0]) is not None
        for line in lines[k + 1 : k + 4]
        if line.strip()
    )
