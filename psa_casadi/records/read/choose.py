"""Which column of a table is which column of a record, in which unit, and what remains open."""

import difflib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import parse_unit
from psa_casadi.records.read.columns import (
    COLUMN_OF,
    SI_UNITS,
    WORDS,
    ColumnMap,
    Field,
    Source,
    check_unit,
    measures,
    mismatch,
    name_and_unit,
    names_and_units,
    stated_unit,
    understood,
    unit_for,
    unit_named,
    usual_source,
    words_of,
)
from psa_casadi.records.read.table import Table, as_numbers, as_times, evened
from psa_casadi.records.record import COLUMNS

#: The quantities of the columns that every record has.
QUANTITIES = {"time": "time", "voltage": "voltage", "displacement": "length"}
#: Marks of `--columns`, which a name may not hold if a unit follows.
_MARKS = set(",[]")
#: Words for what is commanded and for what drives, for what is measured, and for neither; for what
#: only marks an instant, and for what only counts.
_COMMANDED, _DRIVING, _MEASURED, _NEITHER, _MARKING, _COUNTING = (
    set(WORDS["roles"][role])
    for role in ("commanded", "driving", "measured", "neither", "marking", "counting")
)
_FOR = {"voltage": _COMMANDED | _DRIVING, "displacement": _MEASURED}
_AGAINST = {
    "time": _MARKING | _COUNTING,
    "voltage": _MEASURED | _NEITHER | _MARKING | (_COUNTING - {"pos"}),
    "displacement": _COMMANDED | _NEITHER | _MARKING | (_COUNTING - {"pos"}),
}


@dataclass(frozen=True)
class Cell:
    """A cell of a header or an array of a file.

    `label` is what `--columns` calls it, `unit` what it states, `column` what its name means;
    `hint` is a unit that it may state. `text` is what a person reads.
    """

    index: int
    label: str
    text: str
    unit: str | None
    hint: str | None
    column: str | None
    words: frozenset[str]

    def speaks(self, column: str) -> int:
        """Return 1 where the words of the name speak for a column, -1 against it, else 0."""
        meant = {COLUMN_OF[word] for word in self.words if word in COLUMN_OF}
        if meant - {column} or self.words & (_AGAINST.get(column, set()) | _MARKING):
            return -1
        return 1 if meant or self.words & _FOR.get(column, set()) else 0

    def rank(self, column: str) -> int | None:
        """Return how likely it is a column, 0 for the most likely; None where it is not."""
        number = self.speaks(column)
        if self.column not in (None, column) or (self.column is None and number < 0):
            return None
        if self.hint is None or measures(column, self.hint):
            return 0 if self.column else (2 if self.hint else 4) - number
        in_volts = column == "displacement" and measures("voltage", self.hint)
        return 6 - number if in_volts and not self.words & _FOR["voltage"] else None

    @property
    def channel(self) -> str:
        """The number at the end of a name without unit, "" without one."""
        return self.text[len(self.text.rstrip("0123456789")) :] if self.unit is None else ""

    def misspelled(self, absent: Sequence[str]) -> str:
        """Return the column whose canonical name it has with a mistake, "" without one."""
        cutoff = 0.8 if self.words.isdisjoint(COLUMN_OF) else 0.9
        near = difflib.get_close_matches(plain(self.label), absent, n=1, cutoff=cutoff)
        return near[0] if near else ""


#: What to do with the option that is offered for an open question.
ASK_COLUMN, ASK_UNIT = "say which column it is", "say which, and in which unit"
_ASK_SCALE = "say what 1 in the file is"


class Question(NamedTuple):
    """Something that a table leaves open: what it is, what to say, and what to do in the file."""

    what: str
    ask: str
    cure: str = ""


