"""What a header leaves open: columns that are absent, misspelled or unclear, and what to type."""

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.errors import Problems
from psa_casadi.records.read.candidates import Cell, source_of, suggested
from psa_casadi.records.read.columns import COLUMNS, ColumnMap, Field, ready_line


@dataclass(frozen=True)
class Others:
    """The cells of a header that have no column's own name.

    `left` are those that no column was found for; of them `unclear` has, by the name of a column,
    those that may be it: several, or one without a unit.
    """

    left: Sequence[Cell]
    unclear: Mapping[str, Sequence[Cell]]


def report_absent(
    fields: Mapping[str, Field],
    left: Sequence[Cell],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> None:
    """Complain of names in `wanted` that the header does not have."""
    for name, source in wanted.items():
        if name not in fields:
            problems.add(
                f"{where}: '{source.array}', which --columns names for '{name}', is not in the "
                f"header (found: {_listed(fields, left)}); correct --columns."
            )


def missing_columns(
    fields: Mapping[str, Field],
    left: Sequence[Cell],
    required: Sequence[str],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> list[str]:
    """Complain of columns that seem to be misspelled; return the others that are missing."""
    absent = [name for name in COLUMNS if name not in fields]
    unknown = [cell for cell in left if cell.column is None]
    wrong = {near: plain(c.label) for c in unknown if (near := misspelled(c, absent))}
    for name, found in wrong.items():
        problems.add(
            f"{where}: the column '{found}' is unknown; if '{name}' is meant, correct "
            f"the header to '{COLUMNS[name].example}', else give it a less similar name."
        )
    needed = [name for name in required if name not in wanted]
    return [name for name in absent if name in needed and name not in wrong]


def report_open(
    others: Others,
    missing: Sequence[str],
    fields: Mapping[str, Field],
    wanted: ColumnMap,
    where: str,
    problems: Problems,
) -> ColumnMap:
    """Tell of columns that are unclear or missing; return what is suggested for them.

    The option for all of them stands at the end.
    """
    told, unclear = [], others.unclear
    if unclear:
        which = ", ".join(
            f"'{name}' {'has no unit' if len(own) == 1 else 'may be more than one column'}"
            f" ({', '.join(cell.text for cell in own)})"
            for name, own in unclear.items()
        )
        examples = ", ".join(f"'{COLUMNS[name].example}'" for name in unclear)
        told.append(f"{where}: {which}; write {examples} in the header")
    known = {name: field for name, field in fields.items() if name not in unclear}
    told += [
        f"{where}: the column '{name}' is missing (found: {_listed(known, others.left)}); add it "
        f"to the header as '{COLUMNS[name].example}'"
        f"{' (or give --sample-time)' if name == 'time' else ''}"
        for name in missing
    ]
    chosen = suggested([*unclear, *missing], others.left)
    if not chosen.keys() >= set(missing):
        chosen = suggested(list(unclear), others.left)
    sources = {name: source_of(name, others.left[k]) for name, k in chosen.items()}
    if sources:
        how = "say which column it is" if missing else "say which, and in which unit"
        told[-1] += f", or {how}: {ready_line({**wanted, **sources})}"
    for sentence in told:
        problems.add(f"{sentence}.")
    return sources


def misspelled(cell: Cell, absent: Sequence[str]) -> str:
    """Return the column whose own name a cell has with a mistake, "" where it has none."""
    return next(iter(difflib.get_close_matches(plain(cell.label), absent, n=1, cutoff=0.8)), "")


def plain(name: str) -> str:
    """Return a name as those of columns are written."""
    return re.sub(r"\s+", "_", name.strip().lower())


def _listed(fields: Mapping[str, Field], left: Sequence[Cell]) -> str:
    """Return the columns that are known and the names of the cells that are none."""
    return ", ".join(filter(None, [*fields, *(cell.label for cell in left)]))[:120] or "nothing"
