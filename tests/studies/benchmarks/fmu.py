"""Work against accuracy: the solver of the exported FMU against CVode, Radau and LSODA.

Every method meets the same model, the same voltage and the same tolerances. The error is the
largest one of the displacement, as a share of its range, against the reference integrated at
1e-12, which shares no code with the model. The FMU is stepped as an importer does: the tolerance in
the set-up of the experiment, one call for every communication step. Absolute tolerances are rtol
times the nominal of each state throughout, which is what CVode in fmpy and the FMU's solver
take.
"""

import subprocess
import tempfile
from collections.abc import Callable, Sequence
from ctypes import c_size_t
from functools import partial
from itertools import pairwise, product
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import fmpy
import numpy as np
from fmpy.sundials import CVodeSolver
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fixed_step.export import VOLTAGES, fixed_step
from psa_casadi.export.fmu.sources import compiled_files, exported_texts
from psa_casadi.export.importer.fmu import MODEL_EXCHANGE, Fmu, FmuError
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.records import multisine, time_grid
from psa_casadi.report.words.phrases import number
from psa_casadi.simulation.compiler import OPTIMISE, compiler_command, run_compiler
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, least_times

#: The share of the importer's tolerance that the FMU's solver gives each step (instance.c).
STEP_SHARE, TIGHTEST_STEP = 0.003, 1e-11
OURS, _OUTPUT = "co-simulation FMU", "displacement"
#: Errors at which methods are compared; runs longer than this are not repeated [s].
_LEVELS, _SLOW = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7), 0.3


class Case(NamedTuple):
    """A model and its voltage [V] at regular times (n,) [s].

    The voltage is linear between the times or, with `hold`, constant from each to the next.
    """

    name: str
    model: psa.Model
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
        how: Any = {"breakpoints": list(marks), "rtol": rtol}
        return reference.simulate(self.model.values, self.at, self.times, **how).displacement


#: Displacement (n,) of a run, and evaluations of the right-hand side, None if a separate run
#: counts them.
Solved = tuple[FloatArray, int | None]


def _stepped(case: Case, fmu: Fmu, tolerance: float) -> Solved:
    """Step the FMU from sample to sample; with slopes where the voltage is linear."""
    inputs = Signals(("voltage",), case.times, case.voltage[:, None])
    how: Any = {"tolerance": tolerance, "rates": not case.hold}
    return co_simulate(fmu, case.times, inputs, [_OUTPUT], **how)[:, 0], None


