"""Columns from Excel workbooks (`.xlsx`), read as the text of a table: preamble, header, units."""

import hashlib
import io
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from typing import Any

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.columns import ColumnMap
from psa_casadi.records.read.csv_table import CsvText, laid_out
from psa_casadi.records.read.file_bytes import read_bytes, reason_of
from psa_casadi.records.read.header_names import columns_known
from psa_casadi.records.read.read_csv import columns_of
from psa_casadi.records.read.samples import Samples

#: The most bytes of the file, unpacked; and of a part that is no sheet, which is kept in memory.
MOST_UNPACKED, MOST_OF_A_PART = 2**28, 2**26
#: The most cells that are looked at, and the most rows, which is Excel's own bound.
MOST_CELLS, MOST_ROWS = 2**24, 2**20
#: Rows in which a sheet is asked for the names of columns.
_HEAD = 100


def read_xlsx(
    path: str, required: Sequence[str], wanted: ColumnMap, problems: Problems
) -> Samples | None:
    """Return the columns of a workbook, or None where none is named; an empty cell becomes nan.

    `wanted` says which name in the header is which column, where they differ. Mistakes are added to
    `problems`; their line is the row of the sheet.

    Raises:
        InputError: as `workbook_text`.
    """
    return columns_of(workbook_text(path), required, wanted, problems)


def workbook_text(path: str) -> CsvText:
    """Return the table of a workbook: of the first sheet that names two columns of a record.

    Where none does, of the first sheet that holds anything.

    Raises:
        InputError: the file cannot be read, is no workbook, is too large when unpacked, or openpyxl
            is not installed.
    """
    try:
        # an optional dependency, needed for these files only
        import openpyxl  # noqa: PLC0415
    except ImportError:
        raise InputError(
            f"{path}: reading Excel files needs openpyxl, which is not installed; run "
            f"`pip install 'psa-casadi[excel]'`, or save the sheet as CSV."
        ) from None
    data = read_bytes(path)
    try:
        _check_parts(path, data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of styles and extensions, which no record needs
            book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
            lines = _sheet(path, book)
    except InputError:
        raise
    except Exception as error:  # openpyxl may raise anything on a damaged file
        raise InputError(
            f"{path}: is no readable Excel workbook ({reason_of(error)}); save it again as .xlsx,"
            " or save the sheet as CSV."
        ) from error
    return laid_out(path, hashlib.sha256(data).hexdigest(), lines)


def _check_parts(path: str, data: bytes) -> None:
    """Refuse what unpacks to more than a record needs; no part gives more than it states."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        sizes = {m.filename: m.file_size for m in archive.infolist()}
    others = [size for name, size in sizes.items() if "worksheets/" not in name]
    if sum(sizes.values()) > MOST_UNPACKED or max(others, default=0) > MOST_OF_A_PART:
        raise InputError(
            f"{path}: unpacks to {sum(sizes.values()) / 2**20:.0f} MiB, more than is read of a"
            " workbook; save the sheet as CSV."
        )


def _sheet(path: str, book: Any) -> list[str]:
    """Return the lines of the sheet that holds the record."""
    first: list[str] = []
    for sheet in book.worksheets:
        rows = _lines(path, sheet)
        head = [row for row, _ in zip(rows, range(_HEAD), strict=False)]
        named = any(columns_known(row.split("\t")) >= 2 for row in head)
        if named or (not first and any(head)):
            lines = [*head, *rows]
            if named:
                return _even(lines)
            first = lines
    return _even(first)


def _lines(path: str, sheet: Any) -> Iterator[str]:
    sheet.reset_dimensions()  # what a sheet states of its size is often wrong
    cells = 0
    for number, row in enumerate(sheet.iter_rows(values_only=True)):
        cells += len(row) + 1
        if number >= MOST_ROWS or cells > MOST_CELLS:
            raise InputError(
                f"{path}: the sheet '{sheet.title}' has more than {number} rows with {cells} cells,"
                " the most that is read; save the record as CSV."
            )
        yield "\t".join(map(_text, row)) if any(c is not None for c in row) else ""


def _text(cell: object) -> str:
    """Return a cell as text without the marks that separate cells of a table."""
    if cell is None:
        return ""
    if isinstance(cell, float):
        return repr(cell)
    text = str(cell).strip()
    number = text.replace(",", ".")
    plain = number.replace(".", "", 1).lstrip("+-").replace("e", "", 1).replace("E", "", 1)
    if plain.replace("-", "", 1).isdecimal():
        return number
    return " ".join(text.translate(_MARKS).split())


_MARKS = str.maketrans(dict.fromkeys('\t\r\n,;"', " "))


def _even(lines: list[str]) -> list[str]:
    """Return rows of the same number of cells, without empty columns and rows at their ends."""
    width = max((len(line.rstrip("\t").split("\t")) for line in lines), default=0)
    cut = [line.split("\t")[:width] for line in lines]
    return ["\t".join([*row, *[""] * (width - len(row))]) if any(row) else "" for row in cut]
