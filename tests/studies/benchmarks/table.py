"""What the benchmarks share: their names, the tables that they give, work side by side, times."""

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from math import inf
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from psa_casadi.report.words.tables import Table

T = TypeVar("T")
FloatArray = npt.NDArray[np.float64]
#: Tells a step of long work.
Progress = Callable[[str], None]
#: One row of a table: what stands in each column, by the column's head.
Row = Mapping[str, object]


@dataclass(frozen=True)
class TitledTable:
    """Rows under a title, with a note on how to read them."""

    title: str
    rows: Sequence[Row]
    note: str = ""

    @property
    def table(self) -> Table:
        """The rows as text under the heads of the first."""
        head = tuple(self.rows[0]) if self.rows else ()
        return Table(head, tuple(tuple(map(str, row.values())) for row in self.rows))

    def __str__(self) -> str:
        """Return title, table and note as plain text."""
        return "\n\n".join(filter(None, (self.title, str(self.table), self.note)))


@dataclass(frozen=True)
class Outcome:
    """The tables of one benchmark, and the picture that shows them, if there is one."""

    tables: Sequence[TitledTable]
    picture: Callable[[], Figure] | None = None


def on_all_cores(
    function: Callable[..., T],
    jobs: Iterable[tuple[Any, ...]],
    progress: Progress,
    tell: Callable[[T], str] = str,
    workers: int | None = None,
) -> list[T]:
    """Return function(*job) of every job, in their order, worked on side by side.

    `tell` says in words what one has given.
    """
    with ProcessPoolExecutor(workers or os.cpu_count(), get_context("spawn")) as pool:
        futures = [pool.submit(function, *job) for job in jobs]
        for k, future in enumerate(as_completed(futures), 1):
            progress(f"{k} of {len(futures)}: {tell(future.result())}")
    return [future.result() for future in futures]


def share(holds: Iterable[bool]) -> str:
    """Return in how many cases something holds, as percent and with both numbers."""
    cases = list(holds)
    count, of = sum(cases), len(cases)
    return f"{100.0 * count / of:.0f} % ({count} of {of})" if of else "no case"


def least_times(
    works: Sequence[Callable[[], object]], repeats: int, slow: float = inf
) -> list[tuple[float, float]]:
    """Return the least wall and processor time [s] of each work, taken in turns.

    A work that took more than `slow` of processor time is not repeated.
    """
    least = np.full((len(works), 2), inf)
    for turn in range(repeats):
        for k, work in enumerate(works):
            if turn and least[k, 1] > slow:
                continue
            wall, spent = time.perf_counter(), time.process_time()
            work()
            now = time.perf_counter() - wall, time.process_time() - spent
            least[k] = np.minimum(least[k], now)
    return [(float(wall), float(spent)) for wall, spent in least]


#: Each benchmark's name, the module of its function (`run`, else the one named behind a colon) and
#: what it shows. The module is loaded when it is run: `run(progress, quick)` measures everything
#: again, `quick` on fewer or smaller cases; some also take a `size`, the number of cases, or a
#: `folder` of records.
_TABLE = """
identify|peers:identify|identification against scipy's least_squares with solve_ivp, and its growth
fits|fits|exact steps against the stepper: error against time, lanes, effects, whole diagnoses
ensembles|peers:ensembles|many sets beside LSODA, CVODES, diffrax at equal error (--size)
batch|batch|many devices with hidden defects: which are told, cost, a run again (--size)
web|pages:web|models in pages: sizes, redraw times in a headless browser, errors
coverage|coverage|identified parameters, their intervals against the truth, over stacks (--size)
causes|causes|hidden causes as a data set for other methods: write, answer, table
posterior|posterior|whole posteriors: calibration (--size), and evidence by bridge sampling
sampling|sampling|effective samples per second beside an ODE in PyMC, on one posterior (--size)
own_model|pages:own_model|models that are no stacks: hidden causes, errors before and after, a page
paper|paper|the paper's identification beside the prediction-error fit, against noise
measured|measured|the micromanipulator: held-out error of the paper's model and of two effects
floors|floors|measured records: held-out error of a diagnosis beside each one's floor (--folder)
mirror|mirror|models of one axis of the steering mirror by its authors' score (--folder)
diagnose|diagnose|hidden causes on independent plants: what is named, how surely, how often rightly
exam|exam|plants of another author: six kinds of hysteresis, causes in other forms, with marks
exam_constants|exam:constants|hard records of the exam with each constant halved and doubled
ablation|ablation|the diagnosis without each of its steps, and with each deciding constant moved
stability|changed:stability|the diagnosis of data changed by 1 % of their noise: what stays
added|changed:added|an effect of a plant added to a measured record: what is named on top
excerpts|changed:excerpts|pieces of measured records, decimated, scaled, turned: none may crash
method|method|the picture of docs/method.md: the hypotheses of one search, and its error budget
simulated|simulated|the package's own simulations: whether nothing is said to be missing
verification|verification|the paper's figures 6 to 10 (loops, steps, others), and three mechanics
fmu|fmu|error against work: the FMU beside CVode, Radau, LSODA; cost of a fixed step
coupling|coupling|a positioner of FMUs against one model: error over step, stability
nonlinearity|nonlinearity|a positioner: open and closed loop, with and without the compensator
design|design|designed inputs: causes told apart, paths followed, hysteresis compensated
fuzz|fuzz|damaged files, hostile FMUs, kills, odd surroundings: none may fail (fuzz --help)
"""
_LINES = [line.split("|") for line in _TABLE.strip().splitlines()]
BENCHES: dict[str, str] = {name: shows for name, _, shows in _LINES}


def bench(name: str, of: str = "run") -> Any:
    """Return the function of a benchmark, or something else of its module, None if it has none."""
    place = {name: place for name, place, _ in _LINES}.get(name, "table")
    module, _, function = place.partition(":")
    found = import_module(f"tests.studies.benchmarks.{module}")
    return getattr(found, (function or of) if of == "run" else of, None)


def styled(axes: Axes, x: str = "", y: str = "", title: str = "", *, size: float = 10.5) -> None:
    """Give axes labels and a title, a light grid below the curves, and small numbers."""
    axes.set_xlabel(x, fontsize=size)
    axes.set_ylabel(y, fontsize=size)
    axes.set_title(title, loc="left", fontsize=size)
    axes.grid(visible=True, which="major", color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=size - 2)


def plain_ticks(axes: Axes, x: Iterable[float]) -> None:
    """Give a logarithmic axis ticks at these values alone."""
    ticks = sorted(x)
    axes.set_xticks(ticks, [f"{v:g}" for v in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())
