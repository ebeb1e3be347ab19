"""Records from files: read, checked as a whole, converted to SI units.

The format follows the ending: `.mat` (MATLAB), `.h5`, `.hdf5` or `.hdf`, `.tdms` (LabVIEW), `.npy`
or `.npz` (NumPy), `.parquet` or `.pq`, `.xlsx` (Excel), and text for everything else: CSV, LabVIEW
measurements (`.lvm`) and PI's data recorder are known by their content.
"""

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeGuard, cast

import numpy as np

from psa_casadi.characters import plain
from psa_casadi.errors import InputError, Problems
from psa_casadi.records.checks import (
    Located,
    check_complete,
    check_displacement,
    check_excitation,
    check_length,
    check_time,
)
from psa_casadi.records.read.column_map import columns_of, parse_columns
from psa_casadi.records.read.columns import ColumnMap
from psa_casadi.records.read.read_arrays import LOADERS, read_arrays
from psa_casadi.records.read.read_csv import read_csv
from psa_casadi.records.read.read_parquet import read_parquet
from psa_casadi.records.read.read_table import Table, read_table
from psa_casadi.records.read.read_xlsx import read_xlsx
from psa_casadi.records.read.samples import Samples, scaled
from psa_casadi.records.record import Record
from psa_casadi.units import parse_unit, to_si

AnyPath = str | os.PathLike[str]
#: What stands for one record wherever records are asked for.
OneRecord = Record | AnyPath | Table
#: What stands for the records of one device.
Records = OneRecord | Iterable[OneRecord]

#: What reads a file, by its ending; a file with another ending is CSV.
READERS = {
    **dict.fromkeys(LOADERS, read_arrays),
    ".parquet": read_parquet,
    ".pq": read_parquet,
    ".xlsx": read_xlsx,
    ".xlsm": read_xlsx,
}


def read_record(
    path: AnyPath,
    *,
    need_displacement: bool = True,
    need_excitation: bool = False,
    columns: str | ColumnMap | None = None,
    sample_time: float | None = None,
) -> Record:
    """Return the record in one file: text, Excel, MATLAB, HDF5, TDMS, NumPy or Parquet.

    `need_displacement` demands a displacement column with values, as a comparison does;
    `need_excitation` a voltage that changes, as a fit does. `columns` names the arrays of the file
    that are the columns, such as "time=t:ms,voltage=log.u,displacement=m.2:um" (`parse_columns`);
    `displacement=CH2:10um` says that 1 in the file is 10 um, `b.csv@time=t:ms` is said of one file.
    `sample_time` [s] gives the time of a file without one.

    Raises:
        InputError: every mistake found in the file, one sentence each: file, line, column, what was
            found, what was expected, what to do. At most 20 are listed, the others counted.
    """
    problems = Problems()
    wanted = _wanted(columns, Path(path).name)
    required = _required(need_displacement, sample_time)
    reader = READERS.get(Path(path).suffix.lower(), read_csv)
    samples = reader(str(path), required, wanted, problems)
    samples = _timed(samples, sample_time, problems)
    if samples is not None:
        samples = scaled(samples, wanted)
        _check(samples, problems, need_excitation=need_excitation)
    problems.raise_if_any()
    if samples is None:
        raise InputError(f"{path}: holds no columns; export the record again.")
    return _record(samples)


def read_records(
    paths: Iterable[AnyPath],
    *,
    need_displacement: bool = True,
    need_excitation: bool = False,
    columns: str | ColumnMap | None = None,
    sample_time: float | None = None,
) -> tuple[Record, ...]:
    """Return the records in several files, which are experiments on the same device.

    Raises:
        InputError: the mistakes of all files together, or no file was named.
    """
    wanted = parse_columns(columns) if isinstance(columns, str) else columns
    records: list[Record] = []
    problems: list[str] = []
    for path in paths:
        try:
            record = read_record(
                path,
                need_displacement=need_displacement,
                need_excitation=need_excitation,
                columns=wanted,
                sample_time=sample_time,
            )
            records.append(record)
        except InputError as error:
            problems.extend(error.problems)
    if not records and not problems:
        problems.append("no record was named; name at least one CSV file.")
    if problems:
        raise InputError(problems)
    return tuple(records)


