"""What exact steps are worth to fits, beside the stepper in the same run.

One simulation of the demonstration's record with twelve derivatives is what a fit is made of; both
ways make it at falling tolerances and are held against the stepper at 1e-11. Then
lanes, and whole fits and diagnoses; ways and errors of all effects are in
`tests/simulation/test_exact.py`. Times are the least
processor time over several repeats, in which both ways take turns.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import resources
from itertools import product
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

import psa_casadi as psa
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.records import decaying_triangle, time_grid, triangle
from psa_casadi.report.words.phrases import number, plain
from psa_casadi.simulation import simulate as simulate_module
from psa_casadi.simulation.exact.run import LANES, NotExact, run_exact, run_sets
from psa_casadi.simulation.simulate import EXACT, STEPPER
from psa_casadi.simulation.start import start_on
from psa_casadi.units import FloatArray
from tests.studies.benchmarks import table
from tests.studies.benchmarks.records import hidden_record, noisy, played_again
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable
from tests.voltages import concatenate, steps

FREE = ("k_L", "A", "beta", "gamma", "delta", "n", "tau", "R_s", "c_P", "c_B", "m_P", "m_B")
#: Tolerances of a step. Looser ones run exact steps at 1e-5 (`ways.LOOSEST`), so none is below.
TOLERANCES = {
    EXACT: tuple(10.0 ** (-k / 2) for k in range(10, 17)),
    STEPPER: tuple(10.0 ** (-k / 2) for k in range(8, 19)),
}
#: Error over the range at which the two ways are compared.
WANTED = 1e-5
_TRUTH, _OUTPUT = 1e-11, "measured_displacement"


class Point(NamedTuple):
    """One way at one tolerance: error over the range, least times per sample [us], steps."""

    way: str
    tolerance: float
    error: float
    differentiated: float
    plain: float
    steps: float


@dataclass(frozen=True)
class Task:
    """A record with the model that a fit of it starts from."""

    record: psa.Record
    model: psa.Model

    @property
    def time(self) -> FloatArray:
        """Times from the record's first sample (n,) [s]."""
        return np.asarray(self.record.time - self.record.time[0], dtype=np.float64)

    @property
    def inputs(self) -> FloatArray:
        """Samples of the model's inputs (n, nu)."""
        return simulate_module.record_inputs(self.model, self.record, self.record.n)

    def start(self, model: psa.Model) -> tuple[FloatArray, FloatArray]:
        """Return the initial state (nx,) and its derivatives by the unknowns (nx, k)."""
        start = start_on(model, self.time, self.inputs)
        return start.x, start.by_parameter[:, [model.parameter_names.index(n) for n in FREE]]


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure one run, lanes, and whole fits and diagnoses."""
    task, repeats = demonstration(), 3 if quick else 15
    points = measured(task, repeats, progress)
    tables = (
        run_table(points, task.record.n),
        _lanes(task, cheapest(points, EXACT, "plain").tolerance, repeats, progress),
        diagnosis_table(task.record, progress, quick),
    )
    return Outcome(tables, partial(picture, points))


def picture(points: Sequence[Point]) -> Figure:
    """Return time per sample over largest error, with sensitivities (solid) and without."""
    figure = Figure(figsize=(8.4, 5.2), layout="constrained")
    axes = figure.subplots()
    looks = {EXACT: ("#0072b2", "o"), STEPPER: ("#d55e00", "s")}
    kinds = {"differentiated": ("-", f"{len(FREE)} sensitivities"), "plain": ("--", "none")}
    for (way, (colour, marker)), (of, (style, what)) in product(looks.items(), kinds.items()):
        mine = [p for p in points if p.way == way]
        axes.loglog(
            [p.error for p in mine], [getattr(p, of) for p in mine], style, color=colour,
            marker=marker, markersize=5.5, linewidth=1.5, label=f"{way}, {what}",
            markerfacecolor=colour if of == "differentiated" else "white",
        )  # fmt: skip
    error, took = "largest error of the displacement / its range", "processor time per sample [µs]"
    table.styled(axes, error, took, "One simulation of the demonstration's record, as in a fit")
    low, high = axes.get_ylim()
    axes.set_yticks(
        [y for k in range(-3, 5) for m in (1, 2, 5) if low <= (y := m * 10.0**k) <= high]
    )
    axes.yaxis.set_major_formatter("{x:g}")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    figure.legend(fontsize=9.5, loc="outside lower center", ncols=2, frameon=False)
    return figure


def demonstration() -> Task:
    """Return the demonstration's record and the stack of its size."""
    with resources.as_file(resources.files("psa_casadi").joinpath("data", "demo.csv")) as path:
        record = psa.read_record(path)
    return Task(record, starting_model([record]))