@dataclass(frozen=True)
class Request:
    """What is wanted of a file.

    `columns` maps columns to their sources, `sample_time` [s] is the time between samples without
    one, `table` takes one of several tables; `needed` are the columns that must be there besides
    the time, and `excitation` demands a voltage that changes. With `names`, those of a model's
    inputs and outputs, it is a record on that model; else one of a stack, or without a voltage
    among the needed a path to follow, which is checked elsewhere.
    """

    columns: ColumnMap = field(default_factory=dict)
    sample_time: float | None = None
    table: str = ""
    needed: tuple[str, ...] = ("voltage", "displacement")
    excitation: bool = False
    names: tuple[str, ...] = ()

    @property
    def required(self) -> tuple[str, ...]:
        """The columns that must be there."""
        return (*(("time",) if self.sample_time is None else ()), *self.needed)

    @property
    def whole(self) -> tuple[str, ...]:
        """The columns that may lack no sample."""
        return ("time", *(self.needed if self.names else ("voltage",)))

    def chosen(self, table: Table, problems: Problems) -> "Chosen":
        """Return which column of a table is which."""
        if self.names:
            return ByName(table, self, problems)
        return Choice(with_usual_units(table), self, problems)


class Chosen:
    """The columns of a table by name: `fields`.

    `open` is what the table leaves open, `sources` what is suggested for that, `unread` are the
    labels of other columns where one that is wanted is missing. Added to `problems`: columns that
    are there twice, units that are wrong, names in `request.columns` that the table does not have.
    """

    def __init__(self, table: Table, request: Request, problems: Problems) -> None:
        self.table, self.request, self.problems = table, request, problems
        self.wanted, self.fields = request.columns, dict[str, Field]()
        self.open, self.sources = list[Question](), dict[str, Source]()
        self.unread: tuple[str, ...] = ()

    def _refuse_absent(self, name: str, source: Source, present: str) -> None:
        self.problems.add(
            f"{self.table.where}: '{source.array}', which --columns names for '{name}', is"
            f" not in the header (present: {present}); correct --columns."
        )

    def _refuse_second(self, name: str, index: int, first: Field) -> None:
        self.problems.add(
            f"{self.table.where}, column {index + 1}: '{name}' occurs twice in the header (first"
            f" as column {first.index + 1}); rename or remove one of the two."
        )

    def _refuse_other_unit(self, where: str, stated: str | None, wanted: str | None) -> None:
        self.problems.add(
            f"{where}: the header gives the unit '{stated}', --columns gives '{wanted}'; leave the"
            f" one in --columns out, or say there what 1 in the file is, such as 10{wanted}."
        )

    def _ask_header(self, example: str) -> None:
        text = f"{self.table.where}: found '{self.table.headless[:60]}', expected a header"
        self.open = [Question(text, ASK_UNIT, f"write a first line such as '{example}'")]

    def _ask_column(self, name: str, present: str, cure: str) -> None:
        what = f"{self.table.where}: the column '{name}' is missing (present: {present})"
        self.open.append(Question(what, ASK_COLUMN, "" if self.table.sizes else cure))