def record_from(
    table: Table,
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
    problems = Problems()
    wanted = _wanted(columns, name)
    required = _required(need_displacement, sample_time)
    samples = read_table(table, name, required, wanted, problems)
    samples = _timed(samples, sample_time, problems)
    if samples is not None:
        samples = scaled(samples, wanted)
        _check(samples, problems, need_excitation=False)
    problems.raise_if_any()
    if samples is None:
        raise InputError(f"{name}: holds no columns; name them as 'time [s]', 'voltage [V]'.")
    return _record(samples, source="")


def _wanted(columns: str | ColumnMap | None, file: str) -> ColumnMap:
    """Return which array of a file is which column, as far as it is said."""
    told = parse_columns(columns) if isinstance(columns, str) else columns or {}
    return columns_of(told, file)


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


def _is_table(given: object) -> TypeGuard[Table]:
    return isinstance(given, Mapping) or hasattr(given, "columns")


def _required(need_displacement: bool, sample_time: float | None) -> tuple[str, ...]:
    needed = {"time": sample_time is None, "voltage": True, "displacement": need_displacement}
    return tuple(name for name, is_needed in needed.items() if is_needed)


def _timed(
    samples: Samples | None, sample_time: float | None, problems: Problems
) -> Samples | None:
    """Return the samples with the time that a sample time gives, where one was given."""
    if samples is None or sample_time is None:
        return samples
    if not 0.0 < sample_time < 1e9:
        problems.add(f"{samples.path}: the sample time {sample_time} s is no time; give seconds.")
        return None
    if "time" in samples.units:
        problems.add(
            f"{samples.path}: has a column 'time' of its own; leave --sample-time (sample_time) out"
            " or rename the column."
        )
        return None
    time = sample_time * np.arange(len(samples.values))
    reported = np.zeros(len(time), dtype=np.bool_)
    return replace(
        samples,
        units={"time": "s", **samples.units},
        values=np.column_stack([time, samples.values]),
        reported=np.column_stack([reported, samples.reported]),
    )


def _check(samples: Samples, problems: Problems, *, need_excitation: bool) -> None:
    check_length(samples.path, len(samples.lines), problems)
    for k, name in enumerate(samples.units):
        column = Located(
            samples.path,
            name,
            samples.values[:, k],
            samples.lines,
            samples.reported[:, k],
            samples.place,
        )
        if name == "time":
            check_time(column, problems)
        elif name == "displacement":
            check_displacement(column, problems)
        else:
            check_complete(column, problems)
        if name == "voltage" and need_excitation:
            check_excitation(column, problems)


def _record(samples: Samples, source: str | None = None) -> Record:
    columns = {
        name: to_si(samples.values[:, k], unit)
        for k, (name, unit) in enumerate(samples.units.items())
    }
    if not (np.diff(columns["time"]) > 0.0).all():
        raise InputError(
            f"{samples.path}: instants are the same in seconds; give the time from the start of"
            " the record, in a unit in which neighbours differ by more than the last digit."
        )
    in_counts = "displacement" in columns and parse_unit(samples.units["displacement"]).counts
    return Record(
        name=plain(Path(samples.path).stem if source is None else samples.path),
        time=columns["time"],
        voltage=columns["voltage"],
        displacement=columns.get("displacement"),
        load_force=columns.get("load_force"),
        current=columns.get("current"),
        temperature=columns.get("temperature"),
        monitor_voltage=columns.get("monitor_voltage"),
        charge=columns.get("charge"),
        displacement_2=columns.get("displacement_2"),
        strain=columns.get("strain"),
        sha256=samples.sha256,
        source=samples.path if source is None else source,
        displacement_unit="counts" if in_counts else "m",
    )
