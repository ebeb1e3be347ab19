"""Columns from Parquet files, whose column names carry units as a CSV header does."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.columns import ColumnMap
from psa_casadi.records.read.file_bytes import check_size, read_bytes, reason_of
from psa_casadi.records.read.header import parse_header
from psa_casadi.records.read.samples import Samples, whole_samples
from psa_casadi.units import FloatArray

#: Rows that are read at once.
_BLOCK = 2**18


def read_parquet(
    path: str, required: Sequence[str], wanted: ColumnMap, problems: Problems
) -> Samples | None:
    """Return the columns of a Parquet file, or None where none is named; null becomes nan.

    `wanted` says which name in the file is which column, where they differ. Mistakes are added to
    `problems`. Only the columns of a record are read, and none before its size is known.

    Raises:
        InputError: the file cannot be read, is no Parquet file, is too large when unpacked, or
            pyarrow is not installed.
    """
    data = read_bytes(path)
    with _told(path):
        file, schema = _opened(path, data)
    fields = parse_header(schema.names, required, f"{path}: column names", problems, wanted)
    numeric = {}
    for name, field in fields.items():
        kind = schema.field(field.index).type
        if _is_number(kind):
            numeric[name] = field
        else:
            problems.add(
                f"{path}: column '{name}': holds {kind}, expected numbers; convert the column "
                f"before the file is written."
            )
    if not numeric:
        return None
    own_names = [schema.names[field.index] for field in numeric.values()]
    with _told(path):
        arrays = _read(path, file, own_names)
    columns = {
        name: (field.unit, array)
        for (name, field), array in zip(numeric.items(), arrays, strict=True)
    }
    return whole_samples(path, hashlib.sha256(data).hexdigest(), "row", columns)


def parquet_head(path: str, count: int) -> tuple[list[str], list[list[str]]]:
    """Return the names of a Parquet file's columns, and its first `count` rows as text.

    Raises:
        InputError: as `read_parquet`.
    """
    data = read_bytes(path)
    with _told(path):
        file, schema = _opened(path, data)
        block = next(file.iter_batches(count, use_threads=False), None)
        columns = [] if block is None else [block.column(k) for k in range(len(schema.names))]
        rows = [[_cell(c[k].as_py()) for c in columns] for k in range(len(block or ()))]
    return list(schema.names), rows


def _cell(value: Any) -> str:
    """Return a value as a table shows it, cut off where it is long."""
    return "" if value is None else f"{value:.9g}" if isinstance(value, float) else str(value)[:40]


@contextmanager
def _told(path: str) -> Iterator[None]:
    """Tell what pyarrow says of a damaged file, which may be anything."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = reason_of(error)
        raise InputError(
            f"{path}: is no readable Parquet file ({reason}); write it again, or export the record "
            f"as CSV."
        ) from error


def _opened(path: str, data: bytes) -> tuple[Any, Any]:
    """Return a file's content and the names and types of its columns; no values are read."""
    try:
        # an optional dependency, needed for these files only
        import pyarrow  # noqa: PLC0415
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError:
        raise InputError(
            f"{path}: reading Parquet needs pyarrow, which is not installed; run "
            f"`pip install 'psa-casadi[parquet]'`, or export the record as CSV."
        ) from None
    file = parquet.ParquetFile(
        pyarrow.BufferReader(data), pre_buffer=False, page_checksum_verification=True
    )
    return file, file.schema_arrow


def _read(path: str, file: Any, names: Sequence[str]) -> list[FloatArray]:
    """Return the named columns, block by block: never more than the rows that the file states.

    What pyarrow tells of the size of single columns is not asked for: where these statements are
    damaged, it ends the process (26.0.1).
    """
    rows = file.metadata.num_rows
    check_size(path, 8 * rows * len(names), "its columns hold")
    found = [np.full(rows, np.nan) for _ in names]
    done = 0
    for block in file.iter_batches(_BLOCK, columns=list(names), use_threads=False):
        end = done + block.num_rows
        if end > rows:
            raise ValueError(f"more than the {rows} rows that it states")
        for values, name in zip(found, names, strict=True):
            values[done:end] = _floats(block.column(name))
        done = end
    if done < rows:
        raise ValueError(f"{done} of the {rows} rows that it states")
    return found


def _is_number(kind: Any) -> bool:
    from pyarrow import types  # noqa: PLC0415

    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind))


def _floats(column: Any) -> FloatArray:
    """Return a column of numbers as floats, null as nan."""
    import pyarrow  # noqa: PLC0415

    return np.asarray(
        column.cast(pyarrow.float64(), safe=False).to_numpy(zero_copy_only=False), dtype=np.float64
    )
