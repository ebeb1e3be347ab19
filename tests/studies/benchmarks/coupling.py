"""A positioner of FMUs against one model of it: the error over the communication step.

Three masters step the archive that `psa export ssp` writes: fmpy's SSP reader, ecos wired by its
API, and the package's own, with inputs held over a step or with the slopes of the outputs that they
come from. The truth is one model of the same parts and wires (`connect`), integrated at 1e-10.
A second table shows at which step the contact between stack and flexure turns unstable.
"""

import ctypes
import importlib.metadata
import sys
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from math import cos, inf, isfinite, log, log10, nan, pi
from pathlib import Path
from typing import Any

import numpy as np
from fmpy.ssp.simulation import simulate_ssp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from psa_casadi.export.importer.fmu import FmuError
from psa_casadi.export.importer.masters import Signals
from psa_casadi.export.ssp.archive import export_ssp, wiring_of
from psa_casadi.export.ssp.drawing import OUTSIDE
from psa_casadi.export.ssp.steps import stable_step
from psa_casadi.model.nanopositioner import nanopositioner, positioner_plant
from psa_casadi.model.system import System
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.stepper import run as integrate
from psa_casadi.units import FloatArray
from tests.export.ssp_master import SspArchive, couple, points
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, styled, table_of

#: The system's inputs as functions of time; 0 at the start, as fmpy sets them so.
Inputs = Mapping[str, Callable[[float], float]]


def by_fmpy(
    path: Path, step: float, count: int, inputs: Inputs, outputs: Sequence[str]
) -> FloatArray:
    """Return outputs ("part.port" or of the system) at the points k step, shape (count + 1, ny).

    fmpy and ecos step all parts side by side with inputs held (Jacobi's scheme). fmpy hands the
    system's inputs on after a step, so they are given to it one step early; it writes the values at
    the end of a step beside the time of its start, which is put right here.
    """
    early = {name: partial(lambda f, t: f(t + step), f) for name, f in inputs.items()}
    rows = simulate_ssp(str(path), stop_time=(count - 0.5) * step, step_size=step, input=early)
    if len(rows) != count:
        raise RuntimeError(f"fmpy made {len(rows)} steps where {count} were asked for")
    found = np.array([rows[name] for name in outputs]).T
    return np.vstack([np.zeros(len(outputs)), found])


def load_ecos() -> Any | None:
    """Return the module ecospy, with the TBB library that it needs loaded; None if one lacks."""
    if sys.platform != "linux":
        return None
    try:
        files = importlib.metadata.files("tbb") or []
        libraries = [f for f in files if Path(str(f)).name == "libtbb.so.12"]
        if not libraries:
            return None
        ctypes.CDLL(str(libraries[0].locate()), mode=ctypes.RTLD_GLOBAL)
        return import_module("ecospy")
    except (importlib.metadata.PackageNotFoundError, ImportError, OSError):
        return None


def by_ecos(
    ecos: Any, path: Path, step: float, count: int, inputs: Inputs, outputs: Sequence[str]
) -> FloatArray:
    """Return outputs at the points k step, shape (count + 1, ny).

    The wires are those of the archive; the parameters are those that its FMUs carry.
    """
    with SspArchive(path) as archive, tempfile.TemporaryDirectory() as folder:
        with zipfile.ZipFile(path) as files:
            files.extractall(folder)
        structure = ecos.EcosSimulationStructure()
        for name in archive.fmus:
            structure.add_model(name, Path(folder) / "resources" / f"{name}.fmu")
        for wire in archive.wires:
            if OUTSIDE not in (wire.start.part, wire.end.part):
                ends = (f"{port.part}::{port.name}" for port in (wire.start, wire.end))
                structure.make_real_connection(*ends)
        outer = [w for w in archive.wires if w.start.part == OUTSIDE and w.start.name in inputs]
        wanted = ["::".join(archive.origin(name)) for name in outputs]
        simulation = ecos.EcosSimulation(step_size=step, structure=structure)
        simulation.init()
        rows = [[simulation.get_real(name) for name in wanted]]
        for k in range(count):
            for wire in outer:
                value = inputs[wire.start.name](k * step)
                simulation.set_real(f"{wire.end.part}::{wire.end.name}", value)
            simulation.step(1)
            rows.append([simulation.get_real(name) for name in wanted])
        simulation.terminate()
        simulation.free()
        structure.free()
    return np.array(rows)


