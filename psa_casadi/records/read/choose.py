"""Which column of a table is which column of a record, in which unit, and what remains open."""

import difflib
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from psa_casadi.errors import InputError, Problems
from psa_casadi.records.read.columns import (
    COLUMNS,
    SI_UNITS,
    ColumnMap,
    Field,
    Source,
    check_unit,
    column_named,
    measures,
    mismatch,
    stated_unit,
    understood,
    unit_for,
    unit_named,
    usual_source,
    words_of,
)
from psa_casadi.records.read.table import Table, as_times, decimal_sign, evened, numbers_in
from psa_casadi.units import parse_unit

#: The quantities that tell the columns which every record has.
QUANTITIES = {"time": "time", "voltage": "voltage", "displacement": "length"}
#: What `--columns` takes for its own marks in a name, where a unit follows.
_MARKS = set(",[]")
_CHANNEL = re.compile(r"\d*$")
#: Words for what is commanded and for what drives, for what is measured, and for neither.
_COMMANDED = {
    "command", "commanded", "cmd", "setpoint", "set", "target", "reference", "ref", "demand",
    "desired", "soll", "sollwert", "drive", "excitation",
}  # fmt: skip
_DRIVING = {"hv", "piezo", "pzt", "amp", "amplifier", "actuator"}
_MEASURED = {
    "measured", "meas", "sense", "sensor", "feedback", "readback", "probe", "gauge", "detector",
    "lvdt", "actual", "ist", "istwert",
}  # fmt: skip
_NEITHER = {
    "mon", "error", "err", "fehler", "offset", "gain", "noise", "rms", "std", "min", "max",
}  # fmt: skip
#: Words for what only says when, and for what only counts.
_MARKING = {
    "trigger", "trig", "sync", "gate", "ttl", "marker", "flag", "enable", "status", "comment",
    "remark", "note", "digital", "dio",
}  # fmt: skip
_COUNTING = {
    "sample", "samples", "index", "idx", "nr", "no", "number", "num", "count", "counter", "point",
    "points", "row", "line", "nummer", "pos",
}  # fmt: skip
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

    label: str
    text: str
    unit: str | None
    hint: str | None
    column: str | None
    words: frozenset[str]

    def speaks(self, column: str) -> int:
        """Return 1 where the words of the name speak for a column, -1 against it, else 0."""
        meant = {column_named(word) for word in self.words} - {None}
        if self.words & _MARKING:
            return -1
        if meant - {column} or self.words & _AGAINST.get(column, set()):
            return -1
        return 1 if meant or self.words & _FOR.get(column, set()) else 0


def cell_of(text: str, label: str | None = None, stated: str | None = None) -> Cell:
    """Return the cell that a text is; `stated` is the unit that a file gives beside the name."""
    name = understood(text)
    unit = stated or stated_unit(text)
    hint = stated_unit(text, loosely=True)
    is_near = hint is not None and parse_unit(hint).quantity in QUANTITIES.values()
    return Cell(
        label=text if label is None else label,
        text=text,
        unit=unit,
        hint=unit or (hint if is_near else None),
        column=None if name is None else name.column,
        words=words_of(text),
    )


def decided(
    column: str, cells: Sequence[Cell], *, by_unit: bool
) -> tuple[int | None, Sequence[int]]:
    """Return the cell that is a column, else None and the cells that may be it.

    One that has a name of the column and a unit is it; `by_unit` allows the only one whose unit
    measures its quantity, unless its words speak against it or a cell without a unit has words for
    it. A voltage that is called a command is a rival of one with another name.
    """
    named = [k for k, cell in enumerate(cells) if cell.column == column]
    alike = [k for k, cell in enumerate(cells) if by_unit and _is_alike(cell, column)]
    stating = [k for k in named if cells[k].unit is not None]
    stating = [k for k in stating if measures(column, cells[k].unit or "")] or stating
    commanded = [k for k in alike if column == "voltage" and cells[k].words & _COMMANDED]
    if len(stating) == 1 and not commanded:
        return stating[0], ()
    if named:
        return None, [*named, *alike]
    others = [k for k, cell in enumerate(cells) if cell.column is None and cell.hint is None]
    rivals = [k for k in others if cells[k].speaks(column) > 0]
    if len(alike) == 1 and not rivals:
        return alike[0], ()
    return None, [*alike, *rivals] if alike else ()


