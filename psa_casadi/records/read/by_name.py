"""Which column of a table is which input or output of a model, by its name, in which unit."""

import difflib
import re
from collections.abc import Mapping, Sequence

from psa_casadi.errors import Problems
from psa_casadi.records.read.choose import (
    ASK_COLUMN,
    ASK_UNIT,
    Question,
    last_name,
    place_of,
    rises,
)
from psa_casadi.records.read.columns import (
    ColumnMap,
    Field,
    Source,
    check_unit,
    names_and_units,
    stated_unit,
    understood,
)
from psa_casadi.records.read.table import Table
from psa_casadi.records.record import COLUMNS


class ByName:
    """The columns of a table that are the time and the inputs and outputs of a model: `fields`.

    A name is found whatever its case, its spaces and underscores, and the unit behind it; none is
    guessed from its unit. `names` are the model's, `required` what must be there.
    The unit of a field is "" where the table states none, but that of the time "s". `open`,
    `sources`, `wanted` and `problems` are those of `Choice`.
    """

    def __init__(
        self,
        table: Table,
        names: Sequence[str],
        required: Sequence[str],
        wanted: ColumnMap,
        problems: Problems,
    ) -> None:
        self.table, self.names, self.problems = table, ("time", *names), problems
        self.open, self.sources = list[Question](), dict[str, Source]()
        found: dict[str, Field] = {}
        self._take_asked(found, wanted)
        self._take_named(found)
        if "time" not in found and (time := self._time(found)) is not None:
            found["time"] = time
        self.fields = {name: found[name] for name in self.names if name in found}
        if "time" in found:
            where = f"{table.where}, column 'time'"
            check_unit(COLUMNS["time"], found["time"].unit, where, problems)
        for name in [n for n in required if n not in found and n not in wanted]:
            self._ask(name)
        if self.open and table.headless:
            example = ",".join(self.names)
            told = f"{table.where}: found '{table.headless[:60]}', expected a header"
            self.open = [Question(told, ASK_UNIT, f"write a first line such as '{example}'")]
        self.sources = {**wanted, **self.sources} if self.sources else {}

    def _take_asked(self, found: dict[str, Field], wanted: ColumnMap) -> None:
        """Take what `--columns` names; its unit and that of the header must not disagree."""
        for name, source in wanted.items():
            index = place_of(source.array, self.table)
            if index is None:
                self.problems.add(
                    f"{self.table.where}: '{source.array}', which --columns names for '{name}', is"
                    f" not in the header (found: {self._listed(found)}); correct --columns."
                )
                continue
            stated = stated_unit(self._text(index))
            if stated and source.unit and source.scale is None and stated != source.unit:
                self.problems.add(
                    f"{self.table.where}, column '{source.array}': the header gives the unit"
                    f" '{stated}', --columns gives '{source.unit}'; leave the one in --columns out,"
                    f" or say there what 1 in the file is, such as 10{source.unit}."
                )
            found[name] = Field(index, source.unit or stated or self._usual(name))

    def _take_named(self, found: dict[str, Field]) -> None:
        """Take the cells that have the names of columns, the nearest in form first."""
        asked = set(found)
        taken = {field.index for field in found.values()}
        forms = [
            (rank, text != name, name, index, unit)
            for index in self._cells()
            for rank, (text, unit) in enumerate(names_and_units(self._text(index)))
            for name in self.names
            if _key(text) == _key(name)
        ]
        ranks: dict[str, tuple[int, bool]] = {}
        for rank, other_case, name, index, unit in sorted(forms, key=lambda form: form[:2]):
            if name in found and (name in asked or ranks[name] != (rank, other_case)):
                continue
            if name in found and index not in taken:
                self.problems.add(
                    f"{self.table.where}, column {index + 1}: '{name}' stands twice in the header"
                    f" (first as column {found[name].index + 1}); rename or remove one of the two."
                )
            elif index not in taken:
                found[name], ranks[name] = (
                    Field(index, unit or self._usual(name)),
                    (rank, other_case),
                )
                taken.add(index)

    def _time(self, found: Mapping[str, Field]) -> Field | None:
        """Return a cell with another name for the time, whose values rise."""
        taken = {field.index for field in found.values()}
        for index in self._cells():
            meant = understood(self._text(index)) if index not in taken else None
            if meant is not None and meant.column == "time" and rises(self.table, index):
                return Field(index, meant.unit or "s")
        return None

    def _ask(self, name: str) -> None:
        """Ask for a column that is missing, and suggest what it may be."""
        free = set(self._cells()) - {f.index for f in self.fields.values()}
        labels = {k: self.table.labels[k] for k in sorted(free) if self.table.labels[k]}
        keys = {_key(label): k for k, label in labels.items()}
        near = [keys[n] for n in difflib.get_close_matches(_key(name), keys, 1, 0.6)]
        if name == "time":
            near = [k for k in labels if rises(self.table, k)]
        if near:
            unit = stated_unit(self._text(near[0])) or self._usual(name)
            self.sources[name] = Source(labels[near[0]], unit or None)
        what = f"{self.table.where}: the column '{name}' is missing (found: {self._listed({})})"
        cure = f"add it to the header as '{name}', with its unit behind it in brackets"
        self.open.append(Question(what, ASK_COLUMN, "" if self.table.sizes else cure))

    def _cells(self) -> list[int]:
        """Return the columns that may be one of samples."""
        sizes = self.table.sizes
        return [k for k in range(len(self.table.header)) if not sizes or sizes[k] > 1]

    def _text(self, index: int) -> str:
        text = self.table.header[index]
        return last_name(text) if self.table.sizes else text

    def _listed(self, known: Mapping[str, Field]) -> str:
        others = set(self._cells()) - {field.index for field in known.values()}
        labels = [self.table.labels[k] for k in sorted(others)]
        return ", ".join(filter(None, [*known, *labels]))[:120] or "nothing"

    @staticmethod
    def _usual(name: str) -> str:
        return "s" if name == "time" else ""


def _key(name: str) -> str:
    """Return a name without what names are written with in several ways."""
    return re.sub(r"[\s_-]+", "_", name.strip().strip("\"'").strip().lower())