_STIFFNESSES = (5e6, 2e7, 5e7, 1e8, 2e8, 5e8)
_KICK, _COUNT, _CLOSE, _LONG, _SETTLING_TOLERANCE = 1.0, 1500, 0.02, 1e-3, 1e-7
#: Ratio of one step to the next on the way up.
_WALK = 1.15
#: Share of the first roughness below which a coupling has settled.
_SETTLED = 1e-4


@dataclass(frozen=True)
class Limit:
    """The longest stable communication step [s] of one contact stiffness [N/m]."""

    stiffness: float
    slopes: bool
    predicted: float
    measured: float


def limits(system: System, path: Path, quick: bool) -> tuple[Limit, ...]:
    """Return the limits of a system with the parts `stack` and `flexure` and the input `command`.

    Contacts of several stiffnesses are tried, with inputs held and with input derivatives.
    """
    found = []
    with SspArchive(path) as archive:
        for stiffness in _STIFFNESSES[2:3] if quick else _STIFFNESSES:
            flexure = system.parts["flexure"].with_values({"k_c": stiffness})
            parts = {**system.parts, "flexure": flexure}
            wiring = wiring_of(replace(system, parts=parts))
            for slopes in (False, True):
                predicted = stable_step(wiring, rates=slopes)
                measured = _bisected(archive, predicted, {"flexure.k_c": stiffness}, slopes)
                found.append(Limit(stiffness, slopes, predicted, measured))
    return tuple(found)


def _bisected(
    archive: SspArchive, guess: float, values: Mapping[str, float], slopes: bool
) -> float:
    """Return the step between the last stable and the first unstable one, 2 percent apart.

    Infinity if none is predicted and steps of 1 ms are stable. Else the search walks up from a
    third of the guess in small strides, since longer steps than an unstable one may be stable.
    """
    if not isfinite(guess):
        return inf if settles(archive, _LONG, values, slopes=slopes) else nan
    low = guess / 3.0
    while not settles(archive, low, values, slopes=slopes):
        low /= 3.0
    high = _WALK * low
    while settles(archive, high, values, slopes=slopes):
        low, high = high, _WALK * high
    while log10(high / low) > log10(1.0 + _CLOSE):
        middle = (low * high) ** 0.5
        if settles(archive, middle, values, slopes=slopes):
            low = middle
        else:
            high = middle
    return float((low * high) ** 0.5)


def settles(archive: SspArchive, step: float, values: Mapping[str, float], *, slopes: bool) -> bool:
    """Return whether the force on the stack settles after a jump of the command.

    It does where its roughness falls, or is as small as what the parts' tolerances leave.
    """
    times = points(step, _COUNT * step)
    kick = Signals(("command",), times[:1], np.array([[_KICK]]), held=True)
    how: Any = {"rates": slopes, "values": values, "tolerance": _SETTLING_TOLERANCE}
    try:
        found = couple(archive, times, kick, ["flexure.reaction_force"], **how)[:, 0]
    except FmuError:
        return False
    rough, third = np.abs(np.diff(found, 2)), _COUNT // 3
    early, later, last = rough[:third].max(), rough[third:-third].max(), rough[-third:].max()
    return bool(last < max(later, _SETTLED * early))


def limits_table(found: tuple[Limit, ...]) -> TitledTable:
    """Return the limits, predicted and found."""

    def written(step: float) -> str:
        return number(1e6 * step) if isfinite(step) else "no limit" if step == inf else "unstable"

    return table_of(
        "Longest stable communication step",
        found,
        {
            "contact stiffness [N/um]": lambda f: number(1e-6 * f.stiffness),
            "inputs": lambda f: "input derivatives" if f.slopes else "held",
            "predicted [us]": lambda f: written(f.predicted),
            "found [us]": lambda f: written(f.measured),
        },
        "Predicted: the spectral radius of the map over one step is 1, from the parts linearised at"
        " rest. Found: the own master on the FMUs, by bisection to 2 percent."
        " Where there is no limit, steps of 1 ms were stable.",
    )


_STYLES = (("#9a6fb0", "v", 9), ("#009e73", "^", 6), ("#d55e00", "s", 5), ("#0072b2", "o", 5))


