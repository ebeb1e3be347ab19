"""The table of benchmarks: each is loaded when it is run."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

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


def _later(
    module: str, name: str, description: str, *, on_folder: bool = False, sized: bool = False
) -> Bench:
    def run(progress: Progress, quick: bool) -> Outcome:
        found: Outcome = import_module(f"tests.studies.benchmarks.{module}").run(progress, quick)
        return found

    def run_on(progress: Progress, folder: Path) -> Outcome:
        found: Outcome = import_module(f"tests.studies.benchmarks.{module}").run_on(
            progress, folder
        )
        return found

    def run_sized(progress: Progress, count: int) -> Outcome:
        found: Outcome = import_module(f"tests.studies.benchmarks.{module}").run_sized(
            progress, count
        )
        return found

    return Bench(
        name, description, run, run_on if on_folder else None, run_sized if sized else None
    )


BENCHES: dict[str, Bench] = {
    bench.name: bench
    for bench in (
        _later(
            "speed",
            "identify",
            "identification against scipy's least_squares with solve_ivp, and how it grows",
        ),
        _later(
            "fits",
            "fits",
            "exact steps against the stepper: error against time, lanes, effects, whole diagnoses",
        ),
        _later(
            "ensembles",
            "ensembles",
            "many sets of parameters beside LSODA, CVODES and diffrax at equal error (--size)",
            sized=True,
        ),
        _later(
            "batch",
            "batch",
            "many devices with hidden defects: which are told, cost, a run again (--size)",
            sized=True,
        ),
        _later(
            "reading",
            "reading",
            "records of 200 MB in every format: exact, time against the library's own reading",
        ),
        _later(
            "web",
            "web",
            "models in pages: sizes, redraw times in a headless browser, errors",
        ),
        _later(
            "coverage",
            "coverage",
            "identified parameters and their intervals against the truth, over stacks (--size)",
            sized=True,
        ),
        _later(
            "causes.command",
            "causes",
            "hidden causes as a data set for other methods: write, answer, table",
        ),
        _later(
            "posterior",
            "posterior",
            "whole posteriors: calibration (--size), and evidence by bridge sampling",
            sized=True,
        ),
        _later(
            "posterior_pymc",
            "sampling",
            "effective samples per second beside an ODE in PyMC, on one posterior (--size)",
            sized=True,
        ),
        _later(
            "own_model",
            "own_model",
            "models that are no stacks: hidden causes, errors before and after, and a page",
        ),
        _later(
            "paper_method",
            "paper",
            "the paper's identification beside the prediction-error fit, against noise and window",
        ),
        _later(
            "measured",
            "measured",
            "the measured micromanipulator: held-out error of the paper's model and of two effects",
        ),
        _later(
            "floors",
            "floors",
            "measured records: held-out error of a diagnosis beside the floor of each (--folder)",
            on_folder=True,
        ),
        _later(
            "mirror",
            "mirror",
            "models of one axis of the steering mirror by its authors' score (--folder)",
            on_folder=True,
        ),
        _later(
            "hidden",
            "diagnose",
            "hidden causes on independent plants: what is named, how surely, and how often rightly",
        ),
        _later(
            "exam",
            "exam",
            "plants of another author: six kinds of hysteresis, causes in other forms, with marks",
        ),
        _later(
            "exam_constants",
            "exam_constants",
            "hard records of the exam with each deciding constant halved and doubled",
        ),
        _later(
            "ablation",
            "ablation",
            "the diagnosis without each of its steps, and with each deciding constant moved",
        ),
        _later(
            "stability",
            "stability",
            "the diagnosis of data changed by 1 % of their noise: verdicts and names that stay",
        ),
        _later(
            "added",
            "added",
            "an effect of an independent plant added to a measured record: what is named on top",
        ),
        _later(
            "excerpts",
            "excerpts",
            "pieces of measured records, decimated, scaled, turned round: none may crash",
        ),
        _later(
            "method_pictures",
            "method",
            "the picture of docs/method.md: the hypotheses of one search, and its error budget",
        ),
        _later(
            "simulated",
            "simulated",
            "the package's own simulations, where nothing is missing: whether that is what is said",
        ),
        _later(
            "verification",
            "verification",
            "the paper's figures 6 to 10 (loops, steps, other voltages), and three mechanics",
        ),
        _later(
            "work_precision",
            "fmu",
            "error against work: the FMU's solver beside CVode, Radau, LSODA; cost of a fixed step",
        ),
        _later(
            "coupling",
            "coupling",
            "a positioner of FMUs against one model: error over communication step, stability",
        ),
        _later(
            "nonlinearity",
            "nonlinearity",
            "a positioner's nonlinearity: open and closed loop, with and without the compensator",
        ),
        _later(
            "design",
            "design",
            "designed inputs: causes told apart, paths followed, hysteresis compensated",
        ),
        _later(
            "fuzz",
            "fuzz",
            "damaged files, hostile FMUs, kills, odd surroundings: none may fail (fuzz --help)",
        ),
    )
}
