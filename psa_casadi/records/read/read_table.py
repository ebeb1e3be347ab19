"""Records from tables in memory: a data frame, or a mapping of arrays, named as a header is."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import Problems
from psa_casadi.records.read.columns import ColumnMap
from psa_casadi.records.read.header import parse_header
from psa_casadi.records.read.samples import Samples, whole_samples
from psa_casadi.units import FloatArray


class Frame(Protocol):
    """A data frame: column names, and a column by its name (pandas, polars)."""

    @property
    def columns(self) -> Any:
        """Names of the columns."""
        ...

    def __getitem__(self, name: Any, /) -> Any:
        """Return the column of that name."""
        ...


Table = Frame | Mapping[str, npt.ArrayLike]


def read_table(
    table: Table, name: str, required: Sequence[str], wanted: ColumnMap, problems: Problems
) -> Samples | None:
    """Return the columns of a table in memory, or None where none is named; None becomes nan.

    Names carry units as a CSV header does; `wanted` says which is which where they differ.
    Mistakes are added to `problems`, under the table's `name`.
    """
    own_names = list(table if isinstance(table, Mapping) else table.columns)
    names = [str(own) for own in own_names]
    fields = parse_header(names, required, f"{name}: column names", problems, wanted)
    columns: dict[str, tuple[str, FloatArray]] = {}
    for column, field in fields.items():
        own = own_names[field.index]
        try:
            values = np.asarray(table[own], dtype=np.float64)
        except (TypeError, ValueError):
            problems.add(
                f"{name}: column '{own}': holds {type(table[own]).__name__} that is not all"
                " numbers; convert the column first."
            )
            continue
        if values.ndim != 1:
            problems.add(
                f"{name}: column '{own}': has shape {values.shape}; give one value for each instant"
            )
            continue
        columns[column] = (field.unit, values)
    if len({v.size for _, v in columns.values()}) > 1:
        sizes = ", ".join(f"'{n}' {v.size}" for n, (_, v) in columns.items())
        problems.add(f"{name}: the columns have different lengths: {sizes}; give one row for each.")
        return None
    if not columns:
        return None
    digest = hashlib.sha256()
    for column, (unit, values) in columns.items():
        digest.update(f"{column} [{unit}]".encode() + np.ascontiguousarray(values).tobytes())
    return whole_samples(name, digest.hexdigest(), "row", columns)
