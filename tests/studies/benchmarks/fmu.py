"""Work against accuracy: the exported FMU's own solver beside CVode, Radau and LSODA.

Every method meets the same model, the same voltage and the same tolerances. The error is the
largest one of the displacement, as a share of its range, against the reference integrated at
1e-12, which shares no code with the model. The FMU is stepped as an importer does: the tolerance in
the set-up of the experiment, one call for every communication step. Absolute tolerances are rtol
times the nominal of each state throughout, which is what CVode in fmpy and the FMU's own solver
take.
"""

import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from ctypes import c_size_t
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from math import inf, log
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import numpy.typing as npt
from fmpy.sundials import CVodeSolver
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.integrate import solve_ivp

from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fixed_step.export import export_c, fixed_step
from psa_casadi.export.fixed_step.probe import VOLTAGES
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.fmu.sources import compiled_files, exported_texts
from psa_casadi.export.importer.fmu import MODEL_EXCHANGE, Fmu, FmuError
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import multisine, time_grid
from psa_casadi.reference import simulate
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.compiler import OPTIMISE, compiler_command, run_compiler
from psa_casadi.simulation.stepper import run as run_stepper
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, styled, table_of

FloatArray = npt.NDArray[np.float64]

#: The share of the importer's tolerance that the FMU's solver gives each step (instance.c).
STEP_SHARE = 0.003
TIGHTEST_STEP = 1e-11
OURS = "co-simulation FMU"
_OUTPUT = "displacement"


@dataclass(frozen=True)
class Case:
    """A model and its voltage [V] at regular times (n,) [s].

    The voltage is linear between the times or, with `hold`, constant from each to the next.
    """

    name: str
    model: Model
    times: FloatArray
    voltage: FloatArray
    hold: bool

    @property
    def jumps(self) -> list[int]:
        """Return the indices of the times at which the voltage jumps."""
        return [int(k) + 1 for k in np.flatnonzero(np.diff(self.voltage))] if self.hold else []

    def at(self, t: float) -> float:
        """Return the voltage at t; at a jump, that after it."""
        if not self.hold:
            return float(np.interp(t, self.times, self.voltage))
        return float(self.voltage[np.searchsorted(self.times, t, side="right") - 1])

    def truth(self, rtol: float) -> FloatArray:
        """Return the displacement (n,) of the reference, which shares no code with the model."""
        marks = self.times[self.jumps] if self.hold else self.times
        breakpoints = list(marks)
        return simulate(
            self.model.values, self.at, self.times, breakpoints=breakpoints, rtol=rtol
        ).displacement


@dataclass(frozen=True)
class Solved:
    """The displacement (n,) of one run; `evaluations` of the right-hand side, if counted on it."""

    displacement: FloatArray
    evaluations: int | None = None


@dataclass(frozen=True)
class Method:
    """A way to integrate: `solve` is timed; `count`, where needed, counts in a run of its own."""

    name: str
    solve: Callable[[Case, Fmu, float], Solved]
    count: Callable[[Case, Fmu, float], int] | None = None


def _stepped(case: Case, fmu: Fmu, tolerance: float) -> Solved:
    """Step the FMU from sample to sample; with slopes where the voltage is linear."""
    inputs = Signals(("voltage",), case.times, case.voltage[:, None])
    found = co_simulate(
        fmu, case.times, inputs, [_OUTPUT], tolerance=tolerance, rates=not case.hold
    )
    return Solved(found[:, 0])


def _stepped_count(case: Case, _fmu: Fmu, tolerance: float) -> int:
    """Count with the simulator: the same C code with the same tolerance of a step."""
    u = np.zeros((len(case.times), len(case.model.input_names)))
    u[:, case.model.input_names.index("voltage")] = case.voltage
    return run_stepper(
        case.model, case.times, u, np.zeros(len(case.model.state_names)),
        rtol=max(STEP_SHARE * tolerance, TIGHTEST_STEP), hold="zero" if case.hold else "linear",
    ).evaluations  # fmt: skip


class _Unused:
    """What fmpy's CVode would set inputs with, but only where it looks for events."""

    def apply(self, time: float) -> None:
        """Do nothing: the inputs are set with the time."""


