"""A positioner of FMUs against one model of it: the error over the communication step.

Three masters step the archive that `psa export ssp` writes: fmpy's SSP reader, ecos wired by its
API, and the package's own, with inputs held over a step or with the slopes of the outputs that they
come from. The truth is one model of the same parts and wires (`connect`), integrated at 1e-10.
A second table shows at which step the contact between stack and flexure turns unstable.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import cos, isfinite, log, nan, pi
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.export.importer.fmu import FmuError
from psa_casadi.export.importer.masters import Signals
from psa_casadi.export.ssp.archive import export_ssp
from psa_casadi.model.nanopositioner import nanopositioner, positioner_plant
from psa_casadi.model.system import System
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.stepper import run as integrate
from psa_casadi.units import FloatArray
from tests.export.ssp_master import SspArchive, couple, points
from tests.studies.benchmarks.coupling_figure import picture
from tests.studies.benchmarks.coupling_masters import by_ecos, by_fmpy, load_ecos
from tests.studies.benchmarks.coupling_stability import Limit, limits, limits_table
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

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
    names = list(dict.fromkeys(r.master for r in runs))
    rows = [
        (
            number(1e6 * step, 4),
            *(_share(r.error) for n in names for r in runs if (r.master, r.step) == (n, step)),
            number(apart[step], 1) if step in apart else "",
        )
        for step in dict.fromkeys(r.step for r in runs)
    ]
    slopes = (number(order([r for r in runs if r.master == n]), 3) for n in names)
    rows.append(("order", *slopes, ""))
    head = ("communication step [us]", *(f"{n} [%]" for n in names), "fmpy - ecos (of the range)")
    title = f"Largest error of the stage's position, percent of its range: {case.title}"
    return TitledTable(title, Table(head, tuple(rows)), _NOTE)


def _share(error: float) -> str:
    return number(100.0 * error, 2) if isfinite(error) else "unstable"


_NOTE = (
    "The truth is one model of the same parts and wires. The order is the slope between the two"
    " shortest steps. fmpy and ecos pass outputs on as they stand at the end of a step; the own"
    " master passes them on in the order in which outputs depend on inputs."
)