def suggested(
    columns: Collection[str], cells: Sequence[Cell], rises: Callable[[Cell], bool]
) -> Mapping[str, int]:
    """Return the cell that is most likely each of the columns, for those that one can be.

    None is suggested against its unit, and as the time none that does not rise. The volts of a
    sensor may be a displacement; of several channels one of the voltage's number is it first.
    """
    found: dict[str, int] = {}
    number = ""
    for column in (name for name in COLUMNS if name in columns):
        ranks = [
            (rank, column == "displacement" and _channel(cell) != number, k)
            for k, cell in enumerate(cells)
            if cell.label and not set(cell.label) & _MARKS and k not in found.values()
            if (rank := _rank(cell, column)) is not None
            if column != "time" or rises(cell)
        ]
        if ranks:
            found[column] = min(ranks)[-1]
        if column == "voltage" and column in found:
            number = _channel(cells[found[column]])
    return found


def _channel(cell: Cell) -> str:
    """Return the number at the end of a name, "" without one."""
    return _CHANNEL.search(cell.text)[0] if cell.unit is None else ""  # type: ignore[index]


def source_of(column: str, cell: Cell) -> Source:
    """Return a cell as the source of a column, in its own unit or the usual one."""
    return usual_source(column, cell.label, cell.hint)


def _is_alike(cell: Cell, column: str) -> bool:
    """Whether a cell without a name that is known is in a unit of the column's quantity."""
    quantity = QUANTITIES.get(column)
    if cell.column is not None or cell.unit is None or quantity is None:
        return False
    return parse_unit(cell.unit).quantity == quantity and cell.speaks(column) >= 0


def _rank(cell: Cell, column: str) -> int | None:
    """Return how likely a cell is a column, 0 for the most likely; None where it is not."""
    says = cell.speaks(column)
    if cell.column not in (None, column) or (cell.column is None and says < 0):
        return None
    if cell.hint is None or measures(column, cell.hint):
        return 0 if cell.column else (2 if cell.hint else 4) - says
    in_volts = column == "displacement" and measures("voltage", cell.hint)
    return 6 - says if in_volts and not cell.words & _FOR["voltage"] else None


_HEADER = re.compile(r"(?P<name>[^\[\]]*?)\s*(?:\[(?P<unit>[^\[\]]*)\])?")


class Ask(StrEnum):
    """What an option says that is offered for what is open."""

    COLUMN = "say which column it is"
    UNIT = "say which, and in which unit"
    SCALE = "say what 1 in the file is"


@dataclass(frozen=True)
class Question:
    """Something that a table leaves open: what it is, and what to do in the file, if anything."""

    what: str
    ask: Ask
    cure: str = ""


@dataclass(frozen=True)
class Choice:
    """The columns that a table has for sure; what is open, and suggested for it."""

    fields: Mapping[str, Field]
    open: Sequence[Question]
    sources: ColumnMap


