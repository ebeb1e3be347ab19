"""From the tables of a file to the samples of one record, in the units of the file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from psa_casadi.common.errors import InputError, Problems, quoted
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.records.read.choose import ASK_UNIT, Chosen, Question, Request
from psa_casadi.records.read.columns import ALL, ColumnMap, Field, ready_line
from psa_casadi.records.read.table import (
    Cells,
    Columns,
    Table,
    as_times,
    check_size,
    decimal_sign,
    evened,
    is_number,
    numbers_in,
    parts_of_file,
    starts_of,
    without_overload,
)
from psa_casadi.records.record import FEWEST_SAMPLES, Located

#: A sample time [s] to show where a file has no time.
_EXAMPLE_STEP = 1e-3

#: The most tables and segments that are named in one sentence.
MOST_NAMED = 8


@dataclass(frozen=True)
class Head:
    """The columns of a table by the names that `--columns` takes, and the first rows.

    A name is "" if `--columns` cannot name it. `units` are those that the file states, "" if it
    states none; `rows` hold the cells as text. `guess` maps the columns of a record to their
    places, as the reader takes them or would suggest them. `tables` are those of the file.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    guess: Mapping[str, Field]
    tables: tuple[str, ...] = ()


@dataclass
class Outcome:
    """The columns of one record in the units of the file, checked, or what is wrong.

    `units` names the columns in the order of `values`, shape (rows, columns), nan where there is no
    reading; there are none where nothing is read. `notes` are sentences on what was taken for what,
    `unread` the labels of other columns where one that a model has is missing.
    `tables` are the choices where there are several records, `offer` the columns and the sample
    time [s] with which the file is read, `sha256` is that of the file; `head` is the head of a
    file of which no samples are read.
    """

    problems: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    values: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    notes: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()
    offer: tuple[ColumnMap, float | None] | None = None
    sha256: str = ""
    head: Head | None = None

    @property
    def is_read(self) -> bool:
        """Whether there are samples and nothing is wrong."""
        return bool(self.units) and not self.problems


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
        names = quoted(parts)
        raise InputError(f"{path}: there is no table '{request.table}'; there are {names}.")
    whole = _of_one(tables[0], request, request.table)
    is_part = tables[0] in parts.values()
    if len(tables) == 1 or whole.tables or (not is_part and (whole.is_read or request.columns)):
        return whole  # of arrays all together are one record
    each = {key: _of_one(table, request, "") for key, table in parts.items()}
    several = is_part or any(outcome.is_read for outcome in each.values())
    return _of_several(path, each) if several else whole


def _of_several(path: str, outcomes: Mapping[str, Outcome]) -> Outcome:
    """Return the samples of the only record among several tables, or list those that can be one."""
    read = [key for key, outcome in outcomes.items() if outcome.is_read]
    if len(read) == 1:
        note = f"of {len(outcomes)} tables '{read[0]}' is read, the only one that is a record."
        outcomes[read[0]].notes += (note,)
        return outcomes[read[0]]
    some = read or [key for key, outcome in outcomes.items() if outcome.offer] or list(outcomes)
    if len(some) == 1:
        return outcomes[some[0]]
    listed = quoted(some[:MOST_NAMED])
    more = f" and {len(some) - MOST_NAMED} more" if len(some) > MOST_NAMED else ""
    problem = (
        f"{path}: holds {len(some)} tables that may be the record ({listed}{more}); take one of"
        f" them, such as {ready_line(*(outcomes[some[0]].offer or ({}, None)), some[0])}"
        f"{f', or each as a record: {ready_line({}, None, ALL)}' if read else ''}."
    )
    return Outcome((problem,), tables=tuple(some))


def _of_one(table: Table, request: Request, segment: str) -> Outcome:
    """Return the samples of one table; what it leaves open ends with an option that reads it."""
    tried = _Try(table, request, segment)
    if not tried.open:
        return tried.outcome
    sentences = [f"{q.what}; {q.cure}" if q.cure else q.what for q in tried.open]
    offer, key = _offer(table, request, tried.choice, segment)
    if offer:
        last = tried.open[-1]
        how = last.ask if offer[0] else "give the time between samples"
        join = ", or" if last.cure else ";"
        sentences[-1] += f"{join} {how}: {ready_line(*offer, key or request.table)}"
    elif len(table.header) == 2 and not table.sizes:
        sentences[-1] += "; files of one channel each are joined as FILE+FILE"
    problems = Problems()
    for sentence in (*(f"{s}." for s in sentences), *tried.problems.sentences()):
        problems.add(sentence)
    return replace(tried.outcome, problems=problems.sentences(), offer=offer)


