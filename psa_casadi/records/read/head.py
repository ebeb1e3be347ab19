"""The first rows of a record's file, and what its columns are taken for before anybody says."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.choose import choose
from psa_casadi.records.read.columns import Field, stated_unit
from psa_casadi.records.read.table import Cells, Table, parts_of_file

#: The columns that a diagnosis needs; a cell that may be one of them is a guess worth showing.
NEEDED = ("time", "voltage", "displacement")
#: What `--columns` reads as its own marks: a column with one of them cannot be named there.
_MARKS = set(",=:[]")


@dataclass(frozen=True)
class Head:
    """The columns of a table by the names that `--columns` takes, and the first rows.

    A name is "" where `--columns` cannot say it. `units` are those that the file states, "" where
    it states none; `rows` hold the cells as text. `guess` says which column of a record stands
    where, as the reader takes it or, where it asks, would take it. `tables` are those of the file.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    guess: Mapping[str, Field]
    tables: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON can hold it."""
        return asdict(self)

    @classmethod
    def from_json(cls, told: Mapping[str, Any]) -> "Head":
        """Return what `to_json` was made of."""
        guess = {name: Field(**own) for name, own in told["guess"].items()}
        rows = tuple(tuple(row) for row in told["rows"])
        return cls(tuple(told["names"]), tuple(told["units"]), rows, guess, tuple(told["tables"]))


def head_of_tables(path: str, tables: Sequence[Table], count: int, table: str) -> Head:
    """Return the head of one of the tables of a file, of the first where none is named."""
    if not tables:
        raise InputError(f"{path}: holds no header and no data; export the record again.")
    parts = parts_of_file(tables)
    one = parts.get(table, tables[0])
    choice = choose(one, NEEDED, {}, Problems())
    guess = dict(choice.fields)
    labels = list(one.labels)
    for name, source in choice.sources.items() if not one.headless else ():
        if source.array in labels:
            guess[name] = Field(labels.index(source.array), source.unit or "")
    units = tuple(stated_unit(text) or "" for text in one.header)
    names = tuple("" if set(label) & _MARKS else label for label in one.labels)
    columns = [_texts(cells, count) for cells in one.glance]
    longest = max(map(len, columns), default=0)
    rows = tuple(tuple(c[k] if k < len(c) else "" for c in columns) for k in range(longest))
    return Head(names, units, rows, guess, tuple(parts) if len(parts) > 1 else ())


def _texts(cells: Cells, count: int) -> list[str]:
    """Return the first cells as a table shows them."""
    if isinstance(cells, np.ndarray) and cells.dtype.kind in "biuf":
        return [f"{value:.9g}" for value in cells[:count]]
    return [str(cell)[:40] for cell in cells[:count]]
