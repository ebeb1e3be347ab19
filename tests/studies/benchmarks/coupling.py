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
from math import cos, inf, isfinite, log, nan, pi
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fmpy.ssp.simulation import simulate_ssp
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.export.importer.fmu import FmuError
from psa_casadi.export.importer.masters import Signals
from psa_casadi.export.ssp import OUTSIDE, stable_step, wiring_of
from psa_casadi.model.nanopositioner import positioner_plant
from psa_casadi.report.words.phrases import number
from tests.export.ssp_master import SspArchive, couple, points
from tests.studies.benchmarks.table import FloatArray, Outcome, Progress, TitledTable, styled

_END, _FREQUENCY, _TRUTH_STEP, _TRUTH, _TOLERANCE = 4e-3, 250.0, 2.5e-7, 1e-10, 1e-9
_STEPS = (1e-5, 5e-6, 2.5e-6, 1.25e-6, 6.25e-7)
_SEEN = "stage_position"

FMPY, ECOS = "fmpy, inputs held", "ecos, inputs held"
HELD, SLOPES = "own master, inputs held", "own master, input derivatives"


@dataclass(frozen=True)
class Case:
    """A system as archive and as one model, driven at an input by a raised cosine of a height.

    `truth` are times (n,) and stage position (n,) of the one model.
    """

    title: str
    path: Path
    input: str
    height: float
    truth: tuple[FloatArray, FloatArray]

    def drive(self, t: float) -> float:
        """Return the input at a time: smooth, and 0 at the start."""
        return drive(self.height, t)


def drive(height: float, t: float) -> float:
    """Return the raised cosine at a time."""
    return height * 0.5 * (1.0 - cos(2.0 * pi * _FREQUENCY * t))


def by_fmpy(case: Case, step: float) -> FloatArray:
    """Return the stage position at the points k step, (count + 1,).

    fmpy and ecos step all parts side by side with inputs held (Jacobi's scheme). fmpy hands the
    system's inputs on after a step, so they are given to it one step early; it writes the values at
    the end of a step beside the time of its start, which is put right here.
    """
    count, early = round(_END / step), {case.input: lambda t: case.drive(t + step)}
    rows = simulate_ssp(str(case.path), stop_time=(count - 0.5) * step, step_size=step, input=early)
    if len(rows) != count:
        raise RuntimeError(f"fmpy made {len(rows)} steps where {count} were asked for")
    return np.concatenate([[0.0], rows[_SEEN]])


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


def by_ecos(ecos: Any, case: Case, step: float) -> FloatArray:
    """Return the stage position at the points k step, (count + 1,).

    The wires are those of the archive; the parameters are those that its FMUs carry.
    """
    with SspArchive(case.path) as archive, tempfile.TemporaryDirectory() as folder:
        with zipfile.ZipFile(case.path) as files:
            files.extractall(folder)
        structure = ecos.EcosSimulationStructure()
        for name in archive.fmus:
            structure.add_model(name, Path(folder) / "resources" / f"{name}.fmu")
        outer = []
        for wire in archive.wires:
            ends = [f"{port.part}::{port.name}" for port in (wire.start, wire.end)]
            if OUTSIDE not in (wire.start.part, wire.end.part):
                structure.make_real_connection(*ends)
            elif (wire.start.part, wire.start.name) == (OUTSIDE, case.input):
                outer.append(ends[1])
        wanted = "::".join(archive.origin(_SEEN))
        simulation = ecos.EcosSimulation(step_size=step, structure=structure)
        simulation.init()
        shown = [simulation.get_real(wanted)]
        for k in range(round(_END / step)):
            for end in outer:
                simulation.set_real(end, case.drive(k * step))
            simulation.step(1)
            shown.append(simulation.get_real(wanted))
        simulation.terminate()
        simulation.free()
        structure.free()
    return np.array(shown)


_STIFFNESSES = (5e6, 2e7, 5e7, 1e8, 2e8, 5e8)
_KICK, _COUNT, _CLOSE, _LONG, _SETTLING_TOLERANCE = 1.0, 1500, 0.02, 1e-3, 1e-7
#: Ratio of one step to the next on the way up.
_WALK = 1.15
#: Share of the first roughness below which a coupling has settled.
_SETTLED = 1e-4


class Limit(NamedTuple):
    """The longest stable communication step [s] of one contact stiffness [N/m]."""

    stiffness: float
    slopes: bool
    predicted: float
    found: float


