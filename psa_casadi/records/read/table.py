"""What every file is read to: tables of named columns, whose cells are numbers or text."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psa_casadi.errors import Problems
from psa_casadi.records.read.columns import MARKS

#: The cells of one column: numbers or instants (n,), or texts.
Cells = NDArray[Any] | Sequence[str]
#: Rows that are looked at to see what a column is.
GLANCE = 2000


@dataclass(frozen=True, eq=False)
class Columns:
    """Some columns of a table, one value for each row, and the number of each row in the file."""

    cells: Sequence[Cells]
    lines: NDArray[np.int64]


#: What gives the columns of a table by their indices, at most so many rows of them. It adds rows
#: that are of another length to the problems.
Loader = Callable[[Sequence[int], int | None, Problems], Columns]


@dataclass(frozen=True, eq=False)
class Table:
    """One table of a file: the names of its columns with their units, and its cells on demand.

    `header` holds texts such as "voltage [V]"; `labels` are the names that `--columns` takes for
    them. `where` (file and line) begins the sentences about the header, `place` is what holds one
    sample: a "line", a "row", a "sample". `sizes` are the lengths of the columns where they differ.
    `step` [s] is the time between samples that the file states beside its columns. `headless` has
    the first numbers of a table without a header, whose columns are counted from 1.
    """

    path: str
    name: str
    header: Sequence[str]
    labels: Sequence[str]
    where: str
    place: str
    load: Loader
    step: float | None = None
    sizes: Sequence[int] = ()
    headless: str = ""

    @cached_property
    def glance(self) -> Sequence[Cells]:
        """The first rows of all columns."""
        found = self.load(range(len(self.header)), GLANCE, Problems())
        return [cells[:GLANCE] for cells in found.cells]


def parts_of_file(tables: Sequence[Table]) -> dict[str, Table]:
    """Return the tables of a file by what chooses them: the name, if `--columns` can say it.

    All arrays of a file together, which come first, are no part of it.
    """
    parts = tables[1:] if tables[0].sizes and len(tables) > 1 else tables
    names = [t.name if t.name and not MARKS.search(t.name) else "" for t in parts]
    return {name or str(k): t for k, (name, t) in enumerate(zip(names, parts, strict=True), 1)}