def _cvode(case: Case, fmu: Fmu, tolerance: float) -> Solved:
    """Integrate the model-exchange FMU with the CVode that fmpy carries.

    It restarts at jumps of the voltage and at zeros of the FMU's event indicators.
    fmpy's own `simulate_fmu` sets inputs once a step at most, and not at the right-hand side,
    which costs a moving voltage all accuracy; here they are set with every time.
    """
    t, calls, last = case.times, [0], [0.0]
    with fmu.start(MODEL_EXCHANGE, tolerance=tolerance) as instance:

        def set_time(time: float) -> None:
            instance.require("SetTime", float(time))
            instance.set({"voltage": case.at(min(time, last[0]))})

        def vector(function: str) -> Callable[[Any, int], None]:
            return lambda values, count: instance.require(function, values, c_size_t(count))

        def derivatives(values: Any, count: int) -> None:
            calls[0] += 1
            instance.require("GetDerivatives", values, c_size_t(count))

        solver = CVodeSolver(
            nx=len(fmu.states()), nz=int(fmu.description.numberOfEventIndicators),
            get_x=vector("GetContinuousStates"), set_x=vector("SetContinuousStates"),
            get_dx=derivatives, get_z=vector("GetEventIndicators"), input=_Unused(),
            get_nominals=vector("GetNominalsOfContinuousStates"), set_time=set_time,
            startTime=float(t[0]), maxStep=float(t[-1] - t[0]) / 50.0, relativeTolerance=tolerance,
        )  # fmt: skip
        rows = [instance.get([_OUTPUT])]
        for begin, end in pairwise([0, *case.jumps, len(t) - 1]):
            last[0] = float(np.nextafter(t[end], -np.inf))
            for k in range(begin, end):
                now = float(t[k])
                while now < t[k + 1]:
                    try:
                        event, _, now = solver.step(now, float(t[k + 1]))
                    except RuntimeError as error:
                        raise FmuError(f"CVode stopped after {now:g} s: {error}") from error
                    if event:
                        solver.reset(now)
                rows.append(instance.get([_OUTPUT]))
            solver.reset(float(t[end]))
    return Solved(np.array(rows)[:, 0], calls[0])


def _scipy(solver: Any, case: Case, fmu: Fmu, tolerance: float) -> Solved:
    """Integrate the right-hand side of the model-exchange FMU, restarted at jumps."""
    calls, t = [0], case.times
    with fmu.start(MODEL_EXCHANGE, tolerance=tolerance) as instance:
        states = fmu.states()
        x, atol = instance.get(states), tolerance * np.array([fmu.nominals[s] for s in states])
        rows = [instance.get([_OUTPUT])]
        for begin, end in pairwise([0, *case.jumps, len(t) - 1]):
            last = float(np.nextafter(t[end], -np.inf))

            def rates(time: float, x: FloatArray, last: float = last) -> FloatArray:
                calls[0] += 1
                return instance.derivatives(time, x, {"voltage": case.at(min(time, last))})

            found = solve_ivp(
                rates, (t[begin], t[end]), x, solver, t[begin + 1 : end + 1], rtol=tolerance,
                atol=atol,
            )  # fmt: skip
            if not found.success:
                raise FmuError(f"scipy stopped after {t[begin]:g} s: {found.message}")
            counted = calls[0]
            for time, state in zip(found.t, found.y.T, strict=True):
                rates(float(time), state)
                rows.append(instance.get([_OUTPUT]))
            calls[0], x = counted, found.y[:, -1]
    return Solved(np.array(rows)[:, 0], calls[0])


METHODS = (
    Method(OURS, _stepped, _stepped_count),
    Method("CVode, model exchange", _cvode),
    Method("scipy Radau, model exchange", partial(_scipy, "Radau")),
    Method("scipy LSODA, model exchange", partial(_scipy, "LSODA")),
)


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
    return table_of(
        f"cost of a step of {1e6 * STEP:g} us, P-885.51: ramps, holds, tones and jumps",
        ways,
        {
            "way": str,
            "mean [ns]": lambda way: f"{ways[way].mean():.0f}",
            "worst [ns]": lambda way: f"{ways[way].max():.0f}",
            "worst / mean": lambda way: f"{ways[way].max() / ways[way].mean():.2f}",
        },
        f"Asked of the generated code: at most {MOST_NS:g} ns, worst over mean below"
        f" {MOST_RATIO:g}. Each step counts with the least time of its repetitions.",
    )


