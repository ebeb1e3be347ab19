"""From the tables of a file to the samples of one record, in the units of the file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.choose import Ask, Choice, Question, choose
from psa_casadi.records.read.columns import ALL, ColumnMap, Field, ready_line
from psa_casadi.records.read.file_bytes import check_size
from psa_casadi.records.read.table import (
    Cells,
    Columns,
    Parsed,
    Table,
    as_times,
    decimal_sign,
    evened,
    is_number,
    numbers_in,
    parts_of_file,
    starts_of,
    without_overload,
)
from psa_casadi.records.record import (
    FEWEST_SAMPLES,
    Located,
    check_complete,
    check_displacement,
    check_excitation,
    check_length,
    check_time,
)
from psa_casadi.units import FloatArray

#: The most tables and segments that are named in one sentence.
MOST_NAMED = 8


@dataclass(frozen=True)
class Request:
    """What is wanted of a file.

    `columns` says which column is which, `sample_time` [s] gives the time of samples without one,
    `table` takes one of several tables; `displacement` and `excitation` demand a displacement, and
    a voltage that changes. Without `voltage` it is a path to follow, which is checked elsewhere.
    """

    columns: ColumnMap = field(default_factory=dict)
    sample_time: float | None = None
    table: str = ""
    displacement: bool = True
    excitation: bool = False
    voltage: bool = True

    @property
    def required(self) -> tuple[str, ...]:
        """The columns that must be there."""
        needed = {
            "time": self.sample_time is None,
            "voltage": self.voltage,
            "displacement": self.displacement,
        }
        return tuple(name for name, is_needed in needed.items() if is_needed)


@dataclass(frozen=True, eq=False)
class Samples:
    """The columns of one record in the units of the file, checked; nan where there is no reading.

    `units` names the columns in the order of `values`, shape (rows, columns). `notes` are sentences
    on what was taken for what.
    """

    units: Mapping[str, str]
    values: FloatArray
    notes: Sequence[str] = ()


class SegmentsOfTime(Exception):  # noqa: N818 - not an error yet: one of them may be asked for
    """A table whose time begins anew: each part is a record."""

    def __init__(self, sentence: str, keys: Sequence[str]) -> None:
        super().__init__(sentence)
        self.keys = tuple(keys)


class NoTimeOfTheirOwn(Exception):  # noqa: N818 - a part of a sentence
    """The times of a table are those of packets."""


def converted(
    table: Table,
    fields: Mapping[str, Field],
    request: Request,
    segment: str,
    problems: Problems,
    notes: list[str],
) -> Samples | None:
    """Return the samples of chosen columns, checked; None where their lengths differ.

    `segment` takes a part of a time that begins anew. Mistakes are added to `problems` with their
    place, and to `notes` what was taken for what.

    Raises:
        SegmentsOfTime, NoTimeOfTheirOwn: the time begins anew.
        InputError: the sample time is none, or there is more than a record may hold.
    """
    fields = dict(fields)
    if request.sample_time is not None and fields.pop("time", None) is not None:
        notes.append("the times of the file are left out for the sample time that was given.")
    columns = table.load([f.index for f in fields.values()], None, problems)
    if _lengths_differ(table, fields, columns, problems):
        return None
    point = decimal_sign(c for row in zip(*_texts(columns), strict=False) for c in row)
    found = {
        name: _numbers(table, name, own.unit, cells, columns.lines, point, problems)
        for (name, own), cells in zip(fields.items(), columns.cells, strict=True)
    }
    lines = columns.lines
    if request.sample_time is not None:
        if not 0.0 < request.sample_time < 1e9:
            raise InputError(
                f"{table.path}: the sample time {request.sample_time} s is no time; give seconds."
            )
        even = np.asarray(request.sample_time * np.arange(len(lines)), dtype=np.float64)
        if request.sample_time != table.step:
            notes.append(
                f"{request.sample_time:g} s from sample to sample is what was given; if it is"
                " invented, as for a curve without time, rates, creep and lags mean nothing."
            )
        clear = np.zeros(len(lines), dtype=np.bool_)
        found = {"time": Parsed(even, clear, 0), **found}
        fields = {"time": Field(-1, "s"), **fields}
    elif "time" in found:
        part = _timed(table, found, lines, segment, notes)
        found = {n: Parsed(p.values[part], p.wrong[part], p.missing) for n, p in found.items()}
        lines = lines[part]
    for name, parsed in found.items():
        if parsed.missing and name == "displacement":
            notes.append(f"{parsed.missing} readings of the {name} are missing; they are masked.")
    check_size(table.path, 8 * len(lines) * len(found), "its columns hold")
    if request.voltage:
        _check(table, found, lines, problems, request)
    scales = [request.columns[n].scale if n in request.columns else None for n in found]
    values = np.column_stack([
        p.values if scale is None else p.values * scale
        for p, scale in zip(found.values(), scales, strict=True)
    ])  # fmt: skip
    return Samples({n: f.unit for n, f in fields.items()}, values, tuple(notes))


def _texts(columns: Columns) -> list[Sequence[str]]:
    return [cells for cells in columns.cells if not isinstance(cells, np.ndarray)]


def _numbers(
    table: Table, name: str, unit: str, cells: Cells, lines: NDArray[np.int64], point: str,
    problems: Problems,
) -> Parsed:  # fmt: skip
    """Return a column as numbers; what is none is told with its place."""
    values = as_times(cells, unit) if name == "time" else None
    if values is None and isinstance(cells, np.ndarray):
        values = cells.astype(np.float64)
    if values is not None:
        return without_overload(values)
    texts = [str(cell) for cell in cells]
    parsed = numbers_in(texts, point, unit)
    if table.sizes and parsed.wrong.all():
        problems.add(
            f"{table.path}: column '{name}': holds texts such as '{texts[0][:40]}', expected"
            " numbers; convert the column before the file is written."
        )
        return Parsed(parsed.values, parsed.wrong, 0)
    for line, cell in zip(lines[parsed.wrong], np.array(texts)[parsed.wrong], strict=True):
        hint = "correct it, or leave the cell empty where the sample is missing"
        if name in ("time", "voltage"):
            hint = f"correct it or remove the {table.place}"
        if is_number(cell) and decimal_sign([cell]) != point:
            other = "comma" if point == "," else "point"
            hint = f"other numbers of this file have a decimal {other}, write this one so too"
        problems.add(
            f"{table.path}: {table.place} {line}, column '{name}': found '{cell.strip()[:40]}',"
            f" expected a number; {hint}."
        )
    return parsed


def _timed(
    table: Table,
    found: dict[str, Parsed],
    lines: NDArray[np.int64],
    segment: str,
    notes: list[str],
) -> slice:
    """Return the part of the samples that is the record; mend a time with too few digits.

    Raises:
        SegmentsOfTime: the time begins anew, and each part is long enough for a record.
        NoTimeOfTheirOwn: it begins anew after every few samples.
    """
    time = found["time"].values
    starts = starts_of(np.nan_to_num(time, nan=-np.inf) if np.isnan(time).any() else time)
    ends = [*starts[1:], time.size]
    sizes = np.diff([*starts, time.size])
    part = slice(0, time.size)
    if len(starts) > 1 and sizes[:-1].min() >= FEWEST_SAMPLES:
        keys = [f"{table.name}.{k}".strip(".") for k in range(1, len(starts) + 1)]
        if segment not in [str(k) for k in range(1, len(starts) + 1)]:
            listed = ", ".join(
                f"{key} ({table.place}s {lines[a]} to {lines[b - 1]})"
                for key, a, b in list(zip(keys, starts, ends, strict=True))[:MOST_NAMED]
            )
            raise SegmentsOfTime(
                f"{table.path}: the time begins anew {len(starts) - 1} times, so it holds"
                f" {len(starts)} records: {listed}; take one of them, such as"
                f" {ready_line({}, None, keys[0])}, or each as a record:"
                f" {ready_line({}, None, ALL)}.",
                keys,
            )
        part = slice(int(starts[int(segment) - 1]), int(ends[int(segment) - 1]))
    elif len(starts) > 2 and len(set(sizes[:-1].tolist())) == 1 and np.isfinite(time).all():
        packet = time[: sizes[0]]
        if np.array_equal(packet, time[sizes[0] : 2 * sizes[0]]):
            raise NoTimeOfTheirOwn(
                f"{table.path}: the time begins anew every {sizes[0]} {table.place}s: these packets"
                " have no time of their own"
            )
    elif segment and segment != "1":
        raise InputError(f"{table.path}: there is no table '{segment}'; it holds one.")
    even = None if _repeats(found, part) else evened(time[part])
    if even is not None:
        found["time"].values[part] = even[0]
        notes.append(
            "the time has too few digits, so that it repeats; it is taken to be even, with steps of"
            f" {even[1]:.6g} of its unit."
        )
    return part


def _repeats(found: Mapping[str, Parsed], part: slice) -> bool:
    """Whether whole samples are repeated where the time is: then lines are double, not rounded."""
    same = np.diff(found["time"].values[part]) == 0.0
    others = [p.values[part] for n, p in found.items() if n != "time"]
    return bool(same.any() and all((np.diff(v)[same] == 0.0).all() for v in others))


def _lengths_differ(
    table: Table, fields: Mapping[str, Field], columns: Columns, problems: Problems
) -> bool:
    sizes = [len(cells) for cells in columns.cells]
    if not sizes:
        return True
    first, kind = next(iter(fields)), "array" if table.sizes else "column"
    for (name, own), size in zip(fields.items(), sizes, strict=True):
        if size != sizes[0]:
            problems.add(
                f"{table.path}: {kind} '{table.labels[own.index]}' ({name}) has {size} values,"
                f" '{first}' has {sizes[0]}; give every column one value for each instant."
            )
    return len(set(sizes)) > 1


def _check(
    table: Table,
    found: Mapping[str, Parsed],
    lines: NDArray[np.int64],
    problems: Problems,
    request: Request,
) -> None:
    check_length(table.path, len(lines), problems)
    for name, parsed in found.items():
        column = Located(table.path, name, parsed.values, lines, parsed.wrong, table.place)
        if name == "time":
            check_time(column, problems)
        elif name == "displacement":
            check_displacement(column, problems)
        else:
            check_complete(column, problems)
        if name == "voltage" and request.excitation and not parsed.wrong.any():
            check_excitation(column, problems)


#: A sample time [s] to show where a file has no time.
_EXAMPLE_STEP = 1e-3


@dataclass
class Outcome:
    """The samples, or what is wrong.

    `tables` are the choices where there are several records, `offer` the columns and the sample
    time [s] with which the file is read.
    """

    samples: Samples | None = None
    problems: Problems = field(default_factory=Problems)
    tables: Sequence[str] = ()
    offer: tuple[ColumnMap, float | None] | None = None

    @property
    def is_read(self) -> bool:
        """Whether there are samples and nothing is wrong."""
        return self.samples is not None and not self.problems


def samples_of(path: str, tables: Sequence[Table], request: Request) -> Outcome:
    """Return the samples of the record that the tables of a file hold.

    Of several tables that one counts which `request` names, else the only one that is a record;
    where there are several, they are listed. An option is offered only if it reads this file.
    """
    if not tables:
        raise InputError(f"{path}: holds no header and no data; export the record again.")
    parts = parts_of_file(tables)
    keys = {**{str(k): t for k, t in enumerate(parts.values(), 1)}, **parts}
    wanted, _, segment = request.table.rpartition(".")
    if request.table in keys and (len(tables) > 1 or request.table == tables[0].name):
        return _of_one(keys[request.table], request, "")
    if wanted in keys:
        return _of_one(keys[wanted], request, segment)
    if request.table and len(tables) > 1:
        names = ", ".join(f"'{key}'" for key in parts)
        raise InputError(f"{path}: there is no table '{request.table}'; there are {names}.")
    whole = _of_one(tables[0], request, request.table)
    is_part = tables[0] in parts.values()
    if len(tables) == 1 or whole.tables or (not is_part and (whole.is_read or request.columns)):
        return whole  # of arrays all together are one record
    found = {key: _of_one(table, request, "") for key, table in parts.items()}
    return _of_several(path, found) if is_part or any(o.is_read for o in found.values()) else whole


def _of_several(path: str, found: Mapping[str, Outcome]) -> Outcome:
    """Return the samples of the only record among several tables, or list those that can be one."""
    read = [key for key, outcome in found.items() if outcome.is_read]
    if len(read) == 1:
        outcome = found[read[0]]
        if outcome.samples is not None:
            note = f"of {len(found)} tables '{read[0]}' is read, the only one that is a record."
            outcome.samples = replace(outcome.samples, notes=(*outcome.samples.notes, note))
        return outcome
    some = read or [key for key, outcome in found.items() if outcome.offer] or list(found)
    if len(some) == 1:
        return found[some[0]]
    listed = ", ".join(f"'{key}'" for key in some[:MOST_NAMED])
    more = f" and {len(some) - MOST_NAMED} more" if len(some) > MOST_NAMED else ""
    problems = Problems()
    problems.add(
        f"{path}: holds {len(some)} tables that may be the record ({listed}{more}); take one of"
        f" them, such as {ready_line(*(found[some[0]].offer or ({}, None)), some[0])}"
        f"{f', or each as a record: {ready_line({}, None, ALL)}' if read else ''}."
    )
    return Outcome(None, problems, tuple(some))


def _of_one(table: Table, request: Request, segment: str) -> Outcome:
    """Return the samples of one table; what it leaves open ends with an option that reads it."""
    outcome, choice, told = _tried(table, request, segment)
    if not told:
        return outcome
    said = [f"{q.what}; {q.cure}" if q.cure else q.what for q in told]
    offer, key = _offer(table, request, choice, segment)
    if offer:
        last = told[-1]
        how = last.ask if offer[0] else "give the time between samples"
        join = ", or" if last.cure else ";"
        said[-1] += f"{join} {how}: {ready_line(*offer, key or request.table)}"
    elif len(table.header) == 2 and not table.sizes:
        said[-1] += "; files of one channel each are joined as FILE+FILE"
    whole = Problems()
    for sentence in (*(f"{s}." for s in said), *outcome.problems.sentences()):
        whole.add(sentence)
    return Outcome(outcome.samples, whole, outcome.tables, offer)


def _offer(
    table: Table, request: Request, choice: Choice, segment: str
) -> tuple[tuple[ColumnMap, float | None] | None, str]:
    """Return the first options with which the table is read, and the part of it that they take."""
    without = {name: source for name, source in choice.sources.items() if name != "time"}
    trials = [(choice.sources, None), (without, _EXAMPLE_STEP)] if choice.sources else []
    if request.sample_time is None:
        trials.append((request.columns, _EXAMPLE_STEP))
    for sources, own in trials:
        step = request.sample_time if own is None else request.sample_time or own
        trial = replace(request, columns=sources, sample_time=step)
        shown = sources if sources != request.columns else {}
        offer = (shown, None if request.sample_time is not None else step)
        found, _, told = _tried(table, trial, segment)
        if found.is_read and not told:
            return offer, ""
        if found.tables and not told and _tried(table, trial, "1")[0].is_read:
            return offer, found.tables[0]
    return None, ""


def _tried(table: Table, request: Request, segment: str) -> tuple[Outcome, Choice, list[Question]]:
    """Return what a table is read to, the choice of its columns, and what that leaves open."""
    problems = Problems()
    notes: list[str] = []
    choice = choose(table, request.required, request.columns, problems)
    if table.step and "time" not in choice.fields and request.sample_time is None:
        again = replace(request, sample_time=table.step)
        notes.append(f"the time is that of the sample time that the file states, {table.step:g} s.")
        problems = Problems()
        request, choice = again, choose(table, again.required, request.columns, problems)
    told = list(choice.open)
    outcome = Outcome(None, problems)
    if choice.fields:
        try:
            outcome.samples = converted(table, choice.fields, request, segment, problems, notes)
        except SegmentsOfTime as several:
            outcome.tables = several.keys
            if not told:  # what is open is asked first: no table alone would be read
                problems.add(str(several))
        except NoTimeOfTheirOwn as error:
            told.append(Question(str(error), Ask.UNIT))
    return outcome, choice, told