def limits(system: psa.System, path: Path, quick: bool) -> list[Limit]:
    """Return the limits of a system with the parts `stack` and `flexure` and the input `command`.

    Contacts of several stiffnesses are tried, with inputs held and with input derivatives.
    """
    found = []
    with SspArchive(path) as archive:
        for stiffness in _STIFFNESSES[2:3] if quick else _STIFFNESSES:
            flexure = system.parts["flexure"].with_values({"k_c": stiffness})
            wiring = wiring_of(replace(system, parts={**system.parts, "flexure": flexure}))
            for slopes in (False, True):
                predicted = stable_step(wiring, rates=slopes)
                values = {"flexure.k_c": stiffness}
                stable = partial(settles, archive, values=values, slopes=slopes)
                found.append(Limit(stiffness, slopes, predicted, _bisected(stable, predicted)))
    return found


def _bisected(stable: Callable[[float], bool], guess: float) -> float:
    """Return the step between the last stable and the first unstable one, 2 percent apart.

    Infinity if none is predicted and steps of 1 ms are stable. Else the search walks up from a
    third of the guess in small strides, since longer steps than an unstable one may be stable.
    """
    if not isfinite(guess):
        return inf if stable(_LONG) else nan
    low = guess / 3.0
    while not stable(low):
        low /= 3.0
    high = _WALK * low
    while stable(high):
        low, high = high, _WALK * high
    while high > (1.0 + _CLOSE) * low:
        middle = (low * high) ** 0.5
        low, high = (middle, high) if stable(middle) else (low, middle)
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


def limits_table(found: Sequence[Limit]) -> TitledTable:
    """Return the limits, predicted and found."""

    def written(step: float) -> str:
        return number(1e6 * step) if isfinite(step) else "no limit" if step == inf else "unstable"

    rows = [
        {"contact stiffness [N/um]": number(1e-6 * f.stiffness),
         "inputs": "input derivatives" if f.slopes else "held",
         "predicted [us]": written(f.predicted), "found [us]": written(f.found)}
        for f in found
    ]  # fmt: skip
    return TitledTable(
        "Longest stable communication step",
        rows,
        "Predicted: the spectral radius of the map over one step is 1, from the parts linearised at"
        " rest. Found: the own master on the FMUs, by bisection to 2 percent."
        " Where there is no limit, steps of 1 ms were stable.",
    )


#: Errors over the range of each master at the steps (s,) [s], nan where a run blew up.
Errors = Mapping[str, FloatArray]


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure all masters at all steps, and where the co-simulation turns unstable.

    The systems are the positioner without its controller, which is continuous, and the closed loop.
    """
    ecos, steps = load_ecos(), np.array(_STEPS[1:4] if quick else _STEPS)
    systems = {
        "open loop, without the controller": (positioner_plant(), "command", 5.0),
        "closed loop, sampled every 50 us": (psa.nanopositioner(), "reference", 8e-6),
    }
    tables, errors, found = [], {}, list[Limit]()
    with tempfile.TemporaryDirectory() as folder:
        for title, (system, given, height) in systems.items():
            progress(f"{title}: one model, and the archive")
            path = psa.export_ssp(system, Path(folder) / f"{system.name}.ssp")
            case = Case(title, path, given, height, one_model(system, given, height))
            errors[title], apart = _measured(case, steps, ecos, progress)
            tables.append(_table(title, steps, errors[title], apart))
            if given == "command":
                progress("where the co-simulation turns unstable")
                found = limits(system, path, quick)
    return Outcome((*tables, limits_table(found)), partial(picture, steps, errors, found))


def one_model(system: psa.System, given: str, height: float) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) and stage position (n,) of the system as one model, integrated at 1e-10."""
    model, times = system.model(), points(_TRUTH_STEP, _END)
    u = np.zeros((len(times), len(model.input_names)))
    u[:, model.input_names.index(given)] = [drive(height, t) for t in times]
    rest = np.array([s.start for s in model.structure.states])
    return times, psa.run(model, times, u, rest, rtol=_TRUTH).y[:, model.output_names.index(_SEEN)]


