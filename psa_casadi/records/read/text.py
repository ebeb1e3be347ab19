"""Tables in the lines of a text or of a spreadsheet: preamble, header, units in a row, several.

LabVIEW measurement files (`.lvm`), the data recorders of PI controllers (GCS arrays) and
oscilloscopes by Rigol and Tektronix keep the names of the columns and the sample time in a head, or
next to the numbers. They become a plain table of the same number of lines, so that mistakes are
reported with the line of the file.

Sources: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)"; Physik
Instrumente, "GCS Array Data Format".
"""

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import FloatArray, to_si, units_of
from psa_casadi.records.read.columns import (
    columns_known,
    measures,
    name_and_unit,
    stated_unit,
    understood,
    unit_named,
    units_row,
)
from psa_casadi.records.read.table import (
    SWAPPED,
    Cells,
    Columns,
    Table,
    as_numbers,
    decimal_sign,
    is_missing,
    is_number,
    is_stamp,
    unit_in,
    unit_of_times,
)
from psa_casadi.records.record import COLUMNS, FEWEST_SAMPLES

#: Lines in which the first header is looked for, and the most in which further ones are.
_MOST_LINES, _MOST_HEADERS = 500, 20_000
#: The most rows of remarks below the units.
_MOST_REMARKS = 3
SPACES, _BEFORE_UNIT = re.compile(r"[ \t]+"), re.compile(r"\s+(?=[\[(])")
_WIDE = re.compile(r"\s*\t\s*|[ ]{2,}")
#: The start of a line that may be a header: a letter or a bracket, perhaps quoted or a comment.
WORDY = re.compile(r"[#%\s\"']*[^\W\d_(\[]")


@dataclass(frozen=True)
class Layout:
    """The header's cells, the delimiter, and the lines of the header and of the first numbers."""

    header: tuple[str, ...]
    delimiter: str
    header_line: int
    first: int


def laid_out(lines: Sequence[str], mark: str) -> Layout | None:
    """Return the place of the first header and its numbers; `mark` is "" if it is not stated."""
    start = next((k for k, line in enumerate(lines) if has_content(line)), None)
    if start is None:
        return None
    place = _named(lines, [start, *range(min(len(lines), _MOST_LINES))], mark)
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
        cells = [c for c in cells_of(line, delimiter) if c.strip()]
        if not cells or any(
            is_number(c) or is_stamp(c) or is_missing(c) or unit_in([c]) for c in cells
        ):
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
    tried, begin = 0, first.first
    for k in range(first.first + 1, len(lines)) if first.header else ():
        if k < begin or not WORDY.match(lines[k]):
            continue
        tried += 1
        if tried > _MOST_HEADERS:
            return
        if _named(lines, [k], mark, sure=True) is not None:
            layout = _with_header(lines, k, mark)
            if layout.delimiter == first.delimiter:
                begin = layout.first
                yield layout


