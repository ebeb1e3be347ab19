"""Where a text file holds its header and its numbers: below a preamble, with units in a row."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

from psa_casadi.records.read.header_names import columns_known, stated_unit, units_row

#: Lines in which a header is looked for.
_MOST_LINES = 500
_SPACES, _BEFORE_UNIT = re.compile(r"[ \t]+"), re.compile(r"\s+(?=[\[(])")
#: A first line that tells Excel what separates the cells.
_TOLD_MARK = re.compile(r"\s*\"?sep=([^\w\s]|\t)\"?[\s,;]*", re.I)
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
    follow; where none does, it is the line above the first numbers, else the first line that is no
    comment, and where that one holds numbers there is no header. A row of units below is joined to
    the names. A first line `sep=;` says what separates the cells.
    """
    told = _TOLD_MARK.fullmatch(lines[0]) if lines else None
    if told is not None:
        return _laid_out(["", *lines[1:]], told[1])
    return _laid_out(lines, "")


def _laid_out(lines: Sequence[str], mark: str) -> Layout | None:
    """Return the layout of lines whose cells `mark` separates; "" where that is not told."""
    start = next((k for k, line in enumerate(lines) if _told(line)), None)
    if start is None:
        return None
    plain = _named(lines, [start], mark)
    place = plain if plain is not None else _named(lines, range(min(len(lines), _MOST_LINES)), mark)
    if place is None:
        numbers = _numbers(lines[start], mark)
        if numbers:
            return Layout((), numbers, start, start)
        place = _above_numbers(lines, start, mark)
    delimiter = mark or delimiter_of(lines[place].lstrip("#"))
    header = cells_of(lines[place].lstrip("# "), delimiter, spaced=True)
    below = place + 1
    if below < len(lines):
        units = units_row(cells_of(lines[below].lstrip("# "), delimiter))
        if units is not None and len(units) == len(header):
            pairs = zip(header, units, strict=True)
            header = [f"{n.strip()} [{u}]" if u and not stated_unit(n) else n for n, u in pairs]
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


def _numbers(line: str, mark: str) -> str:
    """Return what separates the numbers of a line, "" where it does not hold numbers alone.

    Where numbers have decimal commas, that is no comma.
    """
    for delimiter in [mark] if mark else dict.fromkeys((delimiter_of(line), ";", "\t", " ")):
        cells = cells_of(line, delimiter)
        if len(cells) > 1 and all(_NUMBER.fullmatch(c) for c in cells):
            return delimiter
    return ""


def _above_numbers(lines: Sequence[str], start: int, mark: str) -> int:
    """Return the line of names, and of units below it, above the first numbers, else the first."""
    places = range(start, min(len(lines), _MOST_LINES))
    first = next((k for k in places if _numbers(lines[k], mark)), start)
    told = mark or _numbers(lines[first], mark).strip(" ")
    cells = [
        cells_of(line, told if told and told in line else delimiter_of(line))
        for line in lines[max(start, first - 2) : first + 1]
    ]
    if len(cells) == 3 and len(cells[0]) == len(cells[2]) and units_row(cells[1]) is not None:
        return first - 2
    alike = len(cells) > 1 and len(cells[-2]) == len(cells[-1])
    return first - 1 if alike and not _NUMBER.fullmatch(cells[-2][0]) else start


def _named(lines: Sequence[str], places: Sequence[int], mark: str) -> int | None:
    """Return the first of the places that names two columns, and has more lines below."""
    for k in places:
        line = lines[k].lstrip("# ")
        for delimiter in [mark] if mark else dict.fromkeys((delimiter_of(line), " ")):
            known = columns_known(cells_of(line, delimiter))
            if known >= 2 and _numbers_follow(lines, k, mark):
                return k
    return None


def _numbers_follow(lines: Sequence[str], k: int, mark: str) -> bool:
    """Whether a line of numbers comes within three lines of line k, where that is a comment."""
    if not lines[k].startswith("#"):
        return True
    return any(
        _NUMBER.fullmatch(cells_of(line, mark or delimiter_of(line))[0]) is not None
        for line in lines[k + 1 : k + 4]
        if line.strip()
    )
