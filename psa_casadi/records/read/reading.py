"""Records from files: read, checked as a whole, converted to SI units.

The format follows the ending (`READERS`), or the first bytes where that is another; all else is
text: CSV, LabVIEW measurements (`.lvm`), PI's data recorder and oscilloscopes are known by their
content.
"""

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeGuard, cast

import numpy as np
import numpy.typing as npt

from psa_casadi.characters import plain
from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read import apart
from psa_casadi.records.read.columns import ALL, TABLE, ColumnMap, Source, columns_of, parse_columns
from psa_casadi.records.read.join import joined, parts_of
from psa_casadi.records.read.samples import Outcome, Request, samples_of
from psa_casadi.records.read.table import Columns, Table
from psa_casadi.records.read.text import label_of
from psa_casadi.records.record import Record
from psa_casadi.units import parse_unit, to_si

AnyPath = str | os.PathLike[str]


class Frame(Protocol):
    """A data frame: column names, and a column by its name (pandas, polars)."""

    @property
    def columns(self) -> Any:
        """Names of the columns."""
        ...

    def __getitem__(self, name: Any, /) -> Any:
        """Return the column of that name."""
        ...


TableLike = Frame | Mapping[str, npt.ArrayLike]
#: What stands for one record wherever records are asked for.
OneRecord = Record | AnyPath | TableLike
#: What stands for the records of one device.
Records = OneRecord | Iterable[OneRecord]


def read_record(
    path: AnyPath,
    *,
    need_displacement: bool = True,
    need_excitation: bool = False,
    columns: str | ColumnMap | None = None,
    sample_time: float | None = None,
) -> Record:
    """Return the record in one file: text, Excel, MATLAB, HDF5, TDMS, NumPy, Parquet, UFF.

    `need_displacement` demands a displacement column with values, as a comparison does;
    `need_excitation` a voltage that changes, as a fit does. `columns` names the arrays of the file
    that are the columns, such as "time=t:ms,voltage=log.u,displacement=m.2:um" (`parse_columns`);
    `displacement=CH2:10um` says that 1 in the file is 10 um, `b.csv@time=t:ms` is said of one file.
    `columns="table=2"` takes one of several sheets, groups, blocks or segments. `sample_time` [s]
    gives the time, whatever the file says of it. "a.csv+b.csv" are the channels of one record that
    an instrument has saved one by one. `notes` of the record tell what was taken for what.

    Raises:
        InputError: every mistake found in the file, one sentence each: file, line, column, what was
            found, what was expected, what to do. At most 20 are listed, the others counted. An
            option that a sentence offers reads this file.
    """
    request = _request(
        columns, Path(path).name, sample_time, displacement=need_displacement,
        excitation=need_excitation,
    )  # fmt: skip
    return _record(str(path), *_read(str(path), request), table=request.table)


def read_records(
    paths: Iterable[AnyPath],
    *,
    need_displacement: bool = True,
    need_excitation: bool = False,
    columns: str | ColumnMap | None = None,
    sample_time: float | None = None,
) -> tuple[Record, ...]:
    """Return the records in several files, which are experiments on the same device.

    `columns="table=all"` takes each table and segment of a file as a record. Files of one channel
    each are joined to one record.

    Raises:
        InputError: the mistakes of all files together, or no file was named.
    """
    wanted = parse_columns(columns) if isinstance(columns, str) else columns
    places = [str(path) for path in paths]
    records: list[Record] = []
    problems: list[str] = []
    failed = 0
    for path in places:
        request = _request(
            wanted, Path(path).name, sample_time, displacement=need_displacement,
            excitation=need_excitation,
        )  # fmt: skip
        try:
            each = _each(path, request) if request.table == ALL else (request,)
            records += [_record(path, *_read(path, one), table=one.table) for one in each]
        except InputError as error:
            failed += 1
            problems.extend(error.problems)
    if failed == len(places) > 1 and (
        pair := _joined(places, wanted, sample_time, need_excitation)
    ):
        return pair
    if not places:
        problems.append("no record was named; name at least one CSV file.")
    if problems:
        raise InputError(problems)
    return tuple(records)


def record_from(
    table: TableLike,
    *,
    name: str = "record",
    need_displacement: bool = True,
    columns: str | ColumnMap | None = None,
    sample_time: float | None = None,
) -> Record:
    """Return the record in a data frame or a mapping of arrays, checked as a file is.

    Names carry units as a CSV header does: `{"time [s]": t, "voltage [V]": v, "displacement [um]":
    x}`; or `columns` says which is which, and `sample_time` [s] gives the time, as for
    `read_record`.

    Raises:
        InputError: every mistake found, one sentence each.
    """
    request = _request(columns, name, sample_time, displacement=need_displacement)
    held = _table_of(table, name)
    outcome = samples_of(name, [held], request)
    digest = hashlib.sha256()
    if outcome.samples is not None:
        for (column, unit), values in zip(
            outcome.samples.units.items(), outcome.samples.values.T, strict=True
        ):
            digest.update(f"{column} [{unit}]".encode() + np.ascontiguousarray(values).tobytes())
    return _record(name, outcome, digest.hexdigest(), source="")