def _measured(
    case: Case, steps: FloatArray, ecos: Any, progress: Progress
) -> tuple[Errors, list[str]]:
    """Return the errors of all masters, and how far fmpy and ecos are apart, over the range."""
    span = float(np.ptp(case.truth[1]))
    masters: dict[str, Callable[[float], FloatArray]] = {FMPY: partial(by_fmpy, case)}
    masters |= {ECOS: partial(by_ecos, ecos, case)} if ecos is not None else {}
    masters |= {HELD: partial(_own, case, False), SLOPES: partial(_own, case, True)}
    errors, apart = {name: np.full(len(steps), nan) for name in masters}, []
    for k, step in enumerate(steps.tolist()):
        found: dict[str, FloatArray] = {}
        for name, master in masters.items():
            progress(f"{case.title}: {name}, {1e6 * step:g} us")
            try:
                found[name] = master(step)
            except FmuError:
                continue
            expected = np.interp(step * np.arange(len(found[name])), *case.truth)
            error = float(np.abs(found[name] - expected).max()) / span
            errors[name][k] = error if error < 1.0 else nan
        both = ECOS in found
        apart.append(number(np.abs(found[FMPY] - found[ECOS]).max() / span, 1) if both else "")
    return errors, apart


def _own(case: Case, rates: bool, step: float) -> FloatArray:
    """Return the stage position of the own master, with inputs held or with derivatives."""
    times = points(step, _END)
    samples = np.array([[case.drive(t)] for t in times])
    given = Signals((case.input,), times, samples, held=not rates)
    with SspArchive(case.path) as archive:
        found = couple(archive, times, given, [_SEEN], rates=rates, tolerance=_TOLERANCE)
    return np.asarray(found[:, 0])


def order(steps: FloatArray, errors: FloatArray) -> float:
    """Return the slope of log(error) over log(step) between the two shortest steps that ran."""
    usable = sorted((s, e) for s, e in zip(steps, errors, strict=True) if isfinite(e))
    if len(usable) < 2:
        return nan
    (a, first), (b, second) = usable[:2]
    return log(second / first) / log(b / a)


def _table(title: str, steps: FloatArray, errors: Errors, apart: Sequence[str]) -> TitledTable:
    rows = [
        {"communication step [us]": number(1e6 * step, 4)}
        | {f"{n} [%]": number(100.0 * e[k], 2) if isfinite(e[k]) else "unstable"
           for n, e in errors.items()}
        | {"fmpy - ecos (of the range)": apart[k]}
        for k, step in enumerate(steps.tolist())
    ]  # fmt: skip
    orders = [number(order(steps, e), 3) for e in errors.values()]
    rows.append(dict(zip(rows[0], ("order", *orders, ""), strict=True)))
    return TitledTable(
        f"Largest error of the stage's position, percent of its range: {title}",
        rows,
        "The truth is one model of the same parts and wires. The order is the slope between the two"
        " shortest steps. fmpy and ecos pass outputs on as they stand at the end of a step; the own"
        " master passes them on in the order in which outputs depend on inputs.",
    )


_STYLES = (("#9a6fb0", "v", 9), ("#009e73", "^", 6), ("#d55e00", "s", 5), ("#0072b2", "o", 5))


def picture(steps: FloatArray, errors: Mapping[str, Errors], found: Sequence[Limit]) -> Figure:
    """Return a panel for every system, and one for the stable steps."""
    figure = Figure(figsize=(5.6 * (len(errors) + 1), 4.8), layout="constrained")
    *panels, last = figure.subplots(1, len(errors) + 1, squeeze=False)[0]
    for axes, (title, own) in zip(panels, errors.items(), strict=True):
        for (name, e), (colour, marker, size) in zip(own.items(), _STYLES, strict=False):
            slope = order(steps, e)
            axes.loglog(
                1e6 * steps, 100.0 * e, color=colour, marker=marker, markersize=size,
                markerfacecolor="none" if size > 5 else colour, linewidth=1.4,
                label=name + (f" (slope {slope:.2f})" if isfinite(slope) else ""),
            )  # fmt: skip
        errors_label = "largest error of the position [% of range]"
        styled(axes, "communication step [us]", errors_label, title, ticks=1e6 * steps)
    for slopes, colour in ((False, "#d55e00"), (True, "#0072b2")):
        x, _, predicted, stable = np.array([f for f in found if f.slopes == slopes]).T
        name = "input derivatives" if slopes else "inputs held"
        how: Any = {"color": colour, "linewidth": 1.4}
        last.loglog(1e-6 * x, 1e6 * predicted, label=f"{name}: predicted", **how)
        last.loglog(1e-6 * x, 1e6 * stable, "o", label=f"{name}: found", **how)
    title, ticks = "where the co-simulation turns unstable", {1e-6 * f.stiffness for f in found}
    styled(last, "contact stiffness [N/um]", "longest stable step [us]", title, ticks=ticks)
    for axes in (*panels, last):
        axes.legend(fontsize=8.5)
    return figure
