"""What a command shows: results on stdout, progress on stderr."""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from psa_casadi.characters import visible
from psa_casadi.cli.steps import PLAIN, Course, ProgressLine

if TYPE_CHECKING:
    from psa_casadi.report.words.tables import Table

Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress and no summary; errors still show.")
]
#: Whether the command that runs prints no progress and no summary.
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
set_quiet = _QUIET.set


def width() -> int:
    """Return the columns to write in: the terminal's up to 110, or 80 where there is none."""
    return min(110, Console().width) if sys.stdout.isatty() else 80


@contextmanager
def working(what: str, course: Course = PLAIN) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows a step of long work: by a spinner, or lines off a terminal.

    Both show the elapsed time, and the number of the step if the `course` of the work is known.
    """
    progress = ProgressLine(what, course)
    if _QUIET.get():
        yield lambda step: None
    elif sys.stderr.isatty():
        with Console(stderr=True).status(progress):
            yield progress.update
    else:
        print_message(progress.first())

        def next_step(step: str) -> None:
            progress.update(step)
            print_message(f"  {progress.line(drawn=False)}")

        yield next_step


def show(text: str) -> None:
    """Print a result unless the command is quiet, with control characters spelled out."""
    if not _QUIET.get():
        show_always(text)


def show_always(text: str) -> None:
    """Print what a command is asked for, also by --quiet."""
    typer.echo(visible(text))


def print_message(text: str) -> None:
    """Print a message on stderr, with control characters spelled out."""
    typer.echo(visible(text), err=True)


def show_table(table: "Table") -> None:
    """Print a table: drawn on a terminal, in plain columns elsewhere."""
    if _QUIET.get():
        return
    table = replace(table, rows=tuple(tuple(map(visible, row)) for row in table.rows))
    if not sys.stdout.isatty():
        show(table.fitted(width()))
        return
    console, drawn = Console(), RichTable(show_edge=False)
    table = table.laid_out(console.width - 2, between=3)
    # two spaces in a column, a line between two of them
    widths = table.widths(console.width - 3 * len(table.head) + 1)
    for name, column in zip(table.head, widths, strict=True):
        drawn.add_column(name, overflow="fold", width=column)
    styles = {"FAIL": "bold red", "pass": "green"}
    for row in table.rows:
        drawn.add_row(*(Text(cell, style=styles.get(cell, "")) for cell in row))
    console.print(drawn)


def show_results(sentences: Iterable[str], tables: Iterable["Table"]) -> None:
    """Print sentences, then tables, each behind an empty line."""
    for sentence in sentences:
        show(sentence)
    for table in tables:
        show("")
        show_table(table)


def show_written(*paths: object) -> None:
    """Name the files that were written."""
    named = [str(p) for p in paths if p is not None]
    if named:
        show(f"\nwritten: {', '.join(named)}")
