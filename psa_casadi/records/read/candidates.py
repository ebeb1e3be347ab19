"""Which cell of a header, or array of a file, can be which column: by its name and its unit.

A wrong guess is worse than a question: what only one can be is taken, all else is suggested.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.records.read.columns import (
    COLUMNS,
    Source,
    column_named,
    measures,
    stated_unit,
    understood,
    usual_source,
    words_of,
)
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
