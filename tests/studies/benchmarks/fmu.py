"""Work against accuracy: the exported FMU's own solver beside CVode, Radau and LSODA.

Every method meets the same model, the same voltage and the same tolerances. The error is the
largest one of the displacement, as a share of its range, against the reference integrated at
1e-12, which shares no code with the model. The FMU is stepped as an importer does: the tolerance in
the set-up of the experiment, one call for every communication step.
"""

import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import inf, log
from pathlib import Path
from typing import Protocol

import fmpy
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fixed_step.export import export_c, fixed_step
from psa_casadi.export.fixed_step.probe import VOLTAGES
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.fmu.sources import compiled_files, exported_texts
from psa_casadi.export.importer.fmu import Fmu, FmuError
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import multisine, time_grid
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.compiler import OPTIMISE, compiler_command, run_compiler
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable
from tests.studies.benchmarks.work_precision_methods import METHODS, OURS, Case, Method

FloatArray = npt.NDArray[np.float64]

#: The step of issue and table [s], and what is asked of it.
STEP, MOST_NS, MOST_RATIO = 1e-5, 400.0, 1.5
_SOURCE = Path(__file__).parents[2] / "export" / "c_host" / "step_cost.c"


def voltage(model: Model) -> FloatArray:
    """Return 1000 voltages [V]: 200 of each reference voltage."""
    share = np.linspace(0.0, 1.0, 1001)[1:]
    parts = [
        shape(share)[200 * k : 200 * (k + 1)] for k, (_, shape) in enumerate(VOLTAGES.values())
    ]
    return np.asarray(model.values["u_rated"] * np.concatenate(parts))


