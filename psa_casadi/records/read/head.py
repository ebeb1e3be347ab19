"""The first rows of a record's file, and what its columns are taken for before anybody says."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psa_casadi.records.read.columns import COLUMNS, Field
from psa_casadi.records.read.csv_table import CsvText, load_text
from psa_casadi.records.read.file_bytes import read_bytes
from psa_casadi.records.read.header import guessed_header, named_columns
from psa_casadi.records.read.header_names import stated_unit
from psa_casadi.records.read.layout import cells_of
from psa_casadi.records.read.read_arrays import (
    LOADERS,
    array_of,
    last_part,
    suggested_sources,
    unit_of,
)
from psa_casadi.records.read.read_parquet import parquet_head
from psa_casadi.records.read.read_xlsx import workbook_text

#: The columns that a diagnosis needs; a cell that may be one of them is a guess worth showing.
NEEDED = ("time", "voltage", "displacement")
#: Endings of workbooks and of Parquet files.
_SHEETS, _PARQUET = (".xlsx", ".xlsm"), (".parquet", ".pq")
#: What `--columns` reads as its own marks: a column with one of them cannot be named there.
_MARKS = set(",=:[]")


@dataclass(frozen=True)
class Head:
    """The columns of a file by the names that `--columns` takes, and the first rows.

    A name is "" where `--columns` cannot say it. `units` are those that the file states, "" where
    it states none; `rows` hold the cells as text. `guess` says which column of a record stands
    where, as the reader takes it or, where it asks, would take it.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    guess: Mapping[str, Field]


def head_of(path: str | os.PathLike[str], count: int = 8) -> Head:
    """Return the head of a file with its first `count` rows; its numbers are not checked.

    Raises:
        InputError: the file cannot be read, or is not what its ending says.
    """
    ending, place = Path(path).suffix.lower(), os.fspath(path)
    if ending in LOADERS:
        return _of_arrays(place, ending, count)
    if ending in _PARQUET:
        header, rows = parquet_head(place, count)
        return _of_table(header, rows)
    text = workbook_text(place) if ending in _SHEETS else load_text(place)
    return _of_text(text, count)


def _of_text(text: CsvText, count: int) -> Head:
    filled = [row for row in text.rows[: 4 * count] if row.strip()][:count]
    rows = [cells_of(row, text.delimiter) for row in filled]
    if text.header:
        return _of_table(text.header, rows)
    first = text.numbered().header if rows else ()
    return Head(first, ("",) * len(first), _even(rows, len(first)), {})


def _of_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Head:
    guess = guessed_header(header, NEEDED)
    named = [(name, unit or "") for name, unit in named_columns(header)]
    names = tuple("" if set(name) & _MARKS else name for name, _ in named)
    units = tuple(unit for _, unit in named)
    return Head(names, units, _even(rows, len(names)), guess)


def _of_arrays(path: str, ending: str, count: int) -> Head:
    arrays = LOADERS[ending](path, read_bytes(path))
    names = tuple(arrays)
    guess, asked = {}, suggested_sources(arrays, NEEDED)
    for column in COLUMNS:
        source = array_of(column, arrays, by_unit=column in NEEDED) or asked.get(column)
        if source is not None:
            unit = unit_of(column, source, arrays[source.array].unit) or ""
            guess[column] = Field(names.index(source.array), unit)
    firsts = [[f"{v:.9g}" for v in np.asarray(a.values[:count])] for a in arrays.values()]
    longest = max(map(len, firsts), default=0)
    rows = [[own[k] if k < len(own) else "" for own in firsts] for k in range(longest)]
    units = tuple(
        array.unit or stated_unit(last_part(name)) or "" for name, array in arrays.items()
    )
    return Head(names, units, _even(rows, len(names)), guess)


def _even(rows: Sequence[Sequence[str]], width: int) -> tuple[tuple[str, ...], ...]:
    """Return rows with as many cells as there are columns."""
    return tuple(tuple([*row, *[""] * width][:width]) for row in rows)