class Choice(Chosen):
    """The columns of a record on a stack that the header of a table names for sure.

    Columns that are misspelled are mistakes. `left` are the other cells.
    """

    def __init__(self, table: Table, request: Request, problems: Problems) -> None:
        super().__init__(table, request, problems)
        self.required, self.left = request.required, list[Cell]()
        if table.headless and not self.wanted:
            self._count()
            return
        self._take_canonical_names()
        if "voltage" not in self.required:  # of a path to follow
            self.left = [replace(c, words=c.words - _COMMANDED) for c in self.left]
        unclear = self._take_other_names()
        self._ask(unclear, self._complain())
        self.sources = {**self.wanted, **self.sources} if self.sources else {}

    def _count(self) -> None:
        """Suggest columns of a table without a header by their numbers."""
        table, required = self.table, self.required
        free = [k for k in range(len(table.header)) if not table.sizes or table.sizes[k] > 1]
        time = next((k for k in free if is_rising(table, k)), None) if "time" in required else None
        rest = iter(k for k in free if k != time)
        places = {name: time if name == "time" else next(rest, None) for name in required}
        self.sources = {n: usual_source(n, str(k + 1)) for n, k in places.items() if k is not None}
        self._ask_header(",".join(COLUMNS[name].example for name in required))

    def _take_canonical_names(self) -> None:
        """Take the cells with the columns' canonical names and units, and those of `--columns`."""
        table, wanted = self.table, self.wanted
        places = {place_of(wanted[name].array, table): name for name in reversed(list(wanted))}
        first = any(plain(label).replace("_", "") == "displacement1" for label in table.labels)
        last = last_name if table.sizes else str
        for index, text in enumerate(table.header):
            requested, (bare, unit) = index in places, name_and_unit(text)
            name = places.get(index, plain(bare))
            open_unit = unit is None and (name in self.required or name == "time")
            second = name == "displacement_2" and first
            if name not in COLUMNS or (not requested and (open_unit or second or name in wanted)):
                self.left.append(_cell_of(last(text), table.labels[index], index))
            elif name in self.fields:
                self._refuse_second(name, index, self.fields[name])
            else:
                place = f"column '{bare if requested else name}'"
                unit = unit or (unit_for(name, last_name(bare)) if requested else None)
                if table.sizes and requested and wanted[name].unit:  # of an array it is often wrong
                    unit = None
                is_unit = unit is not None and unit_named(unit, common=False) is not None
                if not requested and unit and is_unit and not measures(name, unit):
                    source = usual_source(name, table.labels[index], unit)
                    self._ask_scale(name, unit, place, source)
                else:
                    unit = self._agreed_unit(name, unit, f"{table.where}, {place}")
                self.fields[name] = Field(index, unit or "")

    def _take_other_names(self) -> dict[str, list[Cell]]:
        """Take the cells with a laboratory's name for a column, or the unit that only one has.

        A misspelled canonical name is no other column. Returns the cells that may be a
        column by its name.
        """
        absent = [n for n in COLUMNS if n not in self.fields]
        spelled = [c for c in self.left if c.column is not None or not c.misspelled(absent)]
        unclear: dict[str, list[Cell]] = {}
        taken: list[Cell] = []
        for column in [n for n in absent if n not in self.wanted]:
            may_be, is_sure = _decided(column, spelled, by_unit=column in self.required)
            if not may_be or not (is_sure or column in self.required):
                continue
            cell = may_be[0]
            if not is_sure and not (column == "time" and self._is_one_clock(may_be)):
                unclear[column] = may_be
            else:
                if cell.unit is not None and not measures(column, cell.unit):
                    source = usual_source(column, cell.label, cell.hint)
                    self._ask_scale(column, cell.unit, f"column '{cell.text}'", source)
                taken.append(cell)
            self.fields[column] = Field(cell.index, cell.unit or SI_UNITS.get(column, "um"))
        self.left = [cell for cell in self.left if cell not in taken]
        return unclear

    def _complain(self) -> list[str]:
        """Complain of columns misspelled or not there; return the others that are missing."""
        for name, source in self.wanted.items():
            if place_of(source.array, self.table) is None:
                self._refuse_absent(name, source, self._listed(self.fields))
        absent = [name for name in COLUMNS if name not in self.fields]
        near = {c.misspelled(absent): c for c in self.left if c.column is None}
        near.pop("", None)
        for name, cell in near.items():
            self.problems.add(
                f"{self.table.where}: the column '{plain(cell.label)}' is unknown; if '{name}' is"
                f" meant, correct the header to '{COLUMNS[name].example}', else give it a less"
                " similar name."
            )
        return [n for n in absent if n in self.required and n not in {*self.wanted, *near}]

    def _ask(self, unclear: Mapping[str, Sequence[Cell]], missing: Sequence[str]) -> None:
        """Ask for the columns that are unclear or missing, and suggest what they may be."""
        where, in_header, questions = self.table.where, not self.table.sizes, list[Question]()
        if unclear:
            which = ", ".join(
                f"'{name}' {'has no unit' if len(item) == 1 else 'may be more than one column'}"
                f" ({', '.join(cell.text for cell in item)})"
                for name, item in unclear.items()
            )
            examples = ", ".join(f"'{COLUMNS[name].example}'" for name in unclear)
            cure = f"write {examples} in the header" if in_header else ""
            questions.append(Question(f"{where}: {which}", ASK_UNIT, cure))
        listed = self._listed([name for name in self.fields if name not in unclear])
        scales, self.open = self.open, questions
        for name in missing:
            self._ask_column(name, listed, f"add it to the header as '{COLUMNS[name].example}'")
        self.open += scales
        chosen = self._suggested([*unclear, *missing])
        self.sources |= {n: usual_source(n, c.label, c.hint) for n, c in chosen.items()}
        length = chosen.get("displacement")
        if length is not None and length.hint is None:  # a stroke that a stack may have
            cells = as_numbers(self.table.glance[length.index])
            finite = cells[np.isfinite(cells)]
            span = float(np.ptp(finite)) if finite.size else 0.0
            unit = "m" if 1e-9 <= span < 1e-3 else "nm" if span > 3e3 else "um"
            self.sources["displacement"] = Source(length.label, unit)

    def _suggested(self, columns: Collection[str]) -> Mapping[str, Cell]:
        """Return the cell that is most likely each of the columns, for those that one can be.

        None is suggested against its unit, and as the time none that does not rise. The volts of a
        sensor may be a displacement; of several channels one of the voltage's number is it first.
        """
        sizes = [n for n in self.table.sizes if n > 1]
        main = max(sizes, key=lambda n: (sizes.count(n), n), default=0)  # of most arrays
        free = [c for c in self.left if not self.table.sizes or self.table.sizes[c.index] == main]
        free = [c for c in free if c.label and not set(c.label) & _MARKS]
        cells: dict[str, Cell] = {}
        for column in (name for name in COLUMNS if name in columns):
            number = cells["voltage"].channel if "voltage" in cells else ""
            ranks = [
                (rank, column == "displacement" and cell.channel != number, k)
                for k, cell in enumerate(free)
                if cell not in cells.values() and (rank := cell.rank(column)) is not None
                if column != "time" or is_rising(self.table, cell.index)
            ]
            if ranks:
                cells[column] = free[min(ranks)[-1]]
        return cells

    def _ask_scale(self, column: str, unit: str, place: str, source: Source) -> None:
        """Ask what 1 in the file is, where the unit measures something else."""
        what, cure = mismatch(COLUMNS[column], unit)
        self.open.append(Question(f"{self.table.where}, {place}: {what}", _ASK_SCALE, cure))
        self.sources[column] = source

    def _agreed_unit(self, name: str, text: str | None, where: str) -> str:
        """Return the unit that the header or `--columns` gives; the two must not disagree."""
        source = self.wanted.get(name)
        inputs = source.unit if source else None
        if source and source.scale is not None:  # of the header's unit, as a sensor's volts
            return inputs or ""
        unit = text or inputs or (SI_UNITS.get(name) if source else None)
        check_unit(COLUMNS[name], unit, where, self.problems)
        with suppress(InputError):  # an unknown one is reported already
            units = {replace(parse_unit(u), name="", quantity="") for u in (text, inputs) if u}
            if len(units) < 2:
                return unit or ""
            self._refuse_other_unit(where, text, inputs)
        return unit or ""

    def _is_one_clock(self, cells: Sequence[Cell]) -> bool:
        """Whether several clocks with units are the same one, as channels may have one each."""
        first, *others = cells
        glance = self.table.glance
        return first.unit is not None and all(
            cell.unit == first.unit and np.array_equal(glance[first.index], glance[cell.index])
            for cell in others
        )

    def _listed(self, known: Iterable[str]) -> str:
        """Return the columns that are known and the names of the cells that are none."""
        names = [*known, *(cell.label for cell in self.left)]
        return ", ".join(filter(None, names))[:120] or "nothing"