def _table_of(table: TableLike, name: str) -> Table:
    """Return a table in memory as the tables of files are."""
    own = list(table if isinstance(table, Mapping) else table.columns)

    def load(asked: Sequence[int], most: int | None, problems: Problems) -> Columns:
        cells = [_cells(name, own[k], table[own[k]], problems) for k in asked]
        longest = max(map(len, cells), default=0)
        return Columns([c[:most] for c in cells], np.arange(1, longest + 1))

    header = [str(text) for text in own]
    labels = [label_of(text) for text in header]
    return Table(name, "", header, labels, f"{name}: column names", "row", load)


def _cells(name: str, own: object, column: Any, problems: Problems) -> npt.NDArray[Any]:
    """Return a column in memory as numbers or instants."""
    values = np.asarray(column)
    if values.dtype.kind not in "mM":
        try:
            values = np.asarray(column, dtype=np.float64)
        except (TypeError, ValueError):
            problems.add(
                f"{name}: column '{own}': holds {type(column).__name__} that is not all"
                " numbers; convert the column first."
            )
            return np.full(len(values) if values.ndim else 0, np.nan)
    if values.ndim != 1:
        problems.add(
            f"{name}: column '{own}': has shape {values.shape}; give one value for each instant"
        )
    return values.ravel()


def _request(
    columns: str | ColumnMap | None,
    file: str,
    sample_time: float | None,
    *,
    displacement: bool,
    excitation: bool = False,
) -> Request:
    """Return what is wanted of a file, as far as it is said of this one."""
    told = parse_columns(columns) if isinstance(columns, str) else columns or {}
    own = dict(columns_of(told, file))
    chosen = own.pop(TABLE, Source("", None)).array
    return Request(own, sample_time, chosen, displacement, excitation)


def _read(path: str, request: Request) -> tuple[Outcome, str]:
    parts = parts_of(path)
    if len(parts) == 1:
        return apart.read(path, request)
    return joined([(part, *apart.text_of(part)) for part in parts], request)


def _each(path: str, request: Request) -> Sequence[Request]:
    """Return the requests for each table of a file, one where it holds one."""
    whole = replace(request, table="")
    outcome, _ = _read(path, whole)
    return [replace(request, table=key) for key in outcome.tables] or [whole]


def _joined(
    paths: Sequence[str], wanted: ColumnMap | None, sample_time: float | None, excitation: bool
) -> tuple[Record, ...]:
    """Return the record of files of one channel each, none where they are not such files."""
    request = _request(wanted, "", sample_time, displacement=True, excitation=excitation)
    try:
        outcome, digest = joined(
            [(path, *apart.text_of(path)) for path in paths], request, alone=True
        )
    except InputError:
        return ()
    return (_record("+".join(paths), outcome, digest),)


def records_given(given: Records) -> tuple[Record, ...]:
    """Return what was given as records: one or several records, paths of files, tables.

    Raises:
        InputError: the mistakes of all of them together.
    """
    several = [given] if _is_one(given) else list(cast("Iterable[OneRecord]", given))
    found: list[Record] = []
    problems: list[str] = []
    for k, one in enumerate(several, 1):
        try:
            if isinstance(one, Record):
                found.append(one)
            elif isinstance(one, str | os.PathLike):
                found.append(read_record(one))
            elif _is_table(one):
                found.append(
                    record_from(one, name="record" if len(several) == 1 else f"record {k}")
                )
            else:
                problems.append(
                    f"{type(one).__name__} is no record; give a Record, the path of a file, a data"
                    " frame, or a mapping of arrays such as {'time [s]': t, 'voltage [V]': v, ...}."
                )
        except InputError as error:
            problems.extend(error.problems)
    if problems:
        raise InputError(problems)
    return tuple(found)


def _is_one(given: Records) -> TypeGuard[OneRecord]:
    return isinstance(given, Record | str | os.PathLike) or _is_table(given)


def _is_table(given: object) -> TypeGuard[TableLike]:
    return isinstance(given, Mapping) or hasattr(given, "columns")


def _record(
    path: str, outcome: Outcome, digest: str, *, source: str | None = None, table: str = ""
) -> Record:
    """Return the record in SI units; one of several is named and hashed with its table."""
    outcome.problems.raise_if_any()
    samples = outcome.samples
    if samples is None:
        raise InputError(f"{path}: holds no columns; name them as 'time [s]', 'voltage [V]'.")
    columns = {
        name: to_si(samples.values[:, k], unit)
        for k, (name, unit) in enumerate(samples.units.items())
    }
    for array in columns.values():
        array.flags.writeable = False  # a record need not copy it
    if not (np.diff(columns["time"]) > 0.0).all():
        raise InputError(
            f"{path}: instants are the same in seconds; give the time from the start of"
            " the record, in a unit in which neighbours differ by more than the last digit."
        )
    in_counts = "displacement" in columns and parse_unit(samples.units["displacement"]).counts
    stem = "+".join(Path(part).stem for part in parts_of(path)) if source is None else path
    return Record(
        name=plain(f"{stem}_{table}" if table else stem),
        **columns,
        sha256=hashlib.sha256(f"{digest} {table}".encode()).hexdigest() if table else digest,
        source=path if source is None else source,
        displacement_unit="counts" if in_counts else "m",
        notes=tuple(f"{path}: {note}" for note in samples.notes),
    )
