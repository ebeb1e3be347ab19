"""What a command shows: results on stdout, progress on stderr."""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from psa_casadi.characters import visible
from psa_casadi.cli.steps import PLAIN, Course, Told

if TYPE_CHECKING:
    from psa_casadi.report.words.tables import Table

Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress and no summary; errors still show.")
]


def width() -> int:
    """Return the columns to write in: the terminal's up to 110, or 80 where there is none."""
    return min(110, Console().width) if sys.stdout.isatty() else 80


@contextmanager
def working(what: str, quiet: bool, course: Course = PLAIN) -> Iterator[Callable[[str], None]]:
    """Yield a function that tells a step of long work: by a spinner, or lines off a terminal.

    Both tell the time so far, and the step of how many where the `course` of the work is known.
    """
    output = Told(what, course)
    if quiet:
        yield lambda step: None
    elif sys.stderr.isatty():
        with Console(stderr=True).status(output):
            yield output.tell
    else:
        tell(output.first())

        def next_step(step: str) -> None:
            output.tell(step)
            tell(f"  {output.line(drawn=False)}")

        yield next_step


def show(text: str, quiet: bool = False) -> None:
    """Print a result, with what a terminal would obey spelled out."""
    if not quiet:
        typer.echo(visible(text))


def tell(text: str) -> None:
    """Print a message on stderr, with what a terminal would obey spelled out."""
    typer.echo(visible(text), err=True)


def show_table(table: "Table", quiet: bool = False) -> None:
    """Print a table: drawn on a terminal, in plain columns elsewhere."""
    if quiet:
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


def show_results(sentences: Iterable[str], tables: Iterable["Table"], quiet: bool) -> None:
    """Print sentences, then tables, each behind an empty line."""
    for sentence in sentences:
        show(sentence, quiet)
    for table in tables:
        show("", quiet)
        show_table(table, quiet)


def tell_written(*paths: object, quiet: bool = False) -> None:
    """Name the files that were written."""
    named = [str(p) for p in paths if p is not None]
    if named:
        show(f"\nwritten: {', '.join(named)}", quiet)
