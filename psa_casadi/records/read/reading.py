"""Records from files: read, checked as a whole, converted to SI units.

The format follows the ending (`READERS`), or the first bytes where that is another; all else is
text: CSV, LabVIEW measurements (`.lvm`), PI's data recorder and oscilloscopes are known by their
content.
"""

import hashlib
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeGuard, TypeVar

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from psa_casadi.common.characters import plain
from psa_casadi.common.display import with_units
from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.files import atomic_write
from psa_casadi.common.units import FloatArray, parse_unit, to_si
from psa_casadi.records.read import apart
from psa_casadi.records.read.choose import Request, is_rising
from psa_casadi.records.read.columns import (
    ALL,
    TABLE,
    ColumnMap,
    Source,
    columns_of,
    name_and_unit,
    parse_columns,
    stated_unit,
)
from psa_casadi.records.read.formats import Series, array_tables
from psa_casadi.records.read.samples import Outcome, samples_of
from psa_casadi.records.read.table import Cells, Columns, Table, as_numbers, is_stamp, seconds_of
from psa_casadi.records.record import FEWEST_SAMPLES, Record
from psa_casadi.records.signals import Hold, Signals


def parts_of(path: str) -> list[str]:
    """Return the files that "a.csv+b.csv" names; the path itself where it is one file."""
    parts = path.split("+")
    return parts if not Path(path).exists() and all(Path(p).is_file() for p in parts) else [path]


def joined(
    files: Sequence[tuple[str, Sequence[Table], str]], request: Request, *, alone: bool = False
) -> Outcome:
    """Return the samples of files that hold the channels of one record, with a hash of them all.

    Each file has a path, tables and a SHA-256. The clock is that of the first;
    where another differs, its channels are interpolated at those instants that both have, and a
    note states it. A channel's name that several files have gets the file's in front. `alone`
    refuses files of several channels.

    Raises:
        InputError: a file is no table of a time and channels.
    """
    held = [(path, *_channels(path, tables)) for path, tables, _ in files]
    clocks = _clocks([(path, cells, unit) for path, cells, unit, _ in held])
    channels, resampled = [], []
    for (path, _, _, item), time in zip(held, clocks, strict=True):
        if alone and len(item) != 1:
            raise InputError(f"{path}: holds {len(item)} channels besides the time, expected one.")
        channels += [(path, name, unit, time, values) for name, unit, values in item]
    first = clocks[0]
    shared = (first >= max(t[0] for t in clocks)) & (first <= min(t[-1] for t in clocks))
    if shared.sum() < FEWEST_SAMPLES:
        raise InputError(
            f"{files[0][0]}: its clock and that of {files[1][0]} have no instants in common (begin:"
            f" {clocks[0][0]:.9g} and {clocks[1][0]:.9g} s); let both begin with the record."
        )
    names = [name for _, name, *_ in channels]
    series = [Series("time", int(shared.sum()), lambda: first[shared], "s")]
    for path, name, unit, time, values in channels:
        label = f"{Path(path).stem}.{name}" if names.count(name) > 1 else name
        same = np.array_equal(time, first)
        resampled += [] if same else [Path(path).name]
        kept = (values if same else np.interp(first, time, values))[shared]
        series.append(Series(label, kept.size, partial(np.asarray, kept), unit))
    together = "+".join(path for path, *_ in files)
    outcome = samples_of(together, array_tables(together, series)[:1], request)
    outcome.notes += (f"the channels of {len(files)} files are one record.",)
    if resampled:
        outcome.notes += (
            f"{', '.join(resampled)} has another clock: it is interpolated at the instants of"
            f" {Path(files[0][0]).name}.",
        )
    outcome.sha256 = hashlib.sha256("".join(sha for *_, sha in files).encode()).hexdigest()
    return outcome


def _clocks(times: Sequence[tuple[str, Cells, str]]) -> list[FloatArray]:
    """Return the times of files (path, cells, unit) on one clock [s].

    Dates and clock times are counted from the first of all files together.
    """
    texts = [[str(cell) for cell in cells] for _, cells, _ in times]
    are_stamps = [is_stamp(item[0]) for item in texts]
    together = seconds_of([cell for item in texts for cell in item]) if all(are_stamps) else None
    if together is not None:
        return np.split(together, np.cumsum([len(item) for item in texts])[:-1])
    if any(are_stamps):
        named = ", ".join(path for path, *_ in times)
        raise InputError(f"{named}: some have dates or clock times, others numbers; give all one.")
    return [to_si(as_numbers(cells), unit) for _, cells, unit in times]