def picture(runs: Sequence["Run"], limits: Sequence[Limit]) -> Figure:
    """Return a panel for every system, and one for the stable steps."""
    cases = list(dict.fromkeys(r.case for r in runs))
    figure = Figure(figsize=(5.6 * (len(cases) + 1), 4.8), layout="constrained")
    panels = figure.subplots(1, len(cases) + 1, squeeze=False)[0]
    for axes, case in zip(panels, cases, strict=False):
        _errors(axes, [r for r in runs if r.case == case])
        styled(axes, "communication step [us]", "largest error of the position [% of range]", case)
    last = panels[-1]
    for slopes, colour, name in (
        (False, "#d55e00", "inputs held"),
        (True, "#0072b2", "input derivatives"),
    ):
        mine = [f for f in limits if f.slopes == slopes]
        x = [1e-6 * f.stiffness for f in mine]
        predicted, found = (
            [1e6 * getattr(f, of) for f in mine] for of in ("predicted", "measured")
        )
        last.loglog(x, predicted, color=colour, linewidth=1.4, label=f"{name}: predicted")
        last.loglog(x, found, "o", color=colour, markersize=6, label=f"{name}: found")
    title = "where the co-simulation turns unstable"
    styled(last, "contact stiffness [N/um]", "longest stable step [us]", title)
    ticks = [{1e6 * r.step for r in runs}] * len(cases) + [{1e-6 * f.stiffness for f in limits}]
    for axes, at in zip(panels, ticks, strict=True):
        axes.set_xticks(sorted(at), [f"{t:g}" for t in sorted(at)])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.legend(fontsize=8.5)
    return figure


def _errors(axes: Axes, runs: Sequence["Run"]) -> None:
    names = dict.fromkeys(r.master for r in runs)
    for name, (colour, marker, size) in zip(names, _STYLES, strict=False):
        mine = [r for r in runs if r.master == name]
        slope = order(mine)
        axes.loglog(
            [1e6 * r.step for r in mine], [100.0 * r.error for r in mine], color=colour,
            marker=marker, markersize=size, markerfacecolor="none" if size > 5 else colour,
            linewidth=1.4, label=name + (f" (slope {slope:.2f})" if isfinite(slope) else ""),
        )  # fmt: skip


_END, _FREQUENCY, _TRUTH_STEP, _TRUTH, _TOLERANCE = 4e-3, 250.0, 2.5e-7, 1e-10, 1e-9
_STEPS = (1e-5, 5e-6, 2.5e-6, 1.25e-6, 6.25e-7)
_SEEN = "stage_position"

FMPY, ECOS = "fmpy, inputs held", "ecos, inputs held"
HELD, SLOPES = "own master, inputs held", "own master, input derivatives"


@dataclass(frozen=True)
class Case:
    """A system, the input that drives it, and how far: a raised cosine of this height."""

    title: str
    system: System
    input: str
    height: float

    def drive(self, t: float) -> float:
        """Return the input at a time: smooth, and 0 at the start."""
        return self.height * 0.5 * (1.0 - cos(2.0 * pi * _FREQUENCY * t))

    def samples(self, times: FloatArray) -> Signals:
        """Return the input at communication points."""
        return Signals((self.input,), times, np.array([[self.drive(t)] for t in times]))


@dataclass(frozen=True)
class Run:
    """One run: the largest error of the stage's position over its range; nan if it blew up."""

    case: str
    master: str
    step: float
    error: float


def cases() -> tuple[Case, Case]:
    """Return the positioner without its controller, which is continuous, and the closed loop."""
    return (
        Case("open loop, without the controller", positioner_plant(), "command", 5.0),
        Case("closed loop, sampled every 50 us", nanopositioner(), "reference", 8e-6),
    )


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure all masters at all steps, and where the co-simulation turns unstable."""
    ecos = load_ecos()
    steps = _STEPS[1:4] if quick else _STEPS
    runs: list[Run] = []
    tables = []
    found: tuple[Limit, ...] = ()
    with tempfile.TemporaryDirectory() as folder:
        for case in cases():
            progress(f"{case.title}: one model, and the archive")
            path = export_ssp(case.system, Path(folder) / f"{case.system.name}.ssp")
            truth = one_model(case, _END)
            mine, apart = _measured(case, path, truth, steps, ecos, progress)
            runs += mine
            tables.append(_table(case, mine, apart))
            if case.input == "command":
                progress("where the co-simulation turns unstable")
                found = limits(case.system, path, quick)
    tables.append(limits_table(found))
    return Outcome(tuple(tables), partial(picture, tuple(runs), found))


def one_model(case: Case, end: float) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) and stage position (n,) of the system as one model, integrated at 1e-10."""
    model = case.system.model()
    times = points(_TRUTH_STEP, end)
    u = np.zeros((len(times), len(model.input_names)))
    u[:, model.input_names.index(case.input)] = [case.drive(t) for t in times]
    rest = np.array([s.start for s in model.structure.states])
    y = integrate(model, times, u, rest, rtol=_TRUTH).y
    return times, y[:, model.output_names.index(_SEEN)]