def _cell_of(text: str, label: str, index: int) -> Cell:
    """Return the cell that a text is."""
    name, unit, hint = understood(text), stated_unit(text), stated_unit(text, loosely=True)
    if unit is None and hint and parse_unit(hint).quantity not in QUANTITIES.values():
        hint = None
    return Cell(index, label, text, unit, hint, name.column if name else None, words_of(text))


def _decided(column: str, cells: Sequence[Cell], *, by_unit: bool) -> tuple[list[Cell], bool]:
    """Return the cells that may be a column, and whether the only one of them is it for sure.

    One that has a name of the column and a unit is it; `by_unit` allows the only one whose unit
    measures its quantity, unless its words speak against it or a cell without a unit has words for
    it. A voltage that is called a command is a rival of one with another name.
    """
    named = [c for c in cells if c.column == column]
    quantity = QUANTITIES.get(column, "none") if by_unit else "none"
    by_quantity = [
        c for c in cells
        if c.column is None and c.unit is not None and c.speaks(column) >= 0
        and parse_unit(c.unit).quantity == quantity
    ]  # fmt: skip
    stating = [c for c in named if c.unit is not None]
    stating = [c for c in stating if measures(column, c.unit or "")] or stating
    commanded = [c for c in by_quantity if column == "voltage" and c.words & _COMMANDED]
    if len(stating) == 1 and not commanded:
        return stating, True
    if named:
        return [*named, *by_quantity], False
    others = [c for c in cells if c.column is None and c.hint is None]
    rivals = [c for c in others if c.speaks(column) > 0] if by_quantity else []
    return [*by_quantity, *rivals], len(by_quantity) == 1 and not rivals