def cells_of(line: str, delimiter: str, *, spaced: bool = False) -> list[str]:
    """Return the cells of a line; the delimiter " " means any number of spaces.

    With `spaced` a space may precede a quoted cell.
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


def has_content(line: str) -> bool:
    """Whether a line has something in it and is no comment."""
    return bool(line.strip()) and not line.startswith("#")


def _numbers(line: str, mark: str) -> str:
    """Return what separates the numbers of a line, "" where it does not hold numbers alone.

    Where numbers have decimal commas, that is no comma.
    """
    for delimiter in [mark] if mark else dict.fromkeys((delimiter_of(line), ";", "\t", " ")):
        cells = [c for c in cells_of(line, delimiter) if c.strip()]
        if len(cells) > 1 and all(map(is_number, cells)):
            return delimiter
    return ""


def _above_numbers(lines: Sequence[str], start: int, mark: str) -> int:
    """Return the line of names, and of units below it, above the first numbers, else the first."""
    places = range(start, min(len(lines), _MOST_LINES))
    first = next((k for k in places if _numbers(lines[k], mark)), start)
    of_numbers = mark or _numbers(lines[first], mark).strip(" ")
    cells = [
        cells_of(line, of_numbers if of_numbers and of_numbers in line else delimiter_of(line))
        for line in lines[max(start, first - 2) : first + 1]
    ]
    if len(cells) == 3 and len(cells[0]) == len(cells[2]) and units_row(cells[1]) is not None:
        return first - 2
    similar = len(cells) > 1 and len(cells[-2]) == len(cells[-1])
    return first - 1 if similar and not is_number(cells[-2][0]) else start


def _named(
    lines: Sequence[str], places: Sequence[int], mark: str, *, sure: bool = False
) -> int | None:
    """Return the first of the places that names two columns, and has more lines below.

    `sure` demands numbers below in any case, not only below a comment.
    """
    for k in places:
        line = lines[k].lstrip("#% ")
        marks = [mark] if mark else dict.fromkeys((delimiter_of(line), " "))
        if all(columns_known(cells_of(line, delimiter)) < 2 for delimiter in marks):
            continue
        below = [b for b in lines[k + 1 : k + 4] if b.strip()]
        if not (sure or lines[k].startswith(("#", "%"))) or any(
            is_number(cells_of(b, mark or delimiter_of(b))[0]) for b in below
        ):
            return k
    return None


#: The most lines below a table that are recognised as no samples: sums, means, an end mark.
_MOST_BELOW = 20
#: A first line that declares the separator of the cells to Excel.
_EXCEL_MARK = re.compile(r"\s*\"?sep=([^\w\s]|\t)\"?[\s,;]*", re.I)
_IN_BRACKETS = re.compile(r"(?P<name>.*?)\s*[\[({](?P<unit>[^\[\](){}]+)[\])}]")
_COMMENTS = ("#", "%", "!", "//", ";")


def text_tables(path: str, lines: Sequence[str], place: str, name: str = "") -> list[Table]:
    """Return the tables in lines, each from its header on; none in nothing but comments.

    The header is the first line that names two columns of a record, in a comment too if numbers
    follow; where none does, it is the line above the first numbers, else the first line that is no
    comment, and where that one holds numbers there is no header. A row of units below is joined to
    the names. A first line `sep=;` declares the separator of the cells.

    Raises:
        InputError: the head of an instrument's file is damaged.
    """
    lines, header, step = instrument_lines(path, lines) if place == "line" else (lines, (), None)
    mark = ""
    if lines and (separator := _EXCEL_MARK.fullmatch(lines[0])):
        mark, lines = separator[1], ["", *lines[1:]]
    first = _in_rows(lines, mark) or laid_out(lines, mark)
    if header:
        first = Layout(header, delimiter_of(next(filter(has_content, lines), "")), 0, 0)
    if first is None:
        return []
    if isinstance(first, Table):
        return [replace(first, path=path, where=f"{path}: {place} 1", name=name)]
    layouts = [first, *further_layouts(lines, mark, first)]
    ends = [*(layout.header_line for layout in layouts[1:]), len(lines)]
    step = step or stated_step(lines[: first.first])
    tables: list[Table] = []
    for layout, stop in zip(layouts, ends, strict=True):
        end = stop
        if len(layouts) > 1 and end - layout.first < FEWEST_SAMPLES:
            continue
        while layout.first < end < len(lines):  # above the preamble of the next one
            cells = cells_of(lines[end - 1], layout.delimiter)
            if len(cells) >= len(layout.header) and (is_number(cells[0]) or is_stamp(cells[0])):
                break
            end -= 1
        part = _Part(path, place, layout, lines[layout.first : end])
        tables += _side_by_side(part.table(name, step))
    if len(tables) == 1:
        return tables
    return [replace(t, name=f"{name}.{k}" if name else "") for k, t in enumerate(tables, 1)]


def _side_by_side(table: Table) -> list[Table]:
    """Return the tables that lie side by side: the header has the same names again."""
    header = list(table.header)
    first = next((text for text in header if text.strip()), None)
    starts = [k for k, text in enumerate(header) if text == first]
    parts = [range(a, b) for a, b in pairwise([*starts, len(header)])]
    widths = {len([k for k in part if header[k].strip()]) for part in parts}
    is_one = len(starts) < 2 or len(set(header)) == 1 or len(widths) > 1 or widths == {1}
    if is_one or table.headless:
        return [table]
    return [table.part(table.name, part) for part in parts]


@dataclass(frozen=True, eq=False)
class _Part:
    """The lines of one table below its header."""

    path: str
    place: str
    layout: Layout
    rows: Sequence[str]

    def table(self, name: str, step: float | None) -> Table:
        layout = self.layout
        first = next((row for row in self.rows if has_content(row)), "")
        width = len(layout.header) or len(self._cells(first))
        bare = Table(
            path=self.path, name=name, header=layout.header or [""] * width, labels=[],
            where=f"{self.path}: {self.place} {layout.header_line + 1}", place=self.place,
            load=self._load, step=step,
        )  # fmt: skip
        if not layout.header:
            numbered = tuple(str(k) for k in range(1, width + 1))
            headless = ",".join(self._cells(first))
            return replace(bare, header=numbered, labels=numbered, headless=headless)
        header = [_with_unit(h, c) for h, c in zip(layout.header, bare.glance, strict=True)]
        return replace(bare, header=header, labels=[name_and_unit(text)[0] for text in header])

    def _cells(self, row: str) -> list[str]:
        return cells_of(row, self.layout.delimiter)

    def _load(self, numbers: Sequence[int], most: int | None, problems: Problems) -> Columns:
        kept = self._kept
        rows = [self.rows[k] for k in kept[:most]]
        lines = np.asarray(kept[:most], dtype=np.int64) + self.layout.first + 1
        quick = self._at_once(rows, numbers)
        if quick is not None:
            return Columns([quick[:, k] for k in range(len(numbers))], lines)
        width = max(len(self.layout.header), max(numbers, default=0) + 1)
        split, whole = [], []
        for line, row in zip(lines, rows, strict=True):
            cells = self._cells(row)
            if most is not None:  # a glance reports no mistakes
                cells = [*cells, *[""] * width][:width]
            spare = len(cells) - width
            if (spare > 0 and any(c.strip() for c in cells[width:])) or (
                spare < 0 and len(cells) <= max(numbers, default=0)
            ):
                hint = f"complete or remove the {self.place}"
                if self.layout.delimiter == "," and len(cells) == 2 * width:
                    hint = "where numbers have decimal commas, separate the cells by semicolons"
                problems.add(
                    f"{self.path}: {self.place} {line}: found {len(cells)} cells, expected"
                    f" {width} as in the header; {hint}."
                )
                continue
            split.append(cells)
            whole.append(line)
        columns = [[cells[k] for cells in split] for k in numbers]
        return Columns(columns, np.array(whole, dtype=np.int64))

    @cached_property
    def _kept(self) -> list[int]:
        """Return the indices of the rows that hold cells, up to the text below the numbers.

        That starts with a word and differs from the rows above it.
        """
        marks = tuple(m for m in _COMMENTS if m != self.layout.delimiter)
        kept = [k for k, row in enumerate(self.rows) if row.strip() and not row.startswith(marks)]
        most, below = min(_MOST_BELOW, len(kept) - FEWEST_SAMPLES), 0
        while below < most and not WORDY.match(self.rows[0]):
            wordy = self._cells(self.rows[kept[-1 - below]])[0].strip()
            if not WORDY.match(wordy) or is_missing(wordy) or is_stamp(wordy):
                break
            below += 1
        return kept[: len(kept) - below] if below < _MOST_BELOW else kept

    def _at_once(self, rows: Sequence[str], numbers: Sequence[int]) -> FloatArray | None:
        """Let NumPy read all rows; None if any of them needs a closer look."""
        body, mark = "\n".join(rows), self.layout.delimiter
        point = decimal_sign([c for row in rows[:20] for c in self._cells(row)])
        if not body or '"' in body or (point == "," and mark == ","):
            return None
        if mark == " ":
            rows = [SPACES.sub(" ", row.strip()) for row in rows]
            body = "\n".join(rows)
        width = len(self.layout.header) or rows[0].count(mark) + 1
        if body.count(mark) != len(rows) * (width - 1):
            return None
        if point == ",":
            rows = body.translate(SWAPPED).split("\n")
        del body  # of a long record it is as large as the rows
        try:
            values = np.loadtxt(rows, delimiter=mark, comments=None, usecols=numbers, ndmin=2)
        except ValueError:
            return None
        return None if np.any((np.abs(values) > 1e8) & np.isfinite(values)) else values


def _with_unit(text: str, cells: Cells) -> str:
    """Return a header's cell with the unit that only the cells below it imply.

    That is the second for dates and clock times, the unit behind the numbers, or what makes a
    number the time since 1970. In a cell in capitals the unit is written as it is: `TIME(S)`.
    """
    bare, unit = name_and_unit(text)
    if unit is not None and unit_named(unit) == "s" and ":" in unit:
        return f"{bare} [s]"
    capitals = _IN_BRACKETS.fullmatch(text.strip()) if text.isupper() else None
    name = understood(capitals["name"]) if capitals else None
    if capitals and name and not measures(name.column, capitals["unit"]):
        units = [u for quantity in COLUMNS[name.column].quantities for u in units_of(quantity)]
        small = [u for u in units if u.lower() == capitals["unit"].lower()]
        text = f"{capitals['name']} [{small[0]}]" if small else text
    if stated_unit(text) or unit:
        return text
    below = _unit_below(text, cells)
    return f"{text.strip()} [{below}]" if below else text


def _unit_below(text: str, cells: Cells) -> str | None:
    """Return the unit that the cells below a header's cell imply, None if they imply none."""
    if not isinstance(cells, np.ndarray):
        cells = [c for c in cells if c.strip()]
        if cells and is_stamp(cells[0]):
            return "s"
        if unit := unit_in(cells):
            return unit
    name = understood(text)
    is_time = name is not None and name.column == "time"
    return unit_of_times(as_numbers(cells[:9], "s")) if is_time else None


