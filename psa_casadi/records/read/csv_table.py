"""From the bytes of a CSV file to named columns of numbers, with every mistake located."""

import hashlib
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.columns import Field
from psa_casadi.records.read.file_bytes import check_size, read_bytes, unpacked
from psa_casadi.records.read.instrument_text import instrument_lines
from psa_casadi.records.read.layout import cells_of, layout
from psa_casadi.units import FloatArray

#: Bytes in memory of the fewest columns that a record has: a time and one number.
_LEAST_ON_A_LINE = 16


@dataclass(frozen=True)
class CsvText:
    """The text of a file, split into its header and the rows below it.

    `rows` are the lines after the header; `first_line` is the line number of the first of them. The
    header is empty where the file has none.
    Numbers have a decimal `point`, or a decimal comma where spreadsheets of that custom wrote them.
    """

    path: str
    sha256: str
    header: tuple[str, ...]
    delimiter: str
    rows: tuple[str, ...]
    first_line: int
    header_line: int
    point: str = "."

    @property
    def where_header(self) -> str:
        """File and line of the header, as sentences about it begin."""
        return f"{self.path}: line {self.header_line}"

    def numbered(self) -> "CsvText":
        """Return the text of a file without a header with one that counts the columns from 1."""
        cells = cells_of(self.rows[0], self.delimiter)
        return replace(self, header=tuple(str(k) for k in range(1, len(cells) + 1)))


@dataclass(frozen=True)
class Numbers:
    """Values of the wanted columns, shape (rows, columns); nan where a cell is empty or unreadable.

    `lines` holds the line number of each row, and `reported` is True where a cell's text was
    already reported as unreadable.
    """

    values: FloatArray
    lines: NDArray[np.int64]
    reported: NDArray[np.bool_]


def load_text(path: str | os.PathLike[str]) -> CsvText:
    """Read a text file, gzipped or not, and split off its header (see `layout`).

    The delimiter is the one of comma, semicolon and tab that the header holds most often, else any
    number of spaces.

    Raises:
        InputError: the file is missing, a directory, empty, unreadable, too large, not text, or
            only comments.
    """
    data = read_bytes(path)
    content = unpacked(data, path)
    lines_at_most = max(content.count(b"\n"), content.count(b"\r"))
    check_size(path, _LEAST_ON_A_LINE * lines_at_most, "its lines need")
    text = _decode(content, str(path)).replace("\r\n", "\n").replace("\r", "\n")
    lines = instrument_lines(str(path), text.split("\n"))
    return laid_out(str(path), hashlib.sha256(data).hexdigest(), lines)


def laid_out(path: str, digest: str, lines: Sequence[str]) -> CsvText:
    """Return the lines of a table with the header split off; `digest` is that of the file.

    Raises:
        InputError: there are only comments.
    """
    found = layout(lines)
    if found is None:
        raise InputError(f"{path}: holds no header and no data; export the record again.")
    rows = lines[found.first :]
    if found.delimiter == " ":
        rows = [_SPACES.sub(" ", row.strip()) for row in rows]
    return CsvText(
        path, digest, found.header, found.delimiter, tuple(rows), found.first + 1,
        found.header_line + 1,
    )  # fmt: skip