def with_usual_units(table: Table) -> Table:
    """Return a table of arrays in which those with a column's canonical name have its SI unit.

    A displacement has none, nor has what states its unit.
    """
    header = list(table.header)
    for k, text in enumerate(header if table.sizes else ()):
        unit = SI_UNITS.get(text.rpartition(".")[2].lower())
        header[k] = f"{text} [{unit}]" if unit else text
    return replace(table, header=header) if table.sizes else table


def is_rising(table: Table, index: int) -> bool:
    """Whether a column is one of instants, or of numbers each of which is larger than the last."""
    cells = table.glance[index]
    times = as_times(cells, "s")
    times = as_numbers(cells, "s") if times is None else times
    if times.size < 2:
        return False
    steps = np.diff(times)
    if evened(times):
        return True
    counts = np.all(steps == 1.0) and times[0] in (0.0, 1.0)  # rows, not seconds
    starts_anew = (steps < 0.0).sum() <= 0.1 * steps.size and np.all(steps != 0.0)
    return bool(starts_anew and not (counts and not stated_unit(table.header[index])))


def plain(name: str) -> str:
    """Return a name as those of columns are written."""
    return re.sub(r"\s+", "_", name.strip().lower())


def place_of(array: str, table: Table) -> int | None:
    """Return the index of the column that `--columns` names: by its name, its text, its number."""
    meant = plain(array)
    for texts in (table.labels, table.header, [last_name(label) for label in table.labels]):
        for k, text in enumerate(texts):
            if plain(text) == meant:
                return k
    k = int(array) - 1 if array.isdecimal() and len(array) < 6 else -1
    return k if 0 <= k < len(table.header) else None


def last_name(label: str) -> str:
    """Return the name of an array without that of its group and its number in a matrix."""
    name = re.split(r"\.(?=[^\W\d])", label)[-1]
    return re.sub(r"(?<=\w\w)\.\d+(?=$| \[)", "", name)