def _channels(
    path: str, tables: Sequence[Table]
) -> tuple[Cells, str, list[tuple[str, str | None, FloatArray]]]:
    """Return the times of a file with their unit, and its channels: name, unit, values."""
    rising = [k for k in range(len(tables[0].header)) if is_rising(tables[0], k)] if tables else []
    if not rising:
        raise InputError(f"{path}: holds no time, which files to be joined need.")
    table, at, problems = tables[0], rising[0], Problems()
    columns = table.load(range(len(table.header)), None, problems)
    problems.raise_if_any()
    units = [stated_unit(text) for text in table.header]
    rows = zip(table.labels, units, columns.cells, strict=True)
    others = (row for k, row in enumerate(rows) if k != at)
    channels = [(label, unit, as_numbers(cells)) for label, unit, cells in others]
    channels = [channel for channel in channels if np.isfinite(channel[-1]).any()]
    return columns.cells[at], units[at] or "s", channels


_NAME = re.compile(r"[a-z]\w*(?:\.\w+)* \[(?P<unit>[^\[\]]+)\]", re.IGNORECASE)


def write_record(path: str | os.PathLike[str], columns: Record | Mapping[str, ArrayLike]) -> None:
    """Write a record, or columns, to a CSV file, whole or not at all.

    A record is written in SI units. The keys of columns are the header, `name [unit]` each; the
    values, shape (n,), are written in that unit as the shortest decimal number that reads back as
    the same float. nan becomes an empty cell.

    Raises:
        InputError: a key is not `name [unit]`, a unit is unknown, the columns differ in length or
            there are none, or the file cannot be written.
    """
    named: Any = columns
    if isinstance(columns, Record):
        held = {"time": columns.time, **columns.columns}
        named = {f"{name} [{columns.units[name]}]": values for name, values in held.items()}
    arrays = {name: np.asarray(values, dtype=np.float64) for name, values in named.items()}
    problems = Problems()
    if not arrays:
        problems.add(f"{path}: there are no columns to write; give at least one.")
    shape = next(iter(arrays.values())).shape if arrays else (0,)
    for name, array in arrays.items():
        match = _NAME.fullmatch(name)
        if match is None:
            problems.add(f"the column name '{name}' is not of the form 'name [unit]'; correct it.")
        else:
            try:
                parse_unit(match["unit"])
            except InputError as error:
                problems.add(f"column '{name}': {error}")
        if array.ndim != 1 or array.shape != shape:
            problems.add(
                f"column '{name}' has shape {array.shape}, the first has {shape}; give every "
                f"column one value for each instant."
            )
    problems.raise_if_any()
    cells = [["" if math.isnan(v) else repr(v) for v in item.tolist()] for item in arrays.values()]
    atomic_write(path, "\n".join([",".join(arrays), *map(",".join, zip(*cells, strict=True)), ""]))


