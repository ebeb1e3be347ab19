"""What the benchmarks share: their names, the tables that they give, work side by side, times."""

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from math import inf
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from psa_casadi.report.words.tables import Table

T = TypeVar("T")
FloatArray = npt.NDArray[np.float64]
#: Reports a step of long work.
Progress = Callable[[str], None]
#: One row of a table: the cell of each column, by the column's head.
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
    report: Callable[[T], str] = str,
    workers: int | None = None,
) -> list[T]:
    """Return function(*job) of every job, in their order, worked on side by side.

    `report` returns a line about one result.
    """
    with ProcessPoolExecutor(workers or os.cpu_count(), get_context("spawn")) as pool:
        futures = [pool.submit(function, *job) for job in jobs]
        for k, future in enumerate(as_completed(futures), 1):
            progress(f"{k} of {len(futures)}: {report(future.result())}")
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
_TABLE = Path(__file__).with_name("benchmarks.tsv").read_text(encoding="utf-8")
_LINES = [line.split("\t") for line in _TABLE.splitlines()[1:]]
BENCHES: dict[str, str] = {name: shows for name, _, shows in _LINES}


def bench(name: str, of: str = "run") -> Any:
    """Return the function of a benchmark, or something else of its module, None if it has none."""
    place = {name: place for name, place, _ in _LINES}.get(name, "table")
    module, _, function = place.partition(":")
    result = import_module(f"tests.studies.benchmarks.{module}")
    return getattr(result, (function or of) if of == "run" else of, None)