def choose(table: Table, required: Sequence[str], wanted: ColumnMap, problems: Problems) -> Choice:
    """Return the columns that the header of a table names.

    `wanted` says which name, or which column counted from 1, stands for which column where the
    header does not use the columns' own names. Added to `problems`: columns misspelled or there
    twice, units that are wrong, names in `wanted` that the table does not have.
    """
    if table.headless and not wanted:
        return _numbered(table, required)
    fields: dict[str, Field] = {}
    strangers: list[int] = []
    wrong: dict[str, Source] = {}
    units: list[Question] = []
    places = {name: _place(source.array, table) for name, source in wanted.items()}
    for index, text in enumerate(table.header):
        match = _HEADER.fullmatch(text.strip())
        own = match["name"].strip() if match else text
        asked = [name for name, place in places.items() if place == index]
        name = asked[0] if asked else plain(own)
        bare = match is not None and match["unit"] is None
        second = name == "displacement_2" and not asked and _has_a_first(table)
        if (
            match is None or name not in COLUMNS or second or (name in wanted and not asked)
            or (bare and not asked and (name in required or name == "time"))
        ):  # fmt: skip
            strangers.append(index)
        elif name in fields:
            problems.add(
                f"{table.where}, column {index + 1}: '{name}' stands twice in the header (first as "
                f"column {fields[name].index + 1}); rename or remove one of the two."
            )
        else:
            place = f"{table.where}, column '{own if asked else name}'"
            stated = match["unit"] or (unit_for(name, _last(own)) if asked else None)
            if table.sizes and asked and wanted[name].unit:  # of an array it is more often wrong
                stated = None
            if asked or stated is None or _is_right(name, stated):
                stated = _agreed_unit(name, stated, wanted.get(name), place, problems)
            else:
                units.append(_of_scale(name, stated, place))
                wrong[name] = usual_source(name, table.labels[index], stated)
            fields[name] = Field(index, stated)
    cells, unclear = _by_other_names(table, strangers, fields, required, wanted, units, wrong)
    for name, source in wanted.items():
        if places[name] is None:
            problems.add(
                f"{table.where}: '{source.array}', which --columns names for '{name}', is not in "
                f"the header (found: {_listed(fields, cells)}); correct --columns."
            )
    missing = _missing(table, cells, fields, required, wanted, problems)
    found = _open(table, cells, unclear, missing, fields, wanted)
    if not units:
        return found
    return Choice(found.fields, [*found.open, *units], {**wanted, **wrong, **found.sources})


def rises(table: Table, index: int) -> bool:
    """Whether a column is one of instants, or of numbers each of which is larger than the last."""
    cells = table.glance[index]
    times = as_times(cells, "s")
    if times is None:
        is_array = isinstance(cells, np.ndarray)
        texts = [] if is_array else [str(cell) for cell in cells]
        sign = decimal_sign(texts)
        times = np.asarray(cells) if is_array else numbers_in(texts, sign, "s").values
    if times.size < 2 or times.dtype.kind not in "biuf":
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


def misspelled(cell: Cell, absent: Sequence[str]) -> str:
    """Return the column whose own name a cell has with a mistake, "" where it has none."""
    cutoff = 0.9 if any(map(column_named, cell.words)) else 0.8
    return next(iter(difflib.get_close_matches(plain(cell.label), absent, n=1, cutoff=cutoff)), "")


def _place(array: str, table: Table) -> int | None:
    """Return the index of the column that `--columns` names: by its name, its text, its number."""
    meant = plain(array)
    for texts in (table.labels, table.header, [_last(label) for label in table.labels]):
        found = [k for k, text in enumerate(texts) if plain(text) == meant]
        if found:
            return found[0]
    k = int(array) - 1 if array.isdecimal() and len(array) < 6 else -1
    return k if 0 <= k < len(table.header) else None


def _last(label: str) -> str:
    """Return the name of an array without that of its group and its number in a matrix."""
    name = re.split(r"\.(?=[^\W\d])", label)[-1]
    return re.sub(r"(?<=\w\w)\.\d+(?=$| \[)", "", name)


def _has_a_first(table: Table) -> bool:
    return any(plain(label).replace("_", "") == "displacement1" for label in table.labels)