AnyPath = str | os.PathLike[str]
_Made = TypeVar("_Made", bound=Signals)


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
#: What a user may pass as one record.
OneRecord = Signals | AnyPath | TableLike
#: What a user may pass as the records of one device.
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
    with `displacement=CH2:10um` 1 in the file is 10 um, `b.csv@time=t:ms` holds for one file.
    `columns="table=2"` takes one of several sheets, groups, blocks or segments. `sample_time` [s]
    replaces the time of the file. "a.csv+b.csv" are the channels of one record that
    an instrument has saved one by one. `notes` of the record are sentences on the reader's choices.

    Raises:
        InputError: every mistake in the file, one sentence each: file, line, column, the content,
            what was expected, what to do. At most 20 are listed, the others counted. An
            option that a sentence offers reads this file.
    """
    request = _of_stack(need_displacement, need_excitation, sample_time)
    request = _with_columns(request, columns, Path(path).name)
    return _record(str(path), _read(str(path), request), table=request.table)


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
    request = _of_stack(need_displacement, need_excitation, sample_time)
    return tuple(_several(paths, columns, request, _record))


def read_signals(
    paths: AnyPath | Iterable[AnyPath],
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
    columns: str | ColumnMap | None = None,
    sample_time: float | None = None,
) -> tuple[Signals, ...]:
    """Return the records on any model in files, each in the units of its file.

    `inputs` and `outputs` are the model's: a column is matched by its name without case, spaces and
    unit, and so is `time`. Each input must be there. `columns` and `sample_time` are those of
    `read_record`, as in `columns="u=CH1:mV,w=speed_2:rpm"`.

        records = psa.read_signals("run.csv", inputs=model.input_names, outputs=model.output_names)

    Raises:
        InputError: as `read_records`.
    """
    several = [paths] if isinstance(paths, str | os.PathLike) else paths
    request = replace(_request_of(inputs, outputs), sample_time=sample_time)
    return tuple(_several(several, columns, request, _signals))


def _of_stack(displacement: bool, excitation: bool, sample_time: float | None) -> Request:
    needed = ("voltage", "displacement") if displacement else ("voltage",)
    return Request(needed=needed, excitation=excitation, sample_time=sample_time)


def _request_of(inputs: Sequence[str], outputs: Sequence[str]) -> Request:
    names = tuple(dict.fromkeys((*inputs, *outputs)))
    return Request(names=names, needed=tuple(inputs))


def _several(
    paths: Iterable[AnyPath],
    columns: str | ColumnMap | None,
    request: Request,
    make: Callable[..., _Made],
) -> list[_Made]:
    """Return what is made of files; those of one channel each are joined.

    Raises InputError with the mistakes of all of them.
    """
    wanted = parse_columns(columns, request.names) if isinstance(columns, str) else columns
    places = [str(path) for path in paths]
    records: list[_Made] = []
    problems: list[str] = []
    failed = 0
    for path in places:
        of_file = _with_columns(request, wanted, Path(path).name)
        try:
            each = [of_file.table]
            if of_file.table == ALL:
                each = [*_read(path, replace(of_file, table="")).tables] or [""]
            records += [make(path, _read(path, replace(of_file, table=t)), table=t) for t in each]
        except InputError as error:
            failed += 1
            problems.extend(error.problems)
    if failed == len(places) > 1:  # they may hold a channel each
        of_all, outcome = _with_columns(request, wanted, ""), None
        with suppress(InputError):
            outcome = joined([(p, *apart.text_of(p)) for p in places], of_all, alone=True)
        if outcome is not None:
            return [make("+".join(places), outcome)]
    if not places:
        problems.append("no record was named; name at least one CSV file.")
    if problems:
        raise InputError(problems)
    return records


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
    x}`; or `columns` maps the names, and `sample_time` [s] replaces the time, as for
    `read_record`.

    Raises:
        InputError: every mistake, one sentence each.
    """
    request = _of_stack(need_displacement, False, sample_time)
    return _record(name, _in_memory(table, name, _with_columns(request, columns, name)), source="")


def _in_memory(table: TableLike, name: str, request: Request) -> Outcome:
    """Return the samples of a table in memory, with a hash of them."""
    keys = list(table if isinstance(table, Mapping) else table.columns)

    def load(numbers: Sequence[int], most: int | None, problems: Problems) -> Columns:
        cells = [_cells(name, keys[k], table[keys[k]], problems)[:most] for k in numbers]
        return Columns(cells, np.arange(1, 1 + max(map(len, cells), default=0)))

    header = [str(key) for key in keys]
    labels = [name_and_unit(text)[0] for text in header]
    held = Table(name, "", header, labels, f"{name}: column names", "row", load)
    outcome = samples_of(name, [held], request)
    digest = hashlib.sha256()
    for (column, unit), values in zip(outcome.units.items(), outcome.values.T, strict=True):
        digest.update(f"{column} [{unit}]".encode() + np.ascontiguousarray(values).tobytes())
    outcome.sha256 = digest.hexdigest()
    return outcome


def _cells(name: str, item: object, column: Any, problems: Problems) -> npt.NDArray[Any]:
    """Return a column in memory as numbers or instants."""
    values = np.asarray(column)
    if values.dtype.kind not in "mM":
        try:
            values = np.asarray(column, dtype=np.float64)
        except (TypeError, ValueError):
            problems.add(
                f"{name}: column '{item}': holds {type(column).__name__} that is not all"
                " numbers; convert the column first."
            )
            return np.full(len(values) if values.ndim else 0, np.nan)
    if values.ndim != 1:
        problems.add(
            f"{name}: column '{item}': has shape {values.shape}; give one value for each instant"
        )
    return values.ravel()


def _with_columns(request: Request, columns: str | ColumnMap | None, file: str) -> Request:
    """Return the request with the sources and the table that `columns` name for a file."""
    every = parse_columns(columns, request.names) if isinstance(columns, str) else columns or {}
    of_file = dict(columns_of(every, file))
    table = of_file.pop(TABLE, Source("", None)).array
    return replace(request, columns=of_file, table=table)


def _read(path: str, request: Request) -> Outcome:
    parts = parts_of(path)
    if len(parts) == 1:
        return apart.read(path, request)
    return joined([(part, *apart.text_of(part)) for part in parts], request)


def records_given(records: Records) -> tuple[Record, ...]:
    """Return one or several records from records, paths of files or tables.

    Raises:
        InputError: the mistakes of all of them together.
    """

    def convert(source: Any, name: str) -> Record:
        if isinstance(source, Record):
            return source
        if isinstance(source, Signals):
            columns, units = {"time": source.time, **source.columns}, {"time": "s", **source.units}
            return record_from(with_units(columns, units), name=name)
        return read_record(source) if _is_path(source) else record_from(source, name=name)

    return tuple(_each(records, convert, 1, "'voltage [V]': v"))


