"""From the tables of a file to the samples of one record, in the units of the file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.choose import Ask, Choice, Question, choose
from psa_casadi.records.read.columns import ALL, ColumnMap, ready_line
from psa_casadi.records.read.convert import (
    MOST_NAMED,
    NoTimeOfTheirOwn,
    Request,
    Samples,
    SegmentsOfTime,
    converted,
)
from psa_casadi.records.read.table import Table, parts_of_file

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