class ByName(Chosen):
    """The columns of a table that are the time and the inputs and outputs of a model.

    Names are compared without case, spaces, underscores and the unit behind them; none is guessed
    from its unit. The unit of a field is "" where the table states none, but that of the time "s".
    """

    def __init__(self, table: Table, request: Request, problems: Problems) -> None:
        super().__init__(table, request, problems)
        self.names, wanted = ("time", *request.names), self.wanted
        fields: dict[str, Field] = {}
        self._take_wanted(fields, wanted)
        self._take_named(fields)
        if "time" not in fields and (time := self._time(fields)) is not None:
            fields["time"] = time
        self.fields = {name: fields[name] for name in self.names if name in fields}
        self.unread = self._others(fields) if len(fields) < len(self.names) else ()
        if time := fields.get("time"):
            check_unit(COLUMNS["time"], time.unit, f"{table.where}, column 'time'", problems)
        for name in [n for n in request.required if n not in fields and n not in wanted]:
            self._ask(name)
        if self.open and table.headless:
            self._ask_header(",".join(self.names))
        self.sources = {**wanted, **self.sources} if self.sources else {}

    def _take_wanted(self, fields: dict[str, Field], wanted: ColumnMap) -> None:
        """Take what `--columns` names; its unit and that of the header must not disagree."""
        for name, source in wanted.items():
            index = place_of(source.array, self.table)
            if index is None:
                self._refuse_absent(name, source, self._listed(fields))
                continue
            stated = stated_unit(self._text(index))
            if stated and source.unit and source.scale is None and stated != source.unit:
                where = f"{self.table.where}, column '{source.array}'"
                self._refuse_other_unit(where, stated, source.unit)
            fields[name] = Field(index, source.unit or stated or self._usual(name))

    def _take_named(self, fields: dict[str, Field]) -> None:
        """Take the cells that have the names of columns, the nearest in form first."""
        requested = set(fields)
        taken = {field.index for field in fields.values()}
        forms = [
            ((rank, text != name), name, index, unit)
            for index in self._cells()
            for rank, (text, unit) in enumerate(names_and_units(self._text(index)))
            for name in self.names
            if _key(text) == _key(name)
        ]
        ranks: dict[str, tuple[int, bool]] = {}
        for rank, name, index, unit in sorted(forms, key=lambda form: form[0]):
            if name in fields and (name in requested or ranks[name] != rank):
                continue
            if name in fields and index not in taken:
                self._refuse_second(name, index, fields[name])
            elif index not in taken:
                fields[name], ranks[name] = Field(index, unit or self._usual(name)), rank
                taken.add(index)

    def _time(self, fields: Mapping[str, Field]) -> Field | None:
        """Return a cell with another name for the time, whose values rise."""
        taken = {field.index for field in fields.values()}
        for index in (k for k in self._cells() if k not in taken):
            meant = understood(self._text(index))
            if meant is not None and meant.column == "time" and is_rising(self.table, index):
                return Field(index, meant.unit or "s")
        return None

    def _ask(self, name: str) -> None:
        """Ask for a column that is missing, and suggest what it may be."""
        free = set(self._cells()) - {f.index for f in self.fields.values()}
        labels = {k: self.table.labels[k] for k in sorted(free) if self.table.labels[k]}
        keys = {_key(label): k for k, label in labels.items()}
        near = [keys[n] for n in difflib.get_close_matches(_key(name), keys, 1, 0.6)]
        if name == "time":
            near = [k for k in labels if is_rising(self.table, k)]
        if near:
            unit = stated_unit(self._text(near[0])) or self._usual(name)
            self.sources[name] = Source(labels[near[0]], unit or None)
        cure = f"add it to the header as '{name}', with its unit behind it in brackets"
        self._ask_column(name, self._listed({}), cure)

    def _cells(self) -> list[int]:
        """Return the columns that may be one of samples."""
        sizes = self.table.sizes
        return [k for k in range(len(self.table.header)) if not sizes or sizes[k] > 1]

    def _text(self, index: int) -> str:
        text = self.table.header[index]
        return last_name(text) if self.table.sizes else text

    def _others(self, known: Mapping[str, Field]) -> tuple[str, ...]:
        others = set(self._cells()) - {field.index for field in known.values()}
        return tuple(filter(None, (self.table.labels[k] for k in sorted(others))))

    def _listed(self, known: Mapping[str, Field]) -> str:
        return ", ".join([*known, *self._others(known)])[:120] or "nothing"

    @staticmethod
    def _usual(name: str) -> str:
        return "s" if name == "time" else ""


def _key(name: str) -> str:
    """Return a name without what names are written with in several ways."""
    return re.sub(r"[\s_-]+", "_", name.strip().strip("\"'").strip().lower())