def _in_rows(lines: Sequence[str], mark: str) -> Table | None:
    """Return the table of records that lie in rows: each a name with its numbers behind it."""
    rows = [line for line in lines[:100] if line.strip() and not line.startswith("#")]
    if not 2 <= len(rows) <= 64 or len([line for line in lines if line.strip()]) > 100:
        return None
    delimiter = mark or delimiter_of(rows[0])
    cells = [cells_of(row.rstrip(delimiter), delimiter) for row in rows]
    width = len(cells[0])
    if width <= FEWEST_SAMPLES or any(
        len(row) != width or is_number(row[0]) or not all(map(is_number, row[1:9])) for row in cells
    ):
        return None
    header = [_with_unit(row[0], row[1:]) for row in cells]

    def load(numbers: Sequence[int], most: int | None, _: Problems) -> Columns:
        end = width if most is None else min(width, most + 1)
        return Columns([cells[k][1:end] for k in numbers], np.arange(1, end))

    return Table("", "", header, [name_and_unit(h)[0] for h in header], "", "sample", load)


def decoded(data: bytes, path: str) -> str:
    """Return the text of a file: UTF-8, UTF-16 with or without a mark, or Windows-1252.

    Raises:
        InputError: it is no text.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return data.decode("utf-16")
        except UnicodeDecodeError:
            raise InputError(
                f"{path}: starts as UTF-16 text and is none; save it as 'CSV UTF-8'."
            ) from None
    for first, coding in ((1, "utf-16-le"), (0, "utf-16-be")):  # Windows' text without a mark
        if data[first : first + 3 : 2] == b"\0\0" and len(data) % 2 == 0:
            return data.decode(coding, errors="replace")
    if b"\0" in data:
        raise InputError(
            f"{path}: is not text but a binary file; export the record as CSV and name that file."
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


_END = "***End_of_Header***"
_ENTRY = re.compile(r"#\s*(?P<key>[A-Z_]+[0-9]*)\s*=\s*(?P<value>.*?)\s*")
#: How a head states the time between samples, or their rate, with a unit before or behind it.
_STEP = re.compile(
    r"""\W*(?P<name>[\w ]*?(?:(?P<rate>rate|freq\w*|\bfs)|interval|period|increment|\bx ?incr?|
        \bdt|\bts|step|delta[_ ]?[xt]|sample[_ ]?time|sampling[_ ]?time))\s*
        [\[(]?(?P<before>[A-Za-zµ/]+)?[\])]?[\s:=,;"']+(?P<number>[\d.,]+(?:[eE][+-]?\d+)?)"?
        [\s,;"\[(]*(?P<unit>[A-Za-zµ]+(?:/s|PS)?)?.*""",
    re.I | re.X,
)
_SAMPLES = ("sampl", "acqui", "record", "scan", "adc", "time", "x", "delta", "dt",
            "fs", "ts", "wf", "incr")  # fmt: skip


Form = tuple[Sequence[str], tuple[str, ...], float | None]


def instrument_lines(path: str, lines: Sequence[str]) -> Form:
    """Return the lines of a table where an instrument wrote them in its form, else the same lines.

    With them come the header of a table that has none among its lines, and the time between samples
    [s] that the head states.

    Raises:
        InputError: the head is damaged, or the channels were sampled at different instants.
    """
    if lines[0].strip().startswith("LabVIEW Measurement"):
        return _labview(path, lines), (), None
    names = [cell.strip() for cell in lines[0].strip().rstrip(",").split(",")]
    if names[0] == "Record Length" and len(names) > 4:
        return _tektronix(lines)
    if names[0] == "X" and names[-2:] == ["Start", "Increment"] and len(lines) > 1:
        return _rigol(path, lines, names[1:-2])
    head = lines[:_MOST_LINES]
    ends = (k for k, line in enumerate(head) if re.fullmatch(r"#\s*END_HEADER\s*", line))
    end = next(ends, None)
    return (lines, (), None) if end is None else _data_recorder(path, lines, end)


def stated_step(lines: Sequence[str]) -> float | None:
    """Return the time between samples [s] that the lines above a table state, None without one."""
    steps = set()
    for line in lines[:_MOST_LINES]:
        match = _STEP.fullmatch(line)
        if match is None or not match["name"].lower().lstrip("# ").startswith(_SAMPLES):
            continue
        number, is_rate = _number(match["number"].rstrip(",")), match["rate"] is not None
        unit = unit_named(match["unit"] or "") or unit_named(match["before"] or "")
        unit = unit or ("Hz" if is_rate else "s")
        try:
            converted = to_si(number, unit)
        except InputError:
            continue
        if 0.0 < converted < 1e12:
            steps.add(1.0 / converted if unit.endswith("Hz") or is_rate else converted)
    return steps.pop() if len(steps) == 1 else None


def _tektronix(lines: Sequence[str]) -> Form:
    """Return the time and the value of a channel, in columns next to the settings."""
    rows = [[cell.strip() for cell in line.split(",")] for line in lines]
    settings = {row[0]: row[1] for row in rows if len(row) > 1 and row[0]}
    unit = unit_named(settings.get("Vertical Units", ""))
    clock = unit_named(settings.get("Horizontal Units", ""))
    name = settings.get("Source") or "value"
    header = (f"time [{clock or 's'}]", f"{name} [{unit}]" if unit else name)
    return [",".join(row[3:5]) if len(row) > 4 else "" for row in rows], header, None


def _data_recorder(path: str, lines: Sequence[str], end: int) -> Form:
    """Return a PI data recorder's table: names and sample time stand in comments above it."""
    head = {m["key"]: m["value"] for line in lines[:end] if (m := _ENTRY.fullmatch(line))}
    names = tuple(value for key, value in head.items() if re.fullmatch(r"NAME\d+", key) and value)
    if not names:
        raise InputError(
            f"{path}: its head names no columns (NAME0, NAME1, ...); record the data again."
        )
    return [*[""] * (end + 1), *lines[end + 1 :]], names, stated_step(lines[:end])


def _rigol(path: str, lines: Sequence[str], channels: Sequence[str]) -> Form:
    """Return the channels of a Rigol oscilloscope, whose rows are counted."""
    units = [cell.strip() for cell in lines[1].strip().rstrip(",").split(",")]
    step = _positive(f"{path}: line 2", "Increment", units[-1])
    named = zip(channels, map(unit_named, units[1:]), strict=False)
    header = tuple(f"{name} [{unit}]" if unit else name for name, unit in named)
    rows = [",".join(line.split(",")[1 : 1 + len(channels)]) for line in lines[2:]]
    return ["", "", *rows], header, step


def _labview(path: str, lines: Sequence[str]) -> Sequence[str]:
    """Return the segments of a LabVIEW measurement as one table."""
    ends = [k for k, line in enumerate(lines) if line.startswith(_END)]
    if len(ends) < 2:
        raise InputError(f"{path}: the head of this LabVIEW file does not end; save it again.")
    head = _entries(lines[: ends[0]], "[\t,]")
    mark = "," if head.get("Separator", [""])[0].lower() == "comma" else "\t"
    columns = head.get("X_Columns", ["One"])[0]
    rows, header = [""] * len(lines), ""
    for start, end, stop in zip(ends, ends[1:], [*ends[2:], len(lines)], strict=False):
        segment = _entries(lines[start + 1 : end], mark)
        if end + 1 >= stop:
            raise InputError(f"{path}: line {end + 1}: no columns follow; save the file again.")
        names = _labview_names(lines[end + 1].split(mark), segment.get("Y_Unit_Label", ()))
        if header and names != header:
            raise InputError(
                f"{path}: line {end + 2}: this part has other columns than the one before; save"
                " each part as a separate file."
            )
        if not header:
            rows[end + 1] = header = names
        for k, row in enumerate(lines[end + 2 : stop], end + 2):
            if not row.strip() or row.startswith("Channels"):  # the head of the next part
                break
            cells = row.split(mark)
            if columns == "No":
                cells[0] = _labview_time(f"{path}: line {k + 1}", row, segment, k - end - 2)
            elif columns == "Multi" and len({c for c in cells[: len(cells) // 2 * 2 : 2] if c}) > 1:
                raise InputError(
                    f"{path}: line {k + 1}: the channels were sampled at different instants; save"
                    " them on one time axis."
                )
            cells += [""] * (header.count("\t") + 1 - len(cells))
            rows[k] = "\t".join(cells)
    return rows


def _entries(lines: Sequence[str], mark: str) -> dict[str, list[str]]:
    rows = ([cell.strip() for cell in re.split(mark, line)] for line in lines)
    return {key: values or [""] for key, *values in rows}


def _labview_names(cells: Sequence[str], units: Sequence[str]) -> str:
    """Return the header: one time, and the channels with the units that are stated."""
    names: list[str] = []
    left = iter(units)
    for name in map(str.strip, cells):
        if name == "X_Value":
            names.append("" if names else "X_Value [s]")
        else:
            unit = unit_named(next(left, "")) if name != "Comment" else None
            names.append(f"{name} [{unit}]" if unit else name)
    return "\t".join(names)


def _labview_time(where: str, row: str, segment: Mapping[str, Sequence[str]], k: int) -> str:
    """Return the time that steps give to row k of a part, with the decimal sign of its row."""
    first, step = (segment.get(key, [""])[0] for key in ("X0", "Delta_X"))
    start = _number(first) if first else 0.0
    time = f"{start + k * _positive(where, 'Delta_X', step):.12g}"
    return time.replace(".", ",") if "," in row and "." not in row else time


def _number(text: str) -> float:
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return math.nan


def _positive(where: str, key: str, text: str) -> float:
    step = _number(text)
    if not 0.0 < step < 1e9:
        raise InputError(
            f"{where}: the head gives no sample time ({key} is '{text[:40]}'); record it again."
        )
    return step