_STYLES = (("#0072b2", "o"), ("#d55e00", "s"), ("#009e73", "^"), ("#9a6fb0", "v"))


def picture(runs: Sequence["Run"]) -> Figure:
    """Return a row for every case: error over CPU time, over right-hand sides, over tolerance."""
    cases = list(dict.fromkeys(r.case for r in runs))
    figure = Figure(figsize=(14.0, 4.6 * len(cases)), layout="constrained")
    grid = figure.subplots(len(cases), 3, squeeze=False)
    across = {
        "seconds": "CPU time [s]",
        "evaluations": "evaluations of the right-hand side",
        "tolerance": "tolerance asked for",
    }
    for row, case in zip(grid, cases, strict=True):
        of_case = [r for r in runs if r.case == case]
        for axes, (of, label) in zip(row, across.items(), strict=True):
            for method, (colour, marker) in zip(_methods(of_case), _STYLES, strict=False):
                mine = [r for r in of_case if r.method == method]
                axes.loglog(
                    [getattr(r, of) for r in mine], [r.error for r in mine], color=colour,
                    marker=marker, markersize=5, linewidth=1.4, label=method,
                )  # fmt: skip
            axes.xaxis.set_minor_formatter(NullFormatter())
            styled(axes, label, "largest error / range", case if of == "seconds" else "")
        ends = [min(r.tolerance for r in of_case), max(r.tolerance for r in of_case)]
        row[2].plot(ends, ends, color="0.6", linewidth=1.0, zorder=0, label="error = tolerance")
        row[2].legend(fontsize=8.5)
    return figure


_TRUTH, _CHECK = 1e-12, 1e-11
_LEVELS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
_SAMPLE_TIME = 5e-5
_SLOW = 0.3


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
            with Fmu(path) as fmu:
                found = [
                    _measured(m, case, fmu, tolerance, truth, progress, 1 if quick else 3)
                    for m in METHODS
                    for tolerance in tolerances
                ]
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
    return table_of(
        f"Reached error and work: {case.name}",
        runs,
        {
            "method": lambda r: r.method,
            "tolerance asked for": lambda r: f"{r.tolerance:.0e}",
            "largest error / range": lambda r: number(r.error, 2),
            "error / tolerance": lambda r: number(r.error / r.tolerance, 2),
            "CPU time [ms]": lambda r: number(1e3 * r.seconds),
            "right-hand sides": lambda r: number(r.evaluations),
        },
        f"The reference at 1e-11 and at 1e-12 differ by {number(doubt, 2)} of the range.",
    )


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
    names = [m.name for m in METHODS if m.name != OURS]
    for case, method, error in product(dict.fromkeys(r.case for r in runs), names, _LEVELS):
        ours, theirs = (
            work_at([r for r in runs if (r.case, r.method) == (case, name)], error)
            for name in (OURS, method)
        )
        if inf not in (*ours, *theirs):
            ratios = (number(b / a, 2) for a, b in zip(ours, theirs, strict=True))
            rows.append((case.partition(" (")[0], method, f"{error:.0e}", *ratios))
    head = ("case", "method", "error", "CPU time over the FMU's", "right-hand sides over the FMU's")
    note = (
        "CPU time of one process of one run; only the ratios carry over to other machines. All are"
        " driven from Python: co-simulation pays for it once a communication step, the others at"
        " every right-hand side, so the right-hand sides are the fairer measure of the methods"
        " themselves. They include those spent on Jacobians by differences; the FMU's solver has"
        " the exact Jacobian and evaluates it once a step, which is not counted. CVode and scipy"
        " restart at jumps and run through the samples of the record."
    )
    return TitledTable("Work of the others at equal error", Table(head, tuple(rows)), note)


def _methods(runs: Sequence["Run"]) -> list[str]:
    return list(dict.fromkeys(r.method for r in runs))