def _stepped_count(case: Case, tolerance: float) -> int:
    """Count with the simulator: the same C code with the same tolerance of a step."""
    u = np.zeros((len(case.times), len(case.model.input_names)))
    u[:, case.model.input_names.index("voltage")] = case.voltage
    return psa.run(
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
    `simulate_fmu` of fmpy sets inputs once a step at most, and not at the right-hand side,
    which costs a moving voltage all accuracy; here they are set with every time.
    """
    t, calls, last = case.times, [0], [0.0]
    with fmu.start(MODEL_EXCHANGE, tolerance=tolerance) as instance:

        def set_time(time: float) -> None:
            instance.require("SetTime", float(time))
            instance.set({"voltage": case.at(min(time, last[0]))})

        def vector(function: str) -> Callable[[Any, int], None]:
            def call(values: Any, count: int) -> None:
                calls[0] += function == "GetDerivatives"
                instance.require(function, values, c_size_t(count))

            return call

        solver = CVodeSolver(
            nx=len(fmu.states()), nz=int(fmu.description.numberOfEventIndicators),
            get_x=vector("GetContinuousStates"), set_x=vector("SetContinuousStates"),
            get_dx=vector("GetDerivatives"), get_z=vector("GetEventIndicators"), input=_Unused(),
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
    return np.array(rows)[:, 0], calls[0]


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

            how: Any = {"rtol": tolerance, "atol": atol}
            result = solve_ivp(rates, (t[begin], t[end]), x, solver, t[begin + 1 : end + 1], **how)
            if not result.success:
                raise FmuError(f"scipy stopped after {t[begin]:g} s: {result.message}")
            counted = calls[0]
            for time, state in zip(result.t, result.y.T, strict=True):
                rates(float(time), state)
                rows.append(instance.get([_OUTPUT]))
            calls[0], x = counted, result.y[:, -1]
    return np.array(rows)[:, 0], calls[0]


METHODS: dict[str, Callable[[Case, Fmu, float], Solved]] = {
    OURS: _stepped,
    "CVode, model exchange": _cvode,
    "scipy Radau, model exchange": partial(_scipy, "Radau"),
    "scipy LSODA, model exchange": partial(_scipy, "LSODA"),
}


class Run(NamedTuple):
    """One run: error as a share of the range, CPU time [s], right-hand sides; inf if it failed."""

    method: str
    tolerance: float
    error: float
    seconds: float
    evaluations: float


def run(progress: Progress, quick: bool) -> Outcome:
    """Run every method at every tolerance on a sampled record and on a stiff, ringing stack."""
    tolerances = (1e-3, 1e-5, 1e-7) if quick else tuple(10.0**-k for k in range(3, 10))
    tables, ratios = [], []
    for case in cases(quick):
        progress(f"reference: {case.name}")
        truth, check = case.truth(1e-12), case.truth(1e-11)
        doubt = float(np.max(np.abs(check - truth)) / np.ptp(truth))
        runs = []
        with tempfile.TemporaryDirectory() as folder:
            path = psa.export_fmu(case.model, Path(folder) / "model.fmu")
            with Fmu(path) as fmu:
                for name, tolerance in product(METHODS, tolerances):
                    progress(f"{case.name}: {name}, {tolerance:.0e}")
                    runs.append(_measured(name, case, fmu, tolerance, truth, 1 if quick else 3))
        tables.append(_table(case, runs, doubt))
        ratios += _ratios(case, runs)
    note = (
        "CPU time of one process of one run; only the ratios carry over to other machines. All are"
        " driven from Python: co-simulation pays for it once a communication step, the others at"
        " every right-hand side, so the right-hand sides are the fairer measure of the methods"
        " themselves. They include those spent on Jacobians by differences; the FMU's solver has"
        " the exact Jacobian and evaluates it once a step, which is not counted."
    )
    at_equal = TitledTable("Work of the others at equal error", ratios, note)
    progress("cost of a step")
    return Outcome((*tables, at_equal, cost_table(50 if quick else 400)))


def cases(quick: bool) -> tuple[Case, Case]:
    """Return a multisine with rounded samples, and steps on a ringing stack with a tiny R_s."""
    ends = (0.015, 0.005) if quick else (0.025, 0.01)
    t, steps = (time_grid(end, 5e-5) for end in ends)
    ramp = np.minimum(5.0 * t / t[-1], 1.0)
    sampled = np.round(ramp * multisine(t, 0.0, 100.0, (100.0, 1000.0), seed=1), 2)
    levels = np.repeat([100.0, 180.0, 40.0, 150.0, 0.0], len(steps) // 5)
    name = f"sampled record ({len(t)} samples at 20 kHz, linear in between)"
    stiff = psa.stack_model("PTBS200").with_values({"R_s": 0.01})
    return (
        Case(name, psa.stack_model("P-885.51"), t, sampled, False),
        Case("stiff and ringing (five steps of the voltage, R_s C_p of 16 ns)",
             stiff, steps, levels, True),
    )  # fmt: skip


def _measured(
    name: str, case: Case, fmu: Fmu, tolerance: float, truth: FloatArray, repeats: int
) -> Run:
    """Return one run with the least CPU time of its repeats; a slow run has one."""
    runs: list[Solved] = []
    work = partial(METHODS[name], case, fmu, tolerance)
    try:
        ((_, seconds),) = least_times([lambda: runs.append(work())], repeats, _SLOW)
    except FmuError:
        return Run(name, tolerance, inf, inf, inf)
    x, evaluations = runs[-1]
    error = float(np.max(np.abs(x - truth)) / np.ptp(truth))
    evaluations = _stepped_count(case, tolerance) if evaluations is None else evaluations
    return Run(name, tolerance, error, seconds, evaluations or inf)


def _table(case: Case, runs: Sequence[Run], doubt: float) -> TitledTable:
    rows = [
        {"method": r.method, "required tolerance": f"{r.tolerance:.0e}",
         "largest error / range": number(r.error, 2),
         "error / tolerance": number(r.error / r.tolerance, 2),
         "CPU time [ms]": number(1e3 * r.seconds), "right-hand sides": number(r.evaluations)}
        for r in runs
    ]  # fmt: skip
    note = f"The reference at 1e-11 and at 1e-12 differ by {number(doubt, 2)} of the range."
    return TitledTable(f"Reached error and work: {case.name}", rows, note)


def work_at(runs: Sequence[Run], error: float) -> FloatArray:
    """Return CPU time [s] and right-hand sides (2,) at which a method reaches an error.

    Both are read off between the runs on either side, linear in the logarithms; inf if no run is
    as accurate, and the loosest run's where all are.
    """
    ordered = sorted((r for r in runs if r.error < inf), key=lambda r: -r.tolerance)
    if not ordered or ordered[-1].error > error:
        return np.full(2, inf)
    last = max(i for i, r in enumerate(ordered) if i == 0 or r.error > error)
    near = np.log([r[2:] for r in ordered[last : last + 2]])[::-1]  # errors that grow
    return np.array([np.exp(np.interp(np.log(error), near[:, 0], w)) for w in near[:, 1:].T])


def _ratios(case: Case, runs: Sequence[Run]) -> list[dict[str, str]]:
    """Return the work of the others over that of the FMU, at equal error."""
    rows = []
    for method, error in product(list(METHODS)[1:], _LEVELS):
        ours, theirs = (
            work_at([r for r in runs if r.method == name], error) for name in (OURS, method)
        )
        if np.all(np.isfinite([ours, theirs])):
            seconds, evaluations = (number(float(q), 2) for q in theirs / ours)
            rows.append({
                "case": case.name.partition(" (")[0], "method": method, "error": f"{error:.0e}",
                "CPU time over the FMU's": seconds, "right-hand sides over the FMU's": evaluations,
            })  # fmt: skip
    return rows


#: The step of the table [s], and its targets.
STEP, MOST_NS, MOST_RATIO = 1e-5, 400.0, 1.5
_SOURCE = Path(__file__).parents[2] / "export" / "c_host" / "step_cost.c"


def measured(model: psa.Model, repetitions: int, *, fixed: bool) -> FloatArray:
    """Return the time [ns] of every step, (2, 1000): of the generated code and of an FMU.

    The FMU is the ordinary one, or the one with a `fixed` step. The voltages are 200 of each
    reference voltage.
    """
    table = {v.name: k for k, v in enumerate(variable_table(model), start=1)}
    share = np.linspace(0.0, 1.0, 1001)[1:]
    parts = [s(share)[200 * k : 200 * (k + 1)] for k, (_, s) in enumerate(VOLTAGES.values())]
    voltage = np.asarray(model.values["u_rated"] * np.concatenate(parts)).tolist()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        psa.export_c(model, folder, step=STEP, name="stack", substeps=1)
        step = fixed_step(model, name="stack", step=STEP, substeps=1) if fixed else None
        token, texts, _ = exported_texts(model, model.name, fixed=step)
        for file, text in texts.items():
            (folder / file).write_text(text, encoding="utf-8")
        command = [*compiler_command(), *OPTIMISE, "-I.", f"-I{Path(fmpy.__file__).parent}/c-code"]
        files = [str(_SOURCE), "stack.c", *compiled_files(texts), "-lm", "-o", "step_cost"]
        run_compiler([*command, *files], folder)
        words = [token, str(repetitions), str(table["voltage"]), str(table["displacement"])]
        done = subprocess.run(
            [str(folder / "step_cost"), *words], input="\n".join(map(repr, voltage)),
            capture_output=True, text=True, check=True,
        )  # fmt: skip
    return np.array([[float(v) for v in line.split()] for line in done.stdout.splitlines()]).T


def cost_table(repetitions: int) -> TitledTable:
    """Return mean, worst and their ratio for a stack."""
    model = psa.stack_model("P-885.51").plant()
    ordinary, fixed = (measured(model, repetitions, fixed=f) for f in (False, True))
    ways = {
        "psa export c": ordinary[0], "psa export fmu --solver fixed": fixed[1],
        "psa export fmu": ordinary[1],
    }  # fmt: skip
    rows = [
        {"way": way, "mean [ns]": f"{t.mean():.0f}", "worst [ns]": f"{t.max():.0f}",
         "worst / mean": f"{t.max() / t.mean():.2f}"}
        for way, t in ways.items()
    ]  # fmt: skip
    return TitledTable(
        f"Cost of a step of {1e6 * STEP:g} us, P-885.51: ramps, holds, tones and jumps",
        rows,
        f"Target for the generated code: at most {MOST_NS:g} ns, worst over mean below"
        f" {MOST_RATIO:g}. Each step counts with the least time of its repetitions.",
    )
