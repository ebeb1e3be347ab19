"""Columns from Parquet files, whose column names carry units as a CSV header does."""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.columns import ColumnMap, parse_header
from psa_casadi.records.read.file_bytes import read_bytes
from psa_casadi.records.read.samples import Samples, whole_samples
from psa_casadi.units import FloatArray


def read_parquet(
    path: str, required: Sequence[str], wanted: ColumnMap, problems: Problems
) -> Samples | None:
    """Return the columns of a Parquet file, or None where none is named; null becomes nan.

    `wanted` says which name in the file is which column, where they differ. Mistakes are added to
    `problems`.

    Raises:
        InputError: the file cannot be read, is no Parquet file, or pyarrow is not installed.
    """
    data = read_bytes(path)
    names, table = _load(path, data)
    fields = parse_header(names, required, f"{path}: column names", problems, wanted)
    columns: dict[str, tuple[str, FloatArray]] = {}
    for name, field in fields.items():
        values = _numbers(table.column(field.index))
        if values is None:
            problems.add(
                f"{path}: column '{name}': holds {table.column(field.index).type}, expected "
                f"numbers; convert the column before the file is written."
            )
        else:
            columns[name] = (field.unit, values)
    if not columns:
        return None
    return whole_samples(path, hashlib.sha256(data).hexdigest(), "row", columns)


def _load(path: str, data: bytes) -> tuple[list[str], Any]:
    """Return the names of the columns and the table of a file's content."""
    try:
        # an optional dependency, needed for these files only
        import pyarrow  # noqa: PLC0415
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError:
        raise InputError(
            f"{path}: reading Parquet needs pyarrow, which is not installed; run "
            f"`pip install 'psa-casadi[parquet]'`, or export the record as CSV."
        ) from None
    try:
        table = parquet.read_table(pyarrow.BufferReader(data))
        return table.column_names, table
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(
            f"{path}: is no readable Parquet file ({reason}); write it again, or export the record "
            f"as CSV."
        ) from error


def _numbers(column: Any) -> FloatArray | None:
    """Return a column as floats, null as nan; None where it does not hold numbers."""
    import pyarrow  # noqa: PLC0415
    from pyarrow import types  # noqa: PLC0415

    kind = column.type
    if not (types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind)):
        return None
    return np.asarray(column.cast(pyarrow.float64(), safe=False).to_numpy(), dtype=np.float64)
