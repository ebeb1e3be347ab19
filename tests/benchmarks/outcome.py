"""What a benchmark gives: tables of text, and a picture where one says more."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from psa_casadi.report.words.tables import Table

#: Tells a step of long work.
Progress = Callable[[str], None]


@dataclass(frozen=True)
class TitledTable:
    """A table under a title, with a note on how to read it."""

    title: str
    table: Table
    note: str = ""

    def __str__(self) -> str:
        """Return title, table and note as plain text."""
        parts = [self.title, str(self.table)]
        return "\n\n".join([*parts, self.note] if self.note else parts)


@dataclass(frozen=True)
class Outcome:
    """The tables of one benchmark, and the picture that shows them, if there is one."""

    tables: tuple[TitledTable, ...]
    picture: Callable[[], Figure] | None = None


@dataclass(frozen=True)
class Bench:
    """A benchmark by name: what it shows, how long it takes, and the function that runs it.

    `run(progress, quick)` measures everything again; `quick` does the same on fewer or smaller
    cases. `run_on(progress, folder)`, where there is one, measures the records of a folder instead,
    `run_sized(progress, count)` so many cases.
    """

    name: str
    description: str
    run: Callable[[Progress, bool], Outcome]
    run_on: Callable[[Progress, Path], Outcome] | None = None
    run_sized: Callable[[Progress, int], Outcome] | None = None


def share(count: int, of: int) -> str:
    """Return a count of cases as percent, with both numbers."""
    return f"{100.0 * count / of:.0f} % ({count} of {of})" if of else "no case"
