"""Where the tables of a text are: preamble, header, units in a row, remarks, further headers."""

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from psa_casadi.records.read import table
from psa_casadi.records.read.columns import columns_known, stated_unit, units_row
from psa_casadi.records.read.table import is_stamp

#: Lines in which the first header is looked for, and the most that are asked for further ones.
_MOST_LINES, _MOST_HEADERS = 500, 20_000
#: The most rows of remarks below the units.
_MOST_REMARKS = 3
SPACES, _BEFORE_UNIT = re.compile(r"[ \t]+"), re.compile(r"\s+(?=[\[(])")
_WIDE = re.compile(r"\s*\t\s*|[ ]{2,}")
#: How a line begins that may be a header: with a letter or a bracket, perhaps quoted or a comment.
WORDY = re.compile(r"[#%\s\"']*[^\W\d_(\[]")


@dataclass(frozen=True)
class Layout:
    """The header's cells, the delimiter, and the lines of the header and of the first numbers."""

    header: tuple[str, ...]
    delimiter: str
    header_line: int
    first: int


def laid_out(lines: Sequence[str], mark: str) -> Layout | None:
    """Return where the first header and its numbers are; "" for a `mark` that is not told."""
    start = next((k for k, line in enumerate(lines) if holds(line)), None)
    if start is None:
        return None
    plain = _named(lines, [start], mark)
    place = plain if plain is not None else _named(lines, range(min(len(lines), _MOST_LINES)), mark)
    if place is None:
        numbers = _numbers(lines[start], mark)
        if numbers:
            return Layout((), numbers, start, start)
        place = _above_numbers(lines, start, mark)
    return _with_header(lines, place, mark)


def _with_header(lines: Sequence[str], place: int, mark: str) -> Layout:
    delimiter = mark or delimiter_of(lines[place].lstrip("#% "))
    header = cells_of(lines[place].lstrip("#% "), delimiter, spaced=True)
    below = place + 1
    if below < len(lines):
        units = units_row(cells_of(lines[below].lstrip("#% "), delimiter))
        if units is not None and len(units) == len(header):
            pairs = zip(header, units, strict=True)
            header = [f"{n.strip()} [{u}]" if u and not stated_unit(n) else n for n, u in pairs]
            below += 1
    for k, line in enumerate(lines[below : below + _MOST_REMARKS + 1]):
        if _numbers(line, mark):  # below remarks, as Origin has them under its units
            below += k
            break
        if not _is_remark(line, delimiter):
            break
    while len(header) > 1 and not header[-1].strip():
        header.pop()
    row = lines[below] if below < len(lines) else ""
    if delimiter in " \t" and not mark and len(cells_of(row, delimiter)) != len(header):
        for form in (_WIDE, SPACES):  # names with spaces in them, tabs and spaces mixed
            names = form.split(_BEFORE_UNIT.sub(" ", lines[place].strip("#% \t")))
            if len(names) == len(cells_of(row, " ")) and _numbers(row, " "):
                header, delimiter = names, " "
                break
    return Layout(tuple(header), delimiter, place, below)


def further_layouts(lines: Sequence[str], mark: str, first: Layout) -> Iterator[Layout]:
    """Yield the layouts of the headers below the first one."""
    asked, begin = 0, first.first
    if not first.header:
        return
    for k in range(first.first + 1, len(lines)):
        if k < begin or not WORDY.match(lines[k]):
            continue
        asked += 1
        if asked > _MOST_HEADERS:
            return
        if _named(lines, [k], mark, sure=True) is not None:
            found = _with_header(lines, k, mark)
            if found.delimiter == first.delimiter:
                begin = found.first
                yield found


def end_of_rows(lines: Sequence[str], layout: Layout, end: int) -> int:
    """Return where the rows of a table end: above the preamble of the next one."""
    if end == len(lines):
        return end
    while end > layout.first and not (
        (cells := cells_of(lines[end - 1], layout.delimiter))
        and len(cells) >= len(layout.header)
        and (table.is_number(cells[0]) or is_stamp(cells[0]))
    ):
        end -= 1
    return end


def _is_remark(line: str, delimiter: str) -> bool:
    """Whether a line below a header holds words and no number."""
    cells = [c for c in cells_of(line, delimiter) if c.strip()]
    return bool(cells) and not any(
        table.is_number(c) or is_stamp(c) or table.is_missing(c) or table.unit_in([c])
        for c in cells
    )


def cells_of(line: str, delimiter: str, *, spaced: bool = False) -> list[str]:
    """Return the cells of a line; the delimiter " " stands for any number of spaces.

    `spaced` says that a space may stand before a quoted cell.
    """
    if delimiter == " ":
        return SPACES.split(_BEFORE_UNIT.sub("", line.strip()))
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


def holds(line: str) -> bool:
    """Whether a line has something in it and is no comment."""
    return bool(line.strip()) and not line.startswith("#")


def _numbers(line: str, mark: str) -> str:
    """Return what separates the numbers of a line, "" where it does not hold numbers alone.

    Where numbers have decimal commas, that is no comma.
    """
    for delimiter in [mark] if mark else dict.fromkeys((delimiter_of(line), ";", "\t", " ")):
        cells = [c for c in cells_of(line, delimiter) if c.strip()]
        if len(cells) > 1 and all(map(table.is_number, cells)):
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
    return first - 1 if alike and not table.is_number(cells[-2][0]) else start


def _named(
    lines: Sequence[str], places: Sequence[int], mark: str, *, sure: bool = False
) -> int | None:
    """Return the first of the places that names two columns, and has more lines below.

    `sure` demands numbers below in any case, not only below a comment.
    """
    for k in places:
        line = lines[k].lstrip("#% ")
        for delimiter in [mark] if mark else dict.fromkeys((delimiter_of(line), " ")):
            known = columns_known(cells_of(line, delimiter))
            if known >= 2 and (
                not (sure or lines[k].startswith(("#", "%"))) or _follow(lines, k, mark)
            ):
                return k
    return None


def _follow(lines: Sequence[str], k: int, mark: str) -> bool:
    """Whether a line that begins with a number comes within three lines of line k."""
    return any(
        table.is_number(cells_of(line, mark or delimiter_of(line))[0])
        for line in lines[k + 1 : k + 4]
        if line.strip()
    )