def _decode(data: bytes, path: str) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return data.decode("utf-16")
        except UnicodeDecodeError:
            raise InputError(
                f"{path}: begins as UTF-16 text and is none; save it as 'CSV UTF-8'."
            ) from None
    if data[1:4:2] == b"\0\0" and len(data) % 2 == 0:  # Windows' text without a mark
        return data.decode("utf-16-le", errors="replace")
    if b"\0" in data:
        raise InputError(
            f"{path}: is not text but a binary file; export the record as CSV and name that file."
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def parse_numbers(text: CsvText, fields: Mapping[str, Field], problems: Problems) -> Numbers:
    """Return the values of the columns in `fields`, in their order and in the units of the file.

    An empty cell is nan, as is the word. The first cell with a point or a comma between digits
    decides which of them the whole file has for its decimals. Adds to `problems` each row with a
    wrong number of cells and each cell that is not a number, with line and column.
    """
    text = replace(text, point=_decimal_point(text, fields))
    quick = _parse_at_once(text, [field.index for field in fields.values()])
    return quick if quick is not None else _parse_by_cell(text, fields, problems)


_SPACES = re.compile(r"[ \t]+")
_DECIMAL = re.compile(r"\s*[+-]?\d*([.,])\d*([eE][+-]?\d+)?\s*")
_SWAPPED = str.maketrans(".,", ",.")


def _decimal_point(text: CsvText, fields: Mapping[str, Field]) -> str:
    """Return the decimal sign of the first wanted cell that has one."""
    for row in text.rows:
        if "." not in row and "," not in row:
            continue
        cells = cells_of(row, text.delimiter)
        for field in fields.values():
            found = _DECIMAL.fullmatch(cells[field.index]) if field.index < len(cells) else None
            if found:
                return found[1]
    return "."


def _parse_at_once(text: CsvText, indices: Sequence[int]) -> Numbers | None:
    """Let NumPy read all rows; None if any of them needs a closer look."""
    if text.point == ",":
        if text.delimiter == ",":
            return None
        text = replace(text, rows=tuple("\n".join(text.rows).translate(_SWAPPED).split("\n")))
    filled = [row for row in text.rows if row]
    body = "\n".join(filled)
    mark = text.delimiter
    if not body or '"' in body or body.count(mark) != len(filled) * (len(text.header) - 1):
        return None
    if any(gap in f"\n{body}\n" for gap in (mark * 2, f"{mark}\n", f"\n{mark}")):
        body = f"\n{body}\n".replace(mark * 2, f"{mark}nan{mark}").replace(
            mark * 2, f"{mark}nan{mark}"
        )
        body = body.replace(f"{mark}\n", f"{mark}nan\n").replace(f"\n{mark}", f"\nnan{mark}")
        filled = body[1:-1].split("\n")
    try:
        values = np.loadtxt(filled, delimiter=mark, comments=None, usecols=indices, ndmin=2)
    except ValueError:
        return None
    lines = np.flatnonzero(np.array([bool(row) for row in text.rows])) + text.first_line
    return Numbers(values, lines, np.zeros(values.shape, dtype=np.bool_))


def _parse_by_cell(text: CsvText, fields: Mapping[str, Field], problems: Problems) -> Numbers:
    values: list[list[float]] = []
    lines: list[int] = []
    reported: list[list[bool]] = []
    for line, row in enumerate(text.rows, text.first_line):
        if not row.strip():
            continue
        cells = cells_of(row, text.delimiter)
        if len(cells) != len(text.header):
            problems.add(_wrong_count(text, line, len(cells)))
            continue
        numbers = [_number(cells[field.index], text.point) for field in fields.values()]
        if None in numbers:
            for (name, field), number in zip(fields.items(), numbers, strict=True):
                if number is None:
                    problems.add(_not_a_number(text, line, name, cells[field.index]))
        lines.append(line)
        values.append([math.nan if number is None else number for number in numbers])
        reported.append([number is None for number in numbers])
    shape = (len(lines), len(fields))
    return Numbers(
        np.array(values, dtype=np.float64).reshape(shape),
        np.array(lines, dtype=np.int64),
        np.array(reported, dtype=np.bool_).reshape(shape),
    )


def _wrong_count(text: CsvText, line: int, found: int) -> str:
    expected = len(text.header)
    hint = "complete or remove the line"
    if text.delimiter == "," and found == 2 * expected:
        hint = "where numbers have decimal commas, separate the cells by semicolons"
    return (
        f"{text.path}: line {line}: found {found} cells, expected {expected} as in the header; "
        f"{hint}."
    )


def _number(cell: str, point: str) -> float | None:
    content = cell.strip()
    if point == ",":
        content = content.translate(_SWAPPED)
    if not content:
        return math.nan
    try:
        return None if "_" in content else float(content)
    except ValueError:
        return None


def _not_a_number(text: CsvText, line: int, name: str, cell: str) -> str:
    hint = "correct it, or leave the cell empty where the sample is missing"
    if name in ("time", "voltage"):
        hint = "correct it or remove the line"
    if (decimal := _DECIMAL.fullmatch(cell)) and decimal[1] != text.point:
        other = "comma" if text.point == "," else "point"
        hint = f"other numbers of this file have a decimal {other}, write this one so too"
    return (
        f"{text.path}: line {line}, column '{name}': found '{cell.strip()[:40]}', expected "
        f"a number; {hint}."
    )