def signals_given(
    arguments: Any,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    hold: Hold | None = None,
    first: int = 1,
) -> list[Signals]:
    """Return the records on a model that a user gave: `Signals`, paths of files, tables, records.

    `hold` is what inputs do between samples (None: what `Signals` say, else "linear"), `first` the
    number of the first record without a name.

    Raises:
        InputError: the mistakes of all of them together.
    """
    request = _request_of(inputs, outputs)

    def convert(source: Any, name: str) -> Signals:
        if isinstance(source, Signals):
            return Signals(**{f.name: getattr(source, f.name) for f in fields(Signals)})
        if _is_path(source):
            return _signals(str(source), _read(str(source), request))
        return _signals(name, _in_memory(source, name, request), source="")

    records = _each(arguments, convert, first, f"'{(*inputs, *outputs)[0]}': u")
    if not records:
        raise InputError("There are no records; give one or more.")
    return records if hold is None else [replace(s, hold=hold) for s in records]


def _each(sources: Any, make: Callable[[Any, str], _Made], first: int, example: str) -> list[_Made]:
    """Return every record as `make` makes it, with a name if it has none."""
    is_one = isinstance(sources, Signals) or _is_path(sources) or _is_table(sources)
    if not is_one and not isinstance(sources, Iterable):
        sources = [sources]
    several = [sources] if is_one else list(sources)
    records: list[_Made] = []
    problems: list[str] = []
    for k, each in enumerate(several, first):
        if not (isinstance(each, Signals) or _is_path(each) or _is_table(each)):
            problems.append(
                f"{type(each).__name__} is no record; give the path of a file, a data frame, a"
                f" mapping of arrays such as {{'time [s]': t, {example}, ...}}, Record or Signals."
            )
            continue
        try:
            records.append(make(each, f"record {k}" if several[1:] or first > 1 else "record"))
        except InputError as error:
            problems.extend(error.problems)
    if problems:
        raise InputError(problems)
    return records


def _is_path(inputs: object) -> TypeGuard[AnyPath]:
    return isinstance(inputs, str | os.PathLike)


def _is_table(inputs: object) -> TypeGuard[TableLike]:
    return isinstance(inputs, Mapping) or hasattr(inputs, "columns")


def _record(path: str, outcome: Outcome, *, source: str | None = None, table: str = "") -> Record:
    """Return the record in SI units; one of several is named and hashed with its table."""
    read, whence = _samples(path, outcome, source, table)
    columns = {name: to_si(values, outcome.units[name]) for name, values in read.items()}
    for array in columns.values():
        array.flags.writeable = False  # a record need not copy it
    _check_instants(path, columns["time"])
    in_counts = "displacement" in columns and parse_unit(outcome.units["displacement"]).counts
    unit = "counts" if in_counts else "m"
    return Record(**{**columns, **whence, "displacement_unit": unit})


def _signals(path: str, outcome: Outcome, *, source: str | None = None, table: str = "") -> Signals:
    """Return the record on any model, its columns in the units of the file."""
    columns, whence = _samples(path, outcome, source, table)
    time = to_si(columns.pop("time"), outcome.units["time"])
    _check_instants(path, time)
    units = {name: outcome.units[name] for name in columns}
    return Signals(time=time, columns=columns, units=units, unread=outcome.unread, **whence)


def _samples(
    path: str, outcome: Outcome, source: str | None, table: str
) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """Return the columns that were read, and name, hash, source and notes of the record."""
    if outcome.problems:
        raise InputError(outcome.problems)
    if not outcome.units:
        raise InputError(f"{path}: holds no columns; name them as 'time [s]', 'voltage [V]'.")
    digest = outcome.sha256
    stem = "+".join(Path(part).stem for part in parts_of(path)) if source is None else path
    return dict(zip(outcome.units, outcome.values.T, strict=True)), {
        "name": plain(f"{stem}_{table}" if table else stem),
        "sha256": hashlib.sha256(f"{digest} {table}".encode()).hexdigest() if table else digest,
        "source": path if source is None else source,
        "notes": tuple(f"{path}: {note}" for note in outcome.notes),
    }


def _check_instants(path: str, time: FloatArray) -> None:
    if not (np.diff(time) > 0.0).all():
        raise InputError(
            f"{path}: instants are the same in seconds; give the time from the start of"
            " the record, in a unit in which neighbours differ by more than the last digit."
        )
