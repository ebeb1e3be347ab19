"""The output of a command: results on stdout, progress on stderr, events of a search in a file."""

import json
import math
import re
import sys
import time as clock
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from psa_casadi.common.characters import visible
from psa_casadi.common.errors import InputError

if TYPE_CHECKING:
    from psa_casadi.diagnosis.task import Tried
    from psa_casadi.report.words.tables import Table

Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress and no summary; errors still show.")
]
#: Whether the command that runs prints no progress and no summary.
_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)
set_quiet = _QUIET.set


@dataclass(frozen=True)
class Course:
    """The steps of a work in their order: a name, and a pattern of how its messages begin.

    Nine in ten take no longer than `usual_s` [s], once their models are compiled.
    """

    steps: tuple[tuple[str, str], ...]
    usual_s: float

    def step_of(self, text: str) -> int:
        """Return the number of the step that a message belongs to, from 1; 0 for none."""
        return next((k for k, (_, p) in enumerate(self.steps, 1) if re.match(p, text)), 0)


_BASE = ("starting values", "starting values|what the reference")
_FIT = (
    "the base model",
    "base fit|exchanged|resonances and lags|moments|the model|fitting (from|parts|longer)|fit from",
)
IDENTIFY = Course(
    (_BASE, _FIT, ("what to measure next", "what further"), ("files", "profile|writing")), 20.0
)
DIAGNOSE = Course(
    (
        _BASE,
        _FIT,
        ("screening the effects", "the displacement with|screening|searching again"),
        ("trying causes", "cause |several causes|without |all causes|fitting the [rw]|the same"),
        ("judging", "judging|a free function|a formula"),
        ("files", "comparing|improving|writing|fitting the unnamed"),
    ),
    40.0,
)
PLAIN = Course((), 0.0)


class ProgressLine:
    """The progress of a work in one line, which a terminal draws again and again."""

    def __init__(self, what: str, course: Course) -> None:
        self._what, self._course = what, course
        self._begin, self._step, self._last = clock.monotonic(), 0, ""

    def update(self, text: str) -> None:
        """Take a message of the work; the step never goes back, as parts of a work repeat."""
        self._last = text
        self._step = max(self._step, self._course.step_of(text))

    def first(self) -> str:
        """Return the first line: the work, and its usual duration."""
        return f"{self._what}{self._usual(0.0)} ..."

    def line(self, *, drawn: bool = True) -> str:
        """Return the progress; with the usual duration if the line is `drawn` again and again.

        Lines that stay have it only once the work takes longer, as the first line states it.
        """
        elapsed = clock.monotonic() - self._begin
        parts = [self._what]
        if self._step:
            name, _ = self._course.steps[self._step - 1]
            parts.append(f"step {self._step} of {len(self._course.steps)} ({name})")
        parts.append(_duration(elapsed))
        late = elapsed > self._course.usual_s
        line = ", ".join(parts) + (self._usual(elapsed) if drawn or late else "")
        return f"{line}: {self._last}" if self._last else line

    def _usual(self, elapsed: float) -> str:
        if not self._course.usual_s:
            return ""
        usual = _duration(self._course.usual_s)
        late = elapsed > self._course.usual_s
        return f" (longer than most: {usual})" if late else f" (most take up to {usual})"

    def __rich__(self) -> Text:
        """Return the line as it is now."""
        return Text(self.line())


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min"


@contextmanager
def events_to(path: Path | None) -> Iterator[Callable[["Tried"], None]]:
    """Yield a function that adds a line for a hypothesis to a file at once; to none without one.

    A line holds the fields of `Tried`; a number that is not finite is null. It
    replaces an older file.

    Raises:
        InputError: the file cannot be written to.
    """
    if path is None:
        yield lambda tried: None
        return
    try:
        stream = path.open("w", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot write ({error.strerror}); choose another name.") from None
    with stream:

        def write_event(tried: "Tried") -> None:
            row = {name: _plain(value) for name, value in asdict(tried).items()}
            stream.write(json.dumps(row, allow_nan=False) + "\n")
            stream.flush()

        yield write_event


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
    """Print what a command is for, with --quiet too."""
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