def measured(task: Task, repeats: int, progress: Progress) -> list[Point]:
    """Return both ways at all tolerances; errors are those against the stepper at 1e-11."""
    progress("one run: both ways at all tolerances")
    x0, s0 = task.start(task.model)
    truth = _run(task, STEPPER, _TRUTH, x0, None)[0]
    ways = [(way, rtol) for way, rtols in TOLERANCES.items() for rtol in rtols]
    works = [partial(_run, task, *way, x0, inputs) for way in ways for inputs in (s0, None)]
    items = [work() for work in works]  # compiles and loads what the first use needs
    times = [1e6 * s / task.record.n for _, s in table.least_times(works, repeats)]
    points = []
    for k, (way, rtol) in enumerate(ways):
        x, taken = items[2 * k + 1]
        with_, without = times[2 * k : 2 * k + 2]
        points.append(Point(way, rtol, _error(x, truth), with_, without, taken / task.record.n))
    return points


def _run(
    task: Task, way: str, tolerance: float, x0: FloatArray, s0: FloatArray | None
) -> tuple[FloatArray, int]:
    """Return the displacement (n,) and the steps of one run, with derivatives where `s0` is."""
    model, t, u = task.model, task.time, task.inputs
    how: Any = {"unknowns": () if s0 is None else FREE, "s0": s0, "outputs": (_OUTPUT,)}
    if way == EXACT:
        exact = run_exact(model, t, u, x0, tolerance=tolerance, **how)
        return exact.requested[:, 0], exact.steps
    result = psa.run(model, t, u, x0, rtol=tolerance, **how)
    return result.y[:, model.output_names.index(_OUTPUT)], result.steps


def _error(x: FloatArray, truth: FloatArray) -> float:
    return float(np.max(np.abs(x - truth)) / np.ptp(truth))


def cheapest(points: Sequence[Point], way: str, of: str, error: float = WANTED) -> Point:
    """Return the run of a way that takes least ("differentiated" or "plain") below an error."""
    fine = [p for p in points if p.way == way and p.error < error]
    if not fine:
        raise psa.PsaError(f"No tolerance brings the {way} below {error:g} of the range.")
    return min(fine, key=lambda p: float(getattr(p, of)))