def _numbered(table: Table, required: Sequence[str]) -> Choice:
    """Return what can be said of a table without a header: its columns are counted."""
    free = [k for k in range(len(table.header)) if not table.sizes or table.sizes[k] > 1]
    time = next((k for k in free if rises(table, k)), None) if "time" in required else None
    rest = iter(k for k in free if k != time)
    sources: dict[str, Source] = {}
    for name in required:
        k = time if name == "time" else next(rest, None)
        if k is not None:
            sources[name] = usual_source(name, str(k + 1))
    example = ",".join(COLUMNS[name].example for name in required)
    told = f"{table.where}: found '{table.headless[:60]}', expected a header"
    cure = f"write a first line such as '{example}'"
    return Choice({}, [Question(told, Ask.UNIT, cure)], sources)


def _by_other_names(
    table: Table,
    strangers: Sequence[int],
    fields: dict[str, Field],
    required: Sequence[str],
    wanted: ColumnMap,
    units: list[Question],
    wrong: dict[str, Source],
) -> tuple[list[tuple[int, Cell]], dict[str, list[Cell]]]:
    """Add the columns that go by a laboratory's name for them, or by the unit that only one has.

    What has a column's own name keeps it, and what has it misspelled is nothing else. Returns the
    cells that remain, and by the name of a column those that may be it. Units that do not measure
    their column are asked about in `units`, with the sources in `wrong`.
    """
    last = _last if table.sizes else str
    cells = [(k, cell_of(last(table.header[k]), table.labels[k])) for k in strangers]
    absent = [n for n in COLUMNS if n not in fields]
    spelled = [(k, c) for k, c in cells if c.column is not None or not misspelled(c, absent)]
    unclear: dict[str, list[Cell]] = {}
    taken: list[int] = []
    for column in [n for n in absent if n not in wanted]:
        is_required = column in required
        one, several = decided(column, [c for _, c in spelled], by_unit=is_required)
        may_be = [spelled[k] for k in (several if one is None else (one,))]
        if not may_be or (one is None and not is_required):
            continue
        index, cell = may_be[0]
        if one is None and not (column == "time" and _are_equal(table, may_be)):
            unclear[column] = [c for _, c in may_be]
        else:
            if cell.unit is not None and not measures(column, cell.unit):
                units.append(_of_scale(column, cell.unit, f"{table.where}, column '{cell.text}'"))
                wrong[column] = source_of(column, cell)
            taken.append(index)
        fields[column] = Field(index, cell.unit or SI_UNITS.get(column, "um"))
    return [(k, c) for k, c in cells if k not in taken], unclear


def _is_right(column: str, unit: str) -> bool:
    """Whether a unit measures what a column holds, or is none at all, which is told elsewhere."""
    return measures(column, unit) or unit_named(unit, common=False) is None


def _of_scale(column: str, unit: str, where: str) -> Question:
    """Return the question what 1 in the file is, where the unit measures something else."""
    what, cure = mismatch(COLUMNS[column], unit)
    return Question(f"{where}: {what}", Ask.SCALE, cure)


def _are_equal(table: Table, cells: Sequence[tuple[int, Cell]]) -> bool:
    """Whether several clocks with units are the same one, as each channel of a file has its own."""
    (first, one), *others = cells
    return one.unit is not None and all(
        cell.unit == one.unit and np.array_equal(table.glance[first], table.glance[k])
        for k, cell in others
    )


def _missing(
    table: Table,
    cells: Sequence[tuple[int, Cell]],
    fields: Mapping[str, Field],
    required: Sequence[str],
    wanted: ColumnMap,
    problems: Problems,
) -> list[str]:
    """Complain of columns that seem to be misspelled; return the others that are missing."""
    absent = [name for name in COLUMNS if name not in fields]
    unknown = [cell for _, cell in cells if cell.column is None]
    wrong = {near: plain(c.label) for c in unknown if (near := misspelled(c, absent))}
    for name, found in wrong.items():
        problems.add(
            f"{table.where}: the column '{found}' is unknown; if '{name}' is meant, correct "
            f"the header to '{COLUMNS[name].example}', else give it a less similar name."
        )
    needed = [name for name in required if name not in wanted]
    return [name for name in absent if name in needed and name not in wrong]