def measured(model: Model, repetitions: int, *, fixed: bool) -> FloatArray:
    """Return the time [ns] of every step, (1000, 2): of the generated code and of an FMU.

    The FMU is the ordinary one, or the one with a `fixed` step.
    """
    table = {v.name: k for k, v in enumerate(variable_table(model), start=1)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export_c(model, folder, step=STEP, name="stack", substeps=1)
        step = fixed_step(model, name="stack", step=STEP, substeps=1) if fixed else None
        token, texts, _ = exported_texts(model, model.name, fixed=step)
        for file, text in texts.items():
            (folder / file).write_text(text, encoding="utf-8")
        sources = compiled_files(texts)
        headers = Path(fmpy.__file__).parent / "c-code"
        command = [*compiler_command(), *OPTIMISE, "-I.", f"-I{headers}"]
        files = [str(_SOURCE), "stack.c", *sources, "-lm", "-o", "step_cost"]
        run_compiler([*command, *files], folder)
        given = [str(repetitions), str(table["voltage"]), str(table["displacement"])]
        done = subprocess.run(
            [str(folder / "step_cost"), token, *given],
            input="\n".join(map(repr, voltage(model).tolist())),
            capture_output=True, text=True, check=True,
        )  # fmt: skip
    return np.array([[float(v) for v in line.split()] for line in done.stdout.splitlines()])


def cost_table(progress: Progress, *, quick: bool) -> TitledTable:
    """Return mean, worst and their ratio for a stack."""
    progress("cost of a step")
    model, repetitions = stack_model("P-885.51").plant(), 50 if quick else 400
    ordinary, fixed = (measured(model, repetitions, fixed=f).T for f in (False, True))
    ways = {
        "psa export c": ordinary[0],
        "psa export fmu --solver fixed": fixed[1],
        "psa export fmu": ordinary[1],
    }
    rows = tuple(
        (name, f"{c.mean():.0f}", f"{c.max():.0f}", f"{c.max() / c.mean():.2f}")
        for name, c in ways.items()
    )
    return TitledTable(
        f"cost of a step of {1e6 * STEP:g} us, P-885.51: ramps, holds, tones and jumps",
        Table(("way", "mean [ns]", "worst [ns]", "worst / mean"), rows),
        f"Asked of the generated code: at most {MOST_NS:g} ns, worst over mean below"
        f" {MOST_RATIO:g}. Each step counts with the least time of its repetitions.",
    )


_FONT = 10.5
_STYLES = (("#0072b2", "o"), ("#d55e00", "s"), ("#009e73", "^"), ("#9a6fb0", "v"))


class Measured(Protocol):
    """What a run must tell to be drawn."""

    @property
    def case(self) -> str: ...
    @property
    def method(self) -> str: ...
    @property
    def tolerance(self) -> float: ...
    @property
    def error(self) -> float: ...
    @property
    def seconds(self) -> float: ...
    @property
    def evaluations(self) -> float: ...


def picture(runs: Sequence[Measured]) -> Figure:
    """Return a row for every case: error over CPU time, over right-hand sides, over tolerance."""
    cases = list(dict.fromkeys(r.case for r in runs))
    figure = Figure(figsize=(14.0, 4.6 * len(cases)), layout="constrained")
    grid = figure.subplots(len(cases), 3, squeeze=False)
    for row, case in zip(grid, cases, strict=True):
        of_case = [r for r in runs if r.case == case]
        _curves(row[0], of_case, "seconds", "CPU time [s]")
        _curves(row[1], of_case, "evaluations", "evaluations of the right-hand side")
        _curves(row[2], of_case, "tolerance", "tolerance asked for")
        ends = [min(r.tolerance for r in of_case), max(r.tolerance for r in of_case)]
        row[2].plot(ends, ends, color="0.6", linewidth=1.0, zorder=0, label="error = tolerance")
        row[0].set_title(case, loc="left", fontsize=_FONT)
        row[2].legend(fontsize=_FONT - 2)
    return figure


def _curves(axes: Axes, runs: Sequence[Measured], across: str, label: str) -> None:
    methods = list(dict.fromkeys(r.method for r in runs))
    for method, (colour, marker) in zip(methods, _STYLES, strict=False):
        mine = [r for r in runs if r.method == method]
        axes.loglog(
            [getattr(r, across) for r in mine], [r.error for r in mine], color=colour,
            marker=marker, markersize=5, linewidth=1.4, label=method,
        )  # fmt: skip
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(label, fontsize=_FONT)
    axes.set_ylabel("largest error / range", fontsize=_FONT)
    axes.grid(visible=True, which="major", color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=_FONT - 2)


_TRUTH, _CHECK = 1e-12, 1e-11
_LEVELS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
_SAMPLE_TIME = 5e-5
_SLOW = 0.3
_HEAD = (
    "method", "tolerance asked for", "largest error / range", "error / tolerance",
    "CPU time [ms]", "right-hand sides",
)  # fmt: skip


@dataclass(frozen=True)
class Run:
    """One run: error as a share of the range, CPU time [s], right-hand sides; inf if it failed."""

    case: str
    method: str
    tolerance: float
    error: float
    seconds: float
    evaluations: float


def run(progress: Progress, quick: bool) -> Outcome:
    """Run every method at every tolerance on a sampled record and on a stiff, ringing stack."""
    tolerances = (1e-3, 1e-5, 1e-7) if quick else tuple(10.0**-k for k in range(3, 10))
    tables, runs = [], []
    for case in cases(quick):
        progress(f"reference: {case.name}")
        truth = case.truth(_TRUTH)
        doubt = np.max(np.abs(case.truth(_CHECK) - truth)) / np.ptp(truth)
        with tempfile.TemporaryDirectory() as folder:
            path = export_fmu(case.model, Path(folder) / "model.fmu")
            found = _runs(case, path, tolerances, truth, progress, 1 if quick else 3)
        tables.append(_table(case, found, float(doubt)))
        runs += found
    cost = cost_table(progress, quick=quick)
    return Outcome((*tables, _summary(runs), cost), partial(picture, runs))


def cases(quick: bool) -> tuple[Case, Case]:
    """Return a multisine with rounded samples, and steps on a ringing stack with a tiny R_s."""
    t = time_grid(0.015 if quick else 0.025, _SAMPLE_TIME)
    ramp = np.minimum(5.0 * t / t[-1], 1.0)
    sampled = np.round(ramp * multisine(t, 0.0, 100.0, (100.0, 1000.0), seed=1), 2)
    steps = time_grid(0.005 if quick else 0.01, _SAMPLE_TIME)
    levels = np.array([100.0, 180.0, 40.0, 150.0, 0.0])
    stiff = stack_model("PTBS200").with_values({"R_s": 0.01})
    return (
        Case(
            f"sampled record ({len(t)} samples at 20 kHz, linear in between)",
            stack_model("P-885.51"), t, sampled, hold=False,
        ),
        Case(
            "stiff and ringing (five steps of the voltage, R_s C_p of 16 ns)",
            stiff, steps, np.repeat(levels, len(steps) // len(levels)), hold=True,
        ),
    )  # fmt: skip


def _runs(
    case: Case, path: Path, tolerances: Sequence[float], truth: FloatArray, progress: Progress,
    repeats: int,
) -> list[Run]:  # fmt: skip
    with Fmu(path) as fmu:
        return [
            _measured(method, case, fmu, tolerance, truth, progress, repeats)
            for method in METHODS
            for tolerance in tolerances
        ]


def _measured(
    method: Method, case: Case, fmu: Fmu, tolerance: float, truth: FloatArray,
    progress: Progress, repeats: int,
) -> Run:  # fmt: skip
    """Return one run; its CPU time is the least of the repeats, of which a slow run has one."""
    progress(f"{case.name}: {method.name}, {tolerance:.0e}")
    seconds = inf
    try:
        for _ in range(repeats):
            begin = time.process_time()
            found = method.solve(case, fmu, tolerance)
            seconds = min(seconds, time.process_time() - begin)
            if seconds > _SLOW:
                break
    except FmuError:
        return Run(case.name, method.name, tolerance, inf, inf, inf)
    error = float(np.max(np.abs(found.displacement - truth)) / np.ptp(truth))
    evaluations = found.evaluations
    if evaluations is None and method.count:
        evaluations = method.count(case, fmu, tolerance)
    return Run(case.name, method.name, tolerance, error, seconds, evaluations or inf)


def _table(case: Case, runs: Sequence[Run], doubt: float) -> TitledTable:
    rows = tuple(
        (
            r.method, f"{r.tolerance:.0e}", number(r.error, 2), number(r.error / r.tolerance, 2),
            number(1e3 * r.seconds), number(r.evaluations),
        )
        for r in runs
    )  # fmt: skip
    note = f"The reference at 1e-11 and at 1e-12 differ by {number(doubt, 2)} of the range."
    return TitledTable(f"Reached error and work: {case.name}", Table(_HEAD, rows), note)


def work_at(runs: Sequence[Run], error: float) -> tuple[float, float]:
    """Return CPU time [s] and right-hand sides at which a method reaches an error.

    Both are read off between the two runs on either side, linear in the logarithms; inf if no run
    is as accurate, and the loosest run's where all are.
    """
    ordered = sorted((r for r in runs if r.error < inf), key=lambda r: -r.tolerance)
    if not ordered or ordered[-1].error > error:
        return inf, inf
    last = max(i for i, r in enumerate(ordered) if i == 0 or r.error > error)
    if ordered[last].error <= error:
        return ordered[last].seconds, ordered[last].evaluations
    a, b = ordered[last], ordered[last + 1]
    share = log(a.error / error) / log(a.error / b.error)
    seconds, evaluations = (
        low * (high / low) ** share
        for low, high in ((a.seconds, b.seconds), (a.evaluations, b.evaluations))
    )
    return seconds, evaluations


def _summary(runs: Sequence[Run]) -> TitledTable:
    """Return the work of the others over that of the FMU, at equal error."""
    rows = []
    for case in dict.fromkeys(r.case for r in runs):
        of_case = [r for r in runs if r.case == case]
        for method in (m.name for m in METHODS if m.name != OURS):
            for error in _LEVELS:
                ours, theirs = (
                    work_at([r for r in of_case if r.method == name], error)
                    for name in (OURS, method)
                )
                if inf not in (*ours, *theirs):
                    ratios = (number(b / a, 2) for a, b in zip(ours, theirs, strict=True))
                    rows.append((case.partition(" (")[0], method, f"{error:.0e}", *ratios))
    head = ("case", "method", "error", "CPU time over the FMU's", "right-hand sides over the FMU's")
    return TitledTable("Work of the others at equal error", Table(head, tuple(rows)), _NOTE)


_NOTE = (
    "CPU time of one process of one run; only the ratios carry over to other machines. All are"
    " driven from Python: co-simulation pays for it once a communication step, the others at every"
    " right-hand side, so the right-hand sides are the fairer measure of the methods themselves."
    " They include those spent on Jacobians by differences; the FMU's solver has the exact Jacobian"
    " and evaluates it once a step, which is not counted. CVode and scipy restart at jumps and run"
    " through the samples of the record."
)