def _offer(
    table: Table, request: Request, choice: Chosen, segment: str
) -> tuple[tuple[ColumnMap, float | None] | None, str]:
    """Return the first options with which the table is read, and the part of it that they take."""
    inputs = request.sample_time
    without = {name: source for name, source in choice.sources.items() if name != "time"}
    trials: list[tuple[ColumnMap, float | None]] = []
    if choice.sources:
        trials = [(choice.sources, inputs), (without, inputs or _EXAMPLE_STEP)]
    if inputs is None:
        trials.append((request.columns, _EXAMPLE_STEP))
    for sources, step in trials:
        trial = replace(request, columns=sources, sample_time=step)
        offer = (sources if sources != request.columns else {}, step if inputs is None else None)
        tried = _Try(table, trial, segment)
        if tried.open:
            continue
        if tried.outcome.is_read:
            return offer, ""
        if tried.outcome.tables and _Try(table, trial, "1").outcome.is_read:
            return offer, tried.outcome.tables[0]
    return None, ""


class _Try:
    """A table that is read: the choice of its columns, what that leaves `open`, and the outcome."""

    def __init__(self, table: Table, request: Request, segment: str) -> None:
        self.table, self.segment, self.notes = table, segment, list[str]()
        self.outcome, self.problems = Outcome(), Problems()
        self.choice = request.chosen(table, self.problems)
        if table.step and "time" not in self.choice.fields and request.sample_time is None:
            note = f"the time is that of the sample time that the file states, {table.step:g} s."
            self.notes.append(note)
            request, self.problems = replace(request, sample_time=table.step), Problems()
            self.choice = request.chosen(table, self.problems)
        self.request, self.open = request, self.choice.open
        if self.choice.fields:
            self._convert(dict(self.choice.fields))
        self.outcome.problems = self.problems.sentences()

    def _convert(self, fields: dict[str, Field]) -> None:
        """Take the samples of chosen columns, checked, where they make a record."""
        table, request = self.table, self.request
        step = request.sample_time
        if step is not None and fields.pop("time", None) is not None:
            note = "the times of the file are left out for the specified sample time."
            self.notes.append(note)
        columns = table.load([f.index for f in fields.values()], None, self.problems)
        if self._lengths_differ(fields, columns):
            return
        texts = [cells for cells in columns.cells if not isinstance(cells, np.ndarray)]
        point = decimal_sign(c for row in zip(*texts, strict=False) for c in row)
        located = {
            name: self._numbers(name, item.unit, cells, columns.lines, point)
            for (name, item), cells in zip(fields.items(), columns.cells, strict=True)
        }
        units = {name: item.unit for name, item in fields.items()}
        if step is not None:
            units = {"time": "s", **units}
            located = {"time": self._even_time(step, columns.lines), **located}
        elif "time" in located:
            part = self._timed(located)
            if part is None:
                return
            located = {n: c.part(part) for n, c in located.items()}
        check_size(table.path, 8 * len(columns.lines) * len(located), "its columns hold")
        self._check(located)
        scales = {n: source.scale for n, source in request.columns.items() if source.scale}
        self.outcome.values = np.column_stack(
            [c.values * scales[n] if n in scales else c.values for n, c in located.items()]
        )
        self.outcome.units, self.outcome.notes = units, tuple(self.notes)
        self.outcome.unread = self.choice.unread

    def _even_time(self, step: float, lines: IndexArray) -> Located:
        if not 0.0 < step < 1e9:
            problem = f"the sample time {step} s is no time; give seconds."
            raise InputError(f"{self.table.path}: {problem}")
        if step != self.table.step:
            self.notes.append(
                f"{step:g} s from sample to sample is the specified sample time; if it is invented,"
                " as for a curve without time, rates, creep and lags mean nothing."
            )
        return self._located("time", step * np.arange(len(lines), dtype=np.float64), lines)

    def _located(
        self, name: str, values: FloatArray, lines: IndexArray,
        wrong: BoolArray | None = None,
    ) -> Located:  # fmt: skip
        reported = np.zeros(values.size, dtype=np.bool_) if wrong is None else wrong
        table = self.table
        return Located(table.path, name, values, lines, reported, table.place, self.problems)

    def _numbers(
        self, name: str, unit: str, cells: Cells, lines: IndexArray, point: str
    ) -> Located:
        """Return a column as numbers; report what is none with its place."""
        table = self.table
        values = as_times(cells, unit) if name == "time" else None
        if values is None and isinstance(cells, np.ndarray):
            values = cells.astype(np.float64)
        if values is not None:
            return self._located(name, without_overload(values), lines)
        texts = [str(cell) for cell in cells]
        values, wrong = numbers_in(texts, point, unit)
        if table.sizes and wrong.all():
            self.problems.add(
                f"{table.path}: column '{name}': holds texts such as '{texts[0][:40]}', expected"
                " numbers; convert the column before the file is written."
            )
            return self._located(name, values, lines, wrong)
        for k in np.flatnonzero(wrong):
            hint = "correct it, or leave the cell empty where the sample is missing"
            if name in self.request.whole:
                hint = f"correct it or remove the {table.place}"
            if is_number(texts[k]) and decimal_sign([texts[k]]) != point:
                other = "comma" if point == "," else "point"
                hint = f"other numbers of this file have a decimal {other}, write this one so too"
            self.problems.add(
                f"{table.path}: {table.place} {lines[k]}, column '{name}': found"
                f" '{texts[k].strip()[:40]}', expected a number; {hint}."
            )
        return self._located(name, values, lines, wrong)

    def _timed(self, locateds: Mapping[str, Located]) -> slice | None:
        """Return the part of the samples that is the record; mend a time with too few digits.

        None if the time restarts: each part is a record, or the time is that of packets.
        """
        table, time, lines = self.table, locateds["time"].values, locateds["time"].lines
        starts = starts_of(np.nan_to_num(time, nan=-np.inf) if np.isnan(time).any() else time)
        ends = [*starts[1:].tolist(), time.size]
        sizes = np.diff([*starts, time.size])
        part = slice(0, time.size)
        if len(starts) > 1 and sizes[:-1].min() >= FEWEST_SAMPLES:
            numbers = [str(k) for k in range(1, len(starts) + 1)]
            if self.segment not in numbers:
                keys = [f"{table.name}.{k}".strip(".") for k in numbers]
                listed = ", ".join(
                    f"{key} ({table.place}s {lines[a]} to {lines[b - 1]})"
                    for key, a, b in list(zip(keys, starts, ends, strict=True))[:MOST_NAMED]
                )
                self.outcome.tables = tuple(keys)
                if not self.open:  # an open question of the whole table comes first
                    self.problems.add(
                        f"{table.path}: the time restarts {len(keys) - 1} times, so it holds"
                        f" {len(keys)} records: {listed}; take one of them, such as"
                        f" {ready_line({}, None, keys[0])}, or each as a record:"
                        f" {ready_line({}, None, ALL)}."
                    )
                return None
            k = int(self.segment) - 1
            part = slice(int(starts[k]), ends[k])
        elif len(starts) > 2 and len(set(sizes[:-1].tolist())) == 1 and np.isfinite(time).all():
            if np.array_equal(time[: sizes[0]], time[sizes[0] : 2 * sizes[0]]):
                text = (
                    f"{table.path}: the time restarts every {sizes[0]} {table.place}s: these"
                    " packets have no separate times"
                )
                self.open.append(Question(text, ASK_UNIT))
                return None
        elif self.segment not in ("", "1"):
            raise InputError(f"{table.path}: there is no table '{self.segment}'; it holds one.")
        same = np.diff(time[part]) == 0.0
        others = [np.diff(c.values[part])[same] for n, c in locateds.items() if n != "time"]
        repeats = same.any() and all((moves == 0.0).all() for moves in others)
        even = None if repeats else evened(time[part])  # lines that are double are not rounded
        if even is not None:
            time[part] = even[0]
            self.notes.append(
                "the time has too few digits, so that it repeats; it is taken to be even, with"
                f" steps of {even[1]:.6g} of its unit."
            )
        return part

    def _lengths_differ(self, fields: Mapping[str, Field], columns: Columns) -> bool:
        sizes = [len(cells) for cells in columns.cells]
        first, kind = next(iter(fields), ""), "array" if self.table.sizes else "column"
        for (name, item), size in zip(fields.items(), sizes, strict=True):
            if size != sizes[0]:
                self.problems.add(
                    f"{self.table.path}: {kind} '{self.table.labels[item.index]}' ({name}) has"
                    f" {size} values, '{first}' has {sizes[0]}; give every column one value for"
                    " each instant."
                )
        return len(set(sizes)) != 1

    def _check(self, locateds: Mapping[str, Located]) -> None:
        """Check the samples of a record; those of a path to follow are checked elsewhere."""
        outputs = [n for n in self.request.names if n not in self.request.whole]
        for output in outputs or ["displacement"]:
            missing = locateds.get(output)
            count = int((np.isnan(missing.values) & ~missing.reported).sum()) if missing else 0
            if count:
                column = f"'{output}'" if outputs else "the displacement"
                self.notes.append(f"{count} readings of {column} are missing; they are masked.")
        if not self.request.names and "voltage" not in self.request.needed:
            return
        samples = len(next(iter(locateds.values())).lines)
        if samples < FEWEST_SAMPLES:
            more = "record for longer" if samples else "fill the rows below its header"
            self.problems.add(
                f"{self.table.path}: found {samples} samples, expected at least {FEWEST_SAMPLES};"
                f" {more}, or name the right file."
            )
        for name, located in locateds.items():
            if name == "time":
                located.check_time()
            elif name == "displacement" and name not in outputs:
                located.check_displacement()
            else:
                located.check_finite(complete=name not in outputs)
            if name == "voltage" and self.request.excitation and not located.reported.any():
                located.check_excitation()