def _open(
    table: Table,
    cells: Sequence[tuple[int, Cell]],
    unclear: Mapping[str, Sequence[Cell]],
    missing: Sequence[str],
    fields: Mapping[str, Field],
    wanted: ColumnMap,
) -> Choice:
    """Return the choice with what is said of columns that are unclear or missing."""
    told = []
    if unclear:
        which = ", ".join(
            f"'{name}' {'has no unit' if len(own) == 1 else 'may be more than one column'}"
            f" ({', '.join(cell.text for cell in own)})"
            for name, own in unclear.items()
        )
        examples = ", ".join(f"'{COLUMNS[name].example}'" for name in unclear)
        cure = "" if table.sizes else f"write {examples} in the header"
        told.append(Question(f"{table.where}: {which}", Ask.UNIT, cure))
    known = {name: field for name, field in fields.items() if name not in unclear}
    told += [
        Question(
            f"{table.where}: the column '{name}' is missing (found: {_listed(known, cells)})",
            Ask.COLUMN,
            "" if table.sizes else f"add it to the header as '{COLUMNS[name].example}'",
        )
        for name in missing
    ]
    main = _main_size(table)
    free = [(k, c) for k, c in cells if not table.sizes or table.sizes[k] == main]
    index = {id(cell): k for k, cell in free}
    chosen = suggested(
        [*unclear, *missing], [c for _, c in free], lambda c: rises(table, index[id(c)])
    )
    sources = {name: source_of(name, free[k][1]) for name, k in chosen.items()}
    length = chosen.get("displacement")
    if length is not None and free[length][1].hint is None:
        usual = sources["displacement"].array
        sources["displacement"] = Source(usual, _usual_length(table, free[length][0]))
    return Choice(fields, told, {**wanted, **sources} if sources else {})


def _usual_length(table: Table, index: int) -> str:
    """Return the unit in which numbers are a stroke that a stack may have: 1 nm to 1 mm."""
    cells = table.glance[index]
    if not isinstance(cells, np.ndarray):
        cells = numbers_in(cells, decimal_sign(cells), "").values
    finite = cells[np.isfinite(cells)] if cells.dtype.kind in "biuf" else np.zeros(0)
    span = float(np.ptp(finite)) if finite.size else 0.0
    return "m" if 1e-9 <= span < 1e-3 else "nm" if span > 3e3 else "um"


def _main_size(table: Table) -> int:
    """Return the length of most of the arrays, of the longest where none is more frequent."""
    sizes = [n for n in table.sizes if n > 1]
    return max(sizes, key=lambda n: (sizes.count(n), n), default=0)


def _agreed_unit(
    name: str, own: str | None, source: Source | None, where: str, problems: Problems
) -> str:
    """Return the unit that the header or `--columns` gives; the two must not disagree."""
    given = source.unit if source else None
    if source and source.scale is not None:  # of the header's unit, as a sensor's volts
        return given or ""
    unit = own or given or (SI_UNITS.get(name) if source else None)
    check_unit(COLUMNS[name], unit, where, problems)
    if own and given and not _same_unit(own, given):
        problems.add(
            f"{where}: the header gives the unit '{own}', --columns gives '{given}'; leave the one "
            f"in --columns out, or say there what 1 in the file is, such as 10{given}."
        )
    return unit or ""


def _same_unit(one: str, other: str) -> bool:
    try:
        first, second = parse_unit(one), parse_unit(other)
    except InputError:
        return True  # the unknown one was told already
    return (first.dimension, first.ratio, first.offset) == (
        second.dimension, second.ratio, second.offset,
    )  # fmt: skip


def _listed(fields: Mapping[str, Field], left: Sequence[tuple[int, Cell]]) -> str:
    """Return the columns that are known and the names of the cells that are none."""
    names = [*fields, *(cell.label for _, cell in left)]
    return ", ".join(filter(None, names))[:120] or "nothing"
