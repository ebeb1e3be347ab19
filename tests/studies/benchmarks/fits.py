"""What exact steps are worth to fits, beside the stepper in the same run.

One simulation of the demonstration's record with twelve derivatives is what a fit is made of; both
ways make it at falling tolerances and are held against the stepper at 1e-11. Times are the least
processor time of one thread over several repeats, in which both ways take turns.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from math import inf
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from psa_casadi.errors import PsaError
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.compose import Model
from psa_casadi.records import Record, read_record
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.exact.run import LANES, run_exact, run_sets
from psa_casadi.simulation.many import simulate_many
from psa_casadi.simulation.simulate import EXACT, STEPPER, record_inputs
from psa_casadi.simulation.start import start_on
from psa_casadi.simulation.stepper import run as run_stepper
from tests.studies.benchmarks.fits_ways import diagnosis_table, ways_tables
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, styled, table_of

_STYLES = (("#0072b2", "o"), ("#d55e00", "s"))


def picture(points: Sequence["Point"]) -> Figure:
    """Return time per sample over largest error, with sensitivities (solid) and without."""
    figure = Figure(figsize=(8.4, 5.2), layout="constrained")
    axes = figure.subplots()
    ways = list(dict.fromkeys(p.way for p in points))
    kinds = {
        "differentiated": ("-", f"{len(FREE)} sensitivities"),
        "plain": ("--", "no sensitivities"),
    }
    for way, (colour, marker) in zip(ways, _STYLES, strict=False):
        mine = [p for p in points if p.way == way]
        for of, (style, what) in kinds.items():
            axes.loglog(
                [p.largest for p in mine], [getattr(p, of) for p in mine], style, color=colour,
                marker=marker, markersize=5.5, linewidth=1.5, label=f"{way}, {what}",
                markerfacecolor=colour if of == "differentiated" else "white",
            )  # fmt: skip
    error, took = "largest error of the displacement / its range", "processor time per sample [µs]"
    styled(axes, error, took, "One simulation of the demonstration's record, as in a fit")
    low, high = axes.get_ylim()
    ticks = [m * 10.0**k for k in range(-3, 5) for m in (1, 2, 5)]
    axes.set_yticks([y for y in ticks if low <= y <= high])
    axes.yaxis.set_major_formatter("{x:g}")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    figure.legend(fontsize=9.5, loc="outside lower center", ncols=2, frameon=False)
    return figure


FloatArray = npt.NDArray[np.float64]

FREE = ("k_L", "A", "beta", "gamma", "delta", "n", "tau", "R_s", "c_P", "c_B", "m_P", "m_B")
#: Tolerances of a step. Looser ones run exact steps at 1e-5 (`ways.LOOSEST`), so none is below.
EXACT_TOLERANCES = tuple(10.0 ** (-k / 2) for k in range(10, 17))
STEPPER_TOLERANCES = tuple(10.0 ** (-k / 2) for k in range(8, 19))
#: Error over the range at which the two ways are compared.
WANTED = 1e-5
_TRUTH = 1e-11
_OUTPUT = "measured_displacement"


@dataclass(frozen=True)
class Point:
    """One way at one tolerance: errors over the range, least times per sample [us], steps."""

    way: str
    tolerance: float
    largest: float
    rms: float
    differentiated: float
    plain: float
    steps: float


@dataclass(frozen=True)
class Task:
    """A record with the model that a fit of it starts from."""

    record: Record
    model: Model

    @property
    def time(self) -> FloatArray:
        """Times from the record's first sample (n,) [s]."""
        return np.asarray(self.record.time - self.record.time[0], dtype=np.float64)

    @property
    def inputs(self) -> FloatArray:
        """Samples of the model's inputs (n, nu)."""
        return record_inputs(self.model, self.record, self.record.n)

    def start(self, model: Model) -> tuple[FloatArray, FloatArray]:
        """Return the initial state (nx,) and its derivatives by the unknowns (nx, k)."""
        found = start_on(model, self.time, self.inputs)
        return found.x, found.by_parameter[:, [model.parameter_names.index(n) for n in FREE]]


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure one run, lanes, the ways of all effects, and whole fits and diagnoses."""
    task = demonstration()
    repeats = 3 if quick else 15
    points = measured(task, repeats, progress)
    tables = (
        run_table(points, task.record.n),
        _lanes(task, cheapest(points, EXACT, "plain").tolerance, repeats, progress),
        *ways_tables(progress, quick),
        diagnosis_table(task.record, progress, quick),
    )
    return Outcome(tables, partial(picture, points))


def demonstration() -> Task:
    """Return the demonstration's record and the stack of its size."""
    with resources.as_file(resources.files("psa_casadi").joinpath("data", "demo.csv")) as path:
        record = read_record(path)
    return Task(record, starting_model([record]))