def _measured(
    case: Case, path: Path, truth: tuple[FloatArray, FloatArray], steps: Sequence[float],
    ecos: Any, progress: Progress,
) -> tuple[list[Run], dict[float, float]]:  # fmt: skip
    """Return the runs of all masters, and how far fmpy and ecos are apart, over the range."""
    span = float(np.ptp(truth[1]))
    runs: list[Run] = []
    apart: dict[float, float] = {}
    for step in steps:
        found: dict[str, FloatArray] = {}
        for name, master in masters(case, path, ecos).items():
            progress(f"{case.title}: {name}, {1e6 * step:g} us")
            try:
                found[name] = master(step)
            except FmuError:
                runs.append(Run(case.title, name, step, nan))
                continue
            error = largest_error(found[name], step, truth)
            runs.append(Run(case.title, name, step, error / span if error < span else nan))
        if ECOS in found:
            apart[step] = float(np.abs(found[FMPY] - found[ECOS]).max()) / span
    return runs, apart


def masters(case: Case, path: Path, ecos: Any) -> dict[str, Callable[[float], FloatArray]]:
    """Return functions from the step to the stage position at the points k step, shape (n,)."""

    def own(step: float, rates: bool) -> FloatArray:
        times = points(step, _END)
        drive = replace(case.samples(times), held=not rates)
        with SspArchive(path) as archive:
            found = couple(archive, times, drive, [_SEEN], rates=rates, tolerance=_TOLERANCE)
        return np.asarray(found[:, 0])

    def theirs(solve: Callable[..., FloatArray], step: float) -> FloatArray:
        count = round(_END / step)
        return np.asarray(solve(path, step, count, {case.input: case.drive}, [_SEEN])[:, 0])

    found: dict[str, Callable[[float], FloatArray]] = {FMPY: partial(theirs, by_fmpy)}
    if ecos is not None:
        found[ECOS] = partial(theirs, partial(by_ecos, ecos))
    return {**found, HELD: partial(own, rates=False), SLOPES: partial(own, rates=True)}


def largest_error(
    positions: FloatArray, step: float, truth: tuple[FloatArray, FloatArray]
) -> float:
    """Return the largest difference to the one model at the communication points [m]."""
    stride = round(step / _TRUTH_STEP)
    if abs(stride * _TRUTH_STEP - step) < 1e-6 * step:
        expected = truth[1][::stride][: len(positions)]
    else:
        expected = np.interp(step * np.arange(len(positions)), *truth)
    return float(np.abs(positions - expected).max())


def order(runs: Sequence[Run]) -> float:
    """Return the slope of log(error) over log(step) between the two shortest steps."""
    usable = sorted((r for r in runs if isfinite(r.error)), key=lambda r: r.step)
    if len(usable) < 2:
        return nan
    a, b = usable[:2]
    return log(b.error / a.error) / log(b.step / a.step)


def _table(case: Case, runs: Sequence[Run], apart: dict[float, float]) -> TitledTable:
    of = {(r.master, r.step): r.error for r in runs}
    names = list(dict.fromkeys(r.master for r in runs))
    rows: list[tuple[str, ...]] = []
    for step in dict.fromkeys(r.step for r in runs):
        errors = (of[name, step] for name in names)
        shares = (number(100.0 * e, 2) if isfinite(e) else "unstable" for e in errors)
        between = number(apart[step], 1) if step in apart else ""
        rows.append((number(1e6 * step, 4), *shares, between))
    slopes = (number(order([r for r in runs if r.master == n]), 3) for n in names)
    rows.append(("order", *slopes, ""))
    head = ("communication step [us]", *(f"{n} [%]" for n in names), "fmpy - ecos (of the range)")
    return TitledTable(
        f"Largest error of the stage's position, percent of its range: {case.title}",
        Table(head, tuple(rows)),
        "The truth is one model of the same parts and wires. The order is the slope between the two"
        " shortest steps. fmpy and ecos pass outputs on as they stand at the end of a step; the own"
        " master passes them on in the order in which outputs depend on inputs.",
    )
