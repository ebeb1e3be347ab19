"""What a command shows: results on stdout, progress on stderr."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from psa_casadi.characters import visible
from psa_casadi.cli.completion import names
from psa_casadi.cli.steps import PLAIN, Course, Told

if TYPE_CHECKING:
    from psa_casadi.model.compose import Model
    from psa_casadi.report.words.tables import Table

Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress and no summary; errors still show.")
]

ModelOption = Annotated[
    Path | None,
    typer.Option(
        "--model", help="MODEL.json, as `psa identify`, `psa diagnose` and `psa design` write it."
    ),
]

StartModelOption = Annotated[
    Path | None, typer.Option("--model", help="MODEL.json whose values the fits start from.")
]

StackOption = Annotated[
    str | None,
    typer.Option(
        "--stack",
        help="Named stack in place of a model; `psa stacks` lists them.",
        autocompletion=names("stacks"),
    ),
]

PartOption = Annotated[
    str | None,
    typer.Option(
        "--part",
        help="Part around a stack, in place of a model: flexure_stage,"
        " position_controller, hysteresis_compensator, voltage_amplifier, charge_amplifier.",
        autocompletion=names("parts"),
    ),
]

EffectsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--effects",
        help="Module that holds effects of your own, as in mypackage.effects; repeat the option for"
        " several.",
    ),
]

ColumnsOption = Annotated[
    str | None,
    typer.Option(
        "--columns",
        help="Which array of the file is which column, if the names differ:"
        " time=t:ms,voltage=log.u,displacement=m.2:um. A number says what 1 in the file is:"
        " displacement=CH2:10um. FILE@NAME says it of one file: b.csv@time=t:ms; table=2 takes one"
        " of several tables in a file, table=all each as a record.",
    ),
]

StillOption = Annotated[
    bool,
    typer.Option(
        "--still", help="Page without the model that runs in it: nothing is compiled for it."
    ),
]

SampleTimeOption = Annotated[
    float | None,
    typer.Option("--sample-time", help="Time from sample to sample [s]; it goes before a file's."),
]


class Form(StrEnum):
    """Forms of the base's hysteresis."""

    BOUC_WEN = "bouc-wen"
    SPECTRUM = "spectrum"
    BEST = "best"


HysteresisOption = Annotated[
    Form | None,
    typer.Option(
        "--hysteresis",
        help="Form of the base's hysteresis; best is the one that the records prefer. By default"
        " Bouc-Wen, or as the model has it.",
        show_default=False,
    ),
]

HistoryOption = Annotated[
    str | None,
    typer.Option(
        "--history",
        help="Earlier voltages [V], swept in turn from a relaxed 0 V, such as 120,0,120.",
    ),
]

SweepOption = Annotated[
    float,
    typer.Option(
        "--sweep",
        help="Duration of each sweep of the history [s]; it matters to delta and creep.",
    ),
]

RestOption = Annotated[float, typer.Option("--rest", help="Rest after the history [s].")]

StartVoltageOption = Annotated[
    float | None,
    typer.Option(
        "--start-voltage",
        help="Voltage [V] that holds the stack when it starts, settled, with the memory that"
        " --history leaves; by default it starts relaxed at 0 V.",
    ),
]


AuthorOption = Annotated[
    str | None, typer.Option("--author", help="Author to state; by default the model file's.")
]

ModelVersionOption = Annotated[
    str | None,
    typer.Option("--version", help="Version of the model to state; by default the model file's."),
]

CopyrightOption = Annotated[
    str | None,
    typer.Option("--copyright", help="Copyright of the model; by default the model file's."),
]

LicenseOption = Annotated[
    str | None,
    typer.Option(
        "--license",
        help="Licence of the model; by default the model file's. The C code stays BSD 3-Clause.",
    ),
]


class Origin(StrEnum):
    """What the records are."""

    MEASURED = "measured"
    SYNTHETIC = "synthetic"


OriginOption = Annotated[
    Origin, typer.Option("--origin", help="What the report calls the records.")
]


def width() -> int:
    """Return the columns to write in: the terminal's up to 110, or 80 where there is none."""
    return min(110, Console().width) if sys.stdout.isatty() else 80


@contextmanager
def working(what: str, quiet: bool, course: Course = PLAIN) -> Iterator[Callable[[str], None]]:
    """Yield a function that tells a step of long work: by a spinner, or lines off a terminal.

    Both tell the time so far, and the step of how many where the `course` of the work is known.
    """
    told = Told(what, course)
    if quiet:
        yield lambda step: None
    elif sys.stderr.isatty():
        with Console(stderr=True).status(told):
            yield told.tell
    else:
        tell(told.first())

        def next_step(step: str) -> None:
            told.tell(step)
            tell(f"  {told.line(drawn=False)}")

        yield next_step


def show(text: str, quiet: bool = False) -> None:
    """Print a result, with what a terminal would obey spelled out."""
    if not quiet:
        typer.echo(visible(text))


def show_inside(model: "Model", *, include_sensor: bool, quiet: bool) -> "Model":
    """Print which components an export holds, and which it leaves out; return what it holds."""
    kept = model if include_sensor else model.plant()
    show(f"inside: {', '.join(c.name for c in kept.components)}", quiet)
    left_out = [c.name for c in model.components if c not in kept.components]
    if left_out:
        show(f"left out: {', '.join(left_out)} (--include-sensor keeps them)", quiet)
    return kept


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
    # two spaces in a column, a line between two of them
    widths = table.widths(console.width - 3 * len(table.head) + 1)
    for name, column in zip(table.head, widths, strict=True):
        drawn.add_column(name, overflow="fold", width=column)
    styles = {"FAIL": "bold red", "pass": "green"}
    for row in table.rows:
        drawn.add_row(*(Text(cell, style=styles.get(cell, "")) for cell in row))
    console.print(drawn)


def tell_written(*paths: object, quiet: bool = False) -> None:
    """Name the files that were written."""
    named = [str(p) for p in paths if p is not None]
    if named:
        show(f"\nwritten: {', '.join(named)}", quiet)