def measured(task: Task, repeats: int, progress: Progress) -> list[Point]:
    """Return both ways at all tolerances; errors are those against the stepper at 1e-11."""
    model, t, u = task.model, task.time, task.inputs
    x0, s0 = task.start(model)
    progress("one run: reference")
    truth = run_stepper(model, t, u, x0, rtol=_TRUTH).y[:, model.output_names.index(_OUTPUT)]
    progress("one run: both ways at all tolerances")
    ways = [(EXACT, r) for r in EXACT_TOLERANCES] + [(STEPPER, r) for r in STEPPER_TOLERANCES]
    works = [
        partial(_work, task, way, tolerance, x0, given)
        for way, tolerance in ways
        for given in (s0, None)
    ]
    least = least_times(works, repeats)
    points = []
    for k, (way, tolerance) in enumerate(ways):
        shown, steps = works[2 * k + 1]()
        error = (shown - truth) / np.ptp(truth)
        with_, without = (1e6 * s / len(t) for s in least[2 * k : 2 * k + 2])
        largest, rms = float(np.max(np.abs(error))), float(np.sqrt(np.mean(error**2)))
        points.append(Point(way, tolerance, largest, rms, with_, without, steps / len(t)))
    return points


def _work(
    task: Task, way: str, tolerance: float, x0: FloatArray, s0: FloatArray | None
) -> tuple[FloatArray, int]:
    """Return the displacement (n,) and the steps of one run, with derivatives where `s0` is."""
    model, t, u = task.model, task.time, task.inputs
    unknowns = () if s0 is None else FREE
    if way == EXACT:
        found = run_exact(
            model, t, u, x0, tolerance=tolerance, unknowns=unknowns, s0=s0, outputs=(_OUTPUT,)
        )
        return found.shown[:, 0], found.steps
    steps = run_stepper(
        model, t, u, x0, rtol=tolerance, unknowns=unknowns, s0=s0, outputs=(_OUTPUT,)
    )
    return steps.y[:, model.output_names.index(_OUTPUT)], steps.steps


def least_times(works: Sequence[Callable[[], object]], repeats: int) -> list[float]:
    """Return the least processor time of this thread [s] for each, taken in turns."""
    for work in works:
        work()  # compiles and loads what the first use needs
    least = [inf] * len(works)
    for _ in range(repeats):
        for k, work in enumerate(works):
            begin = time.thread_time()
            work()
            least[k] = min(least[k], time.thread_time() - begin)
    return least


def cheapest(points: Sequence[Point], way: str, of: str, error: float = WANTED) -> Point:
    """Return the run of a way that takes least ("differentiated" or "plain") below an error."""
    fine = [p for p in points if p.way == way and p.largest < error]
    if not fine:
        raise PsaError(f"No tolerance brings the {way} below {error:g} of the range.")
    return min(fine, key=lambda p: float(getattr(p, of)))


def time_at(points: Sequence[Point], way: str, of: str, error: float = WANTED) -> float:
    """Return the time [us] of a way at an error, between two tolerances linear in the logarithms.

    nan where the error lies beyond the tolerances.
    """
    mine = sorted((p for p in points if p.way == way), key=lambda p: p.largest)
    errors = np.log([p.largest for p in mine])
    times = np.log([float(getattr(p, of)) for p in mine])
    return float(np.exp(np.interp(np.log(error), errors, times, left=np.nan, right=np.nan)))