def run_table(points: Sequence[Point], samples: int) -> TitledTable:
    """Return both ways at all tolerances, and the share of the stepper's time at equal error."""
    items = []
    for of, words in (("differentiated", f"with {len(FREE)} sensitivities"), ("plain", "without")):
        ours, theirs = (cheapest(points, way, of) for way in (EXACT, STEPPER))
        ratio = number(getattr(theirs, of) / getattr(ours, of), 2)
        items.append(f"{words} 1/{ratio} of the stepper's time (tolerances {ours.tolerance:.0e} and"
                    f" {theirs.tolerance:.0e})")  # fmt: skip
    rows = [
        {"way": p.way, "tolerance of a step": f"{p.tolerance:.0e}",
         "largest error / range": number(p.error, 2),
         f"us per sample, {len(FREE)} sensitivities": number(p.differentiated),
         "us per sample, none": number(p.plain), "steps per sample": number(p.steps)}
        for p in points
    ]  # fmt: skip
    return TitledTable(
        f"One run of the demonstration's record ({samples} samples)",
        rows,
        f"At errors below {WANTED:.0e} of the range the exact way takes {'; '.join(items)}: of each"
        f" way the cheapest tolerance counts. Errors are against the stepper at {_TRUTH:.0e}; times"
        " are the least of the repeats and carry over to other machines as ratios only.",
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
    starts = [task.start(m)[0] for m in models]
    p, nominal = (
        np.array([getattr(m, of)() for m in models]).T
        for of in ("parameter_vector", "state_nominals")
    )
    inputs, how = (task.time, task.inputs), dict[str, Any](tolerance=tolerance)
    together = partial(
        run_sets,
        task.model.structure,
        *inputs,
        p=p,
        x0=np.array(starts).T,
        nominal=nominal,
        output=_OUTPUT,
        **how,
    )
    single = partial(run_exact, outputs=(_OUTPUT,), **how)
    singles = [partial(single, m, *inputs, x) for m, x in zip(models, starts, strict=True)]
    many = psa.simulate_many(task.model, sets, task.record, rtol=tolerance)
    for others in (np.array([one().requested[:, 0] for one in singles]), many):
        if not np.array_equal(together().T, others):
            raise psa.PsaError("A set has other bits in a lane than by itself.")
    side, *alone = (
        s / LANES / task.record.n for _, s in table.least_times([together, *singles], repeats)
    )
    rows = [
        {"how": name, "ns per sample and set": number(1e9 * seconds),
         "sets per time, over one by itself": number(sum(alone) / seconds, 2)}
        for name, seconds in (("one set by itself", sum(alone)), (f"{LANES} sets in lanes", side))
    ]  # fmt: skip
    return TitledTable(
        "Many sets of parameters on one core",
        rows,
        f"At a tolerance of {tolerance:.0e}, without sensitivities; mean over {LANES} sets. The"
        " displacement of every set has the same bits in a lane, by itself and from"
        " `simulate_many`, which this run checked.",
    )


#: Causes hidden in a device of the independent plants each, of which there are six records.
HIDDEN = ("hysteresis_memory", "structural_mode", "slow_creep")
_RECORDS, _FIRST_SEED, _NOISE, _SAMPLE_TIME = 6, 271828, 1e-3, 1e-4
_LONG, _QUICK_LONG = 180_000, 12_000
#: Samples of a step of the long record; samples of a record of the plants that are diagnosed.
_HELD, _CUT = 600, 2400


def stepper_alone() -> Any:
    """Leave exact steps out within: every model counts as one that they do not fit."""
    error = NotExact("left out for a benchmark")
    return patch.object(simulate_module, "run_exact", side_effect=error)


def diagnosis_table(demo: psa.Record, progress: Progress, quick: bool) -> TitledTable:
    """Diagnose the demonstration and hidden causes, identify a long record.

    What is diagnosed is so once before it counts: models get compiled.
    """
    long, several = long_record(_QUICK_LONG if quick else _LONG), f"{_RECORDS} x {_CUT}"
    works: list[tuple[str, str, Callable[[], str], bool]] = [
        ("diagnose, demonstration", str(demo.n), partial(_diagnosed, [demo]), True),
        ("identify, loops and steps", str(long.n), partial(_identified, long), True),
    ]
    for cause in HIDDEN[: 1 if quick else None]:
        name = f"diagnose, {_RECORDS} records, hidden {plain(cause)}"
        works.append((name, several, partial(_diagnosed, six_records(cause)), False))
    rows = []
    for work, samples, do, peer in works:
        progress(work)
        do()
        spent = _spent(work, samples, do)
        rows.append(spent)
        if peer:
            progress(f"{work}, by the stepper alone")
            with stepper_alone():
                rows.append(_spent(f"{work}, by the stepper alone", samples, do))
            ratio = float(spent["processor [s]"]) / float(rows[-1]["processor [s]"])
            spent["over the stepper's"] = number(ratio, 2)
    note = "Models are compiled and cached before. Wall times are those of a shared machine."
    return TitledTable("Whole fits and diagnoses", rows, note)


def _spent(work: str, samples: str, do: Callable[[], str]) -> dict[str, str]:
    wall, processor = time.perf_counter(), time.process_time()
    with psa.timed() as timings:
        result = do()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    runs, with_derivatives = (
        str(sum(getattr(s, of) for s in timings.stages)) for of in ("runs", "differentiated")
    )
    return {
        "work": work, "samples": samples, "wall [s]": number(wall),
        "processor [s]": number(processor), "over the stepper's": "", "simulations": runs,
        "with derivatives": with_derivatives, "found": result,
    }  # fmt: skip


def _diagnosed(records: Sequence[psa.Record]) -> str:
    result = psa.diagnose(records)
    return ", ".join(plain(c.effect) for c in result.causes) or str(result.verdict)


def _identified(record: psa.Record) -> str:
    rms = psa.identify([record]).fit.rms
    return f"rms {number(100.0 * rms / record.range_m, 2)} % of range"


def six_records(cause: str) -> list[psa.Record]:
    """Return records of one device of the independent plants, each with a voltage of its own."""
    truth, _ = hidden_record(cause, _FIRST_SEED, visible=(1.0, 3.0))
    return [played_again(truth, _FIRST_SEED + k).slice(0, _CUT) for k in range(_RECORDS)]


def long_record(samples: int) -> psa.Record:
    """Return loops and steps with noise, of this package's own simulation."""
    model = psa.stack_model("WYDS0808020")
    top, part = model.values["u_rated"], samples // 3
    t = time_grid(part * _SAMPLE_TIME, _SAMPLE_TIME)
    rng = np.random.default_rng(1)
    levels = top * rng.uniform(0.0, 1.0, max(6, part // _HELD))
    parts = [
        triangle(t, 0.0, top, 4.0 / (part * _SAMPLE_TIME)),
        decaying_triangle(t, 0.0, top, 6, centre=0.0),
        steps(t, levels),
    ]
    time, voltage = concatenate(parts, _SAMPLE_TIME)
    x = psa.simulate(model, time, voltage).displacement
    clean = psa.Record(name=f"{x.size} samples", time=time, voltage=voltage, displacement=x)
    return noisy(clean, _NOISE * clean.range_m, rng)
