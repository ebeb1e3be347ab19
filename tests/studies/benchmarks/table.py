"""What the benchmarks share: their table by name, the tables that they give, work side by side."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from typing import Any, TypeVar

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from psa_casadi.report.words.tables import Table

T = TypeVar("T")
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

    tables: Sequence[TitledTable]
    picture: Callable[[], Figure] | None = None


def table_of(
    title: str, items: Iterable[T], columns: Mapping[str, Callable[[T], str]], note: str = ""
) -> TitledTable:
    """Return a table with a row for each item, and columns by head and by what a cell shows."""
    rows = tuple(tuple(cell(item) for cell in columns.values()) for item in items)
    return TitledTable(title, Table(tuple(columns), rows), note)


def on_all_cores(
    function: Callable[..., T],
    jobs: Iterable[tuple[Any, ...]],
    tell: Callable[[T], str],
    progress: Progress,
) -> list[T]:
    """Return function(*job) of every job, in their order, worked on side by side on all cores.

    `tell` says in words what one has given.
    """
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        futures = [pool.submit(function, *job) for job in jobs]
        for k, future in enumerate(as_completed(futures), 1):
            progress(f"{k} of {len(futures)}: {tell(future.result())}")
    return [future.result() for future in futures]


def share(count: int, of: int) -> str:
    """Return a count of cases as percent, with both numbers."""
    return f"{100.0 * count / of:.0f} % ({count} of {of})" if of else "no case"


_TABLE = """
identify identification against scipy's least_squares with solve_ivp, and how it grows
fits exact steps against the stepper: error against time, lanes, effects, whole diagnoses
ensembles many sets of parameters beside LSODA, CVODES and diffrax at equal error (--size)
batch many devices with hidden defects: which are told, cost, a run again (--size)
web models in pages: sizes, redraw times in a headless browser, errors
coverage identified parameters and their intervals against the truth, over stacks (--size)
causes hidden causes as a data set for other methods: write, answer, table
posterior whole posteriors: calibration (--size), and evidence by bridge sampling
sampling effective samples per second beside an ODE in PyMC, on one posterior (--size)
own_model models that are no stacks: hidden causes, errors before and after, and a page
paper the paper's identification beside the prediction-error fit, against noise and window
measured the measured micromanipulator: held-out error of the paper's model and of two effects
floors measured records: held-out error of a diagnosis beside the floor of each (--folder)
mirror models of one axis of the steering mirror by its authors' score (--folder)
diagnose hidden causes on independent plants: what is named, how surely, and how often rightly
exam plants of another author: six kinds of hysteresis, causes in other forms, with marks
exam_constants hard records of the exam with each deciding constant halved and doubled
ablation the diagnosis without each of its steps, and with each deciding constant moved
stability the diagnosis of data changed by 1 % of their noise: verdicts and names that stay
added an effect of an independent plant added to a measured record: what is named on top
excerpts pieces of measured records, decimated, scaled, turned round: none may crash
method the picture of docs/method.md: the hypotheses of one search, and its error budget
simulated the package's own simulations, where nothing is missing: whether that is what is said
verification the paper's figures 6 to 10 (loops, steps, other voltages), and three mechanics
fmu error against work: the FMU's solver beside CVode, Radau, LSODA; cost of a fixed step
coupling a positioner of FMUs against one model: error over communication step, stability
nonlinearity a positioner's nonlinearity: open and closed loop, with and without the compensator
design designed inputs: causes told apart, paths followed, hysteresis compensated
fuzz damaged files, hostile FMUs, kills, odd surroundings: none may fail (fuzz --help)
"""
#: What each benchmark shows, by the name of its module, which is loaded when it is run:
#: `run(progress, quick)` measures everything again, `quick` on fewer or smaller cases;
#: `run_on(progress, folder)`, where it has one, the records of a folder instead, and
#: `run_sized(progress, count)` so many cases.
BENCHES: dict[str, str] = dict(line.split(" ", 1) for line in _TABLE.strip().splitlines())


def offers(name: str, run: str) -> Any:
    """Return `run`, `run_on` or `run_sized` of a benchmark, None where it has none."""
    return getattr(import_module(f"tests.studies.benchmarks.{name}"), run, None)


def styled(axes: Axes, x: str = "", y: str = "", title: str = "", *, size: float = 10.5) -> None:
    """Give axes labels and a title, a light grid below the curves, and small numbers."""
    axes.set_xlabel(x, fontsize=size)
    axes.set_ylabel(y, fontsize=size)
    axes.set_title(title, loc="left", fontsize=size)
    axes.grid(visible=True, which="major", color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=size - 2)