def run_table(points: Sequence[Point], samples: int) -> TitledTable:
    """Return both ways at all tolerances, and the share of the stepper's time at equal error."""
    said = []
    for of, words in (("differentiated", f"with {len(FREE)} sensitivities"), ("plain", "without")):
        ours, theirs = (cheapest(points, way, of) for way in (EXACT, STEPPER))
        ratio = getattr(theirs, of) / getattr(ours, of)
        between = time_at(points, STEPPER, of) / time_at(points, EXACT, of)
        at_wanted = f"read off between tolerances at {WANTED:.0e} itself: 1/{number(between, 2)}"
        said.append(
            f"{words} 1/{number(ratio, 2)} of the stepper's time (tolerances {ours.tolerance:.0e}"
            f" and {theirs.tolerance:.0e}, errors {number(ours.largest, 2)} and"
            f" {number(theirs.largest, 2)}{f'; {at_wanted}' if np.isfinite(between) else ''})"
        )
    return table_of(
        f"One run of the demonstration's record ({samples} samples)",
        points,
        {
            "way": lambda p: p.way,
            "tolerance of a step": lambda p: f"{p.tolerance:.0e}",
            "largest error / range": lambda p: number(p.largest, 2),
            "rms error / range": lambda p: number(p.rms, 2),
            f"us per sample, {len(FREE)} sensitivities": lambda p: number(p.differentiated),
            "us per sample, none": lambda p: number(p.plain),
            "steps per sample": lambda p: number(p.steps),
        },
        f"At errors below {WANTED:.0e} of the range the exact way takes {'; '.join(said)}: of each"
        " way the cheapest tolerance counts. Exact steps asked for at tolerances above 1e-5 run at"
        f" 1e-5. Errors are against the stepper at {_TRUTH:.0e}; times are the least of the"
        " repeats and carry over to other machines as ratios only. The stepper is of second"
        " order at tolerances of 5e-6 and above, of fourth below: its steps are not all alike.",
    )


def _lanes(task: Task, tolerance: float, repeats: int, progress: Progress) -> TitledTable:
    """Return the time of a set among `LANES` in one core's vectors and by itself."""
    progress("lanes")
    rng, values = np.random.default_rng(1), task.model.values
    sets = [
        {n: values[n] * float(np.exp(0.1 * rng.standard_normal())) for n in FREE if n != "n"}
        for _ in range(LANES)
    ]
    models = [task.model.with_values(s) for s in sets]
    t, u = task.time, task.inputs
    starts = [task.start(m)[0] for m in models]
    p, nominal = (
        np.array([getattr(m, of)() for m in models]).T
        for of in ("parameter_vector", "state_nominals")
    )
    how: Any = {"tolerance": tolerance}

    def together() -> FloatArray:
        x0 = np.array(starts).T
        return run_sets(
            task.model.structure, t, u, p=p, x0=x0, nominal=nominal, output=_OUTPUT, **how
        )

    def by_itself(k: int) -> FloatArray:
        return run_exact(models[k], t, u, starts[k], outputs=(_OUTPUT,), **how).shown[:, 0]

    singles = [partial(by_itself, k) for k in range(LANES)]
    if not np.array_equal(together().T, np.array([one() for one in singles])):
        raise PsaError("A set has other bits in a lane than by itself.")
    many = simulate_many(task.model, sets, task.record, rtol=tolerance)
    if not np.array_equal(many.T, together()):
        raise PsaError("simulate_many has other bits than its lanes.")
    side, *alone = least_times([together, *singles], repeats)
    return lanes_table(side / LANES / len(t), sum(alone) / LANES / len(t), tolerance)


def lanes_table(side: float, alone: float, tolerance: float) -> TitledTable:
    """Return the seconds of a sample and set side by side in one core, and one set by itself."""
    rows = tuple(
        (name, number(1e9 * seconds), number(alone / seconds, 2))
        for name, seconds in (("one set by itself", alone), (f"{LANES} sets in lanes", side))
    )
    return TitledTable(
        "Many sets of parameters on one core",
        Table(("how", "ns per sample and set", "sets per time, over one by itself"), rows),
        f"At a tolerance of {tolerance:.0e}, without sensitivities; mean over {LANES} sets. The"
        " displacement of every set has the same bits in a lane, by itself and from"
        " `simulate_many`, which this run checked.",
    )
