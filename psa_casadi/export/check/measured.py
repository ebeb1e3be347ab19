"""The checks that touch the binaries of an FMU, in turn; their process may end in any of them."""

import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.export.check import structure
from psa_casadi.export.check.agreement import Run, Truth
from psa_casadi.export.check.binaries import binary_checks
from psa_casadi.export.check.calls import CALLS
from psa_casadi.export.check.foreign import by_standard, foreign_checks
from psa_casadi.export.check.rows import (
    BREAKDOWNS,
    LEFT_OUT,
    LEFT_OUT3,
    Check,
    CheckRow,
    Findings,
    stopped,
)
from psa_casadi.export.common.variable_table import INPUT_LINE
from psa_casadi.export.fmu.sources import fixed_step_of
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError
from psa_casadi.export.importer.masters import Signals, co_simulate, integrate

#: How far a repeated run may be off, as a share of its range, by the version of FMI: in FMI 3.0
#: inputs cannot move within a step, see `_played`.
RUN_LIMITS = {2: 1e-5, 3: 5e-4}
#: How far a repeated error may be off, as a share of what is stated.
ERROR_LIMIT = 0.02
_TOLERANCE = 1e-9
#: What a held input may move in a step, over its range; the most steps between two samples.
_STEP, _MOST_STEPS = 1e-3, 1000


@dataclass(frozen=True)
class Playback:
    """Inputs (n, nu) at times (n,) [s], start values, and what an output must be then (n,).

    With `stated`, the rms over finite samples of what is expected must be that [m]; else the
    output itself must be equal.
    """

    name: str
    times: FloatArray
    inputs: Signals
    start: Mapping[str, float]
    output: str
    expected: FloatArray
    stated: float | None = None


def played_again(fmu: Fmu, playback: Playback) -> CheckRow:
    """Return the row of a run that is repeated."""
    result = _played(fmu, playback)
    valid = np.isfinite(playback.expected)
    error = result[valid] - playback.expected[valid]
    if playback.stated is None:
        size = float(np.ptp(playback.expected[valid])) or 1.0
        largest = float(np.max(np.abs(error))) / size
        remark = f"largest difference of {playback.output} over its range"
        limit = RUN_LIMITS[fmu.version]
        return CheckRow(playback.name, largest, limit, largest <= limit, remark)
    rms = float(np.sqrt(np.mean(error**2)))
    off = abs(rms / playback.stated - 1.0) if playback.stated > 0.0 else float("inf")
    remark = f"{1e6 * rms:.4g} um rms, stated {1e6 * playback.stated:.4g} um"
    return CheckRow(playback.name, off, ERROR_LIMIT, off <= ERROR_LIMIT, remark)


def _played(fmu: Fmu, p: Playback) -> FloatArray:
    """Return the output (n,), inputs linear between the times.

    Co-simulation of FMI 3.0 has no such inputs. There they are held at the mean over a step, which
    leaves the end of the step late by half of it; from steps and half steps follows what none is.
    """

    def stepped(inputs: Signals) -> FloatArray:
        """Return the output at the times of the playback, stepped from knot to knot of inputs."""
        values = co_simulate(
            fmu, inputs.times, inputs, [p.output], tolerance=_TOLERANCE, values=dict(p.start)
        )
        return np.asarray(values[np.isin(inputs.times, p.times), 0])

    def means(parts: int) -> Signals:
        """Return inputs held at the mean of both ends of a step, of which many parts are made."""
        counts = parts * np.clip(np.ceil(moved / _STEP), 1, _MOST_STEPS).astype(int)
        steps = [
            np.linspace(a, b, m, endpoint=False)
            for a, b, m in zip(p.inputs.times, p.inputs.times[1:], counts, strict=False)
        ]
        fine = p.inputs.on(np.concatenate([*steps, p.inputs.times[-1:]]))
        ends = np.vstack([fine.values[1:], fine.values[-1:]])
        return Signals(fine.names, fine.times, 0.5 * (fine.values + ends), held=True)

    if fmu.version == 2:
        return stepped(p.inputs)
    size = np.maximum(np.ptp(p.inputs.values, axis=0), 1e-300)
    moved = np.max(np.abs(np.diff(p.inputs.values, axis=0)) / size, axis=1)
    return 2.0 * stepped(means(2)) - stepped(means(1))


_EQUATION_LIMIT = 1e-9
_LINE_LIMIT = 0.05
#: Both starts come of runs at tolerances of 1e-6 and less.
_START_LIMIT = 1e-5


@dataclass(frozen=True)
class Task:
    """What is to be checked: an FMU by its path (for messages) and its unpacked folder.

    `truth` is what to compare with, `playbacks` are runs to repeat. All checks may take `timeout`
    [s], the foreign code `memory` [bytes] in addition to Python; that is limited on Linux only.
    `key` marks the lines of its process. A `foreign` FMU is checked by the standard alone.
    """

    path: Path
    unpacked: Path
    truth: Truth | None
    timeout: float
    memory: int
    portable: bool = False
    playbacks: tuple[Playback, ...] = ()
    foreign: bool = False
    key: str = field(default_factory=lambda: secrets.token_hex(16))


def checks_of(task: Task) -> Iterator[Check]:
    """Yield the checks of an FMU that was unpacked, each to be made before the next one is taken.

    Without a model there is no truth, and nothing is compared with it.
    """
    loaded: list[Fmu] = []
    with Archive(task.path, task.unpacked) as archive:
        load = partial(_load, task, archive, loaded)
        if task.foreign:
            yield by_standard("binary loads", load, archive.version)
        else:
            yield from binary_checks(archive, portable=task.portable)
            yield Check("binary loads", load)
    for fmu in loaded:
        if task.foreign:
            yield from foreign_checks(fmu)
            continue
        fixed = fixed_step_of(fmu.directory) is not None
        left_out = (*LEFT_OUT, *LEFT_OUT3) if fixed else ()
        for check in _of_fmu(fmu, task, loaded):
            if check.name not in left_out:
                yield check


def _of_fmu(fmu: Fmu, task: Task, loaded: list[Fmu]) -> Iterator[Check]:
    """Yield the checks of a loaded FMU; they end where it gives no instance."""
    for name, kind in _INTERFACES.items():
        yield Check(name, partial(_instantiates, fmu, kind, loaded))
    if not loaded:
        return
    for name, listed in _CALLS.items():
        yield Check(name, partial(listed, fmu))
    yield Check("directional derivatives", partial(structure.directional_error, fmu), 1e-5)
    if fmu.version == 3:
        yield Check("adjoint derivatives", partial(structure.adjoint_error, fmu), 1e-10)
    if INPUT_LINE.name in fmu.references:
        yield Check("line of the input", partial(structure.input_line_error, fmu), _LINE_LIMIT)
    if task.truth:
        yield from _of_model(fmu, task.truth)
    for playback in task.playbacks:
        yield Check(playback.name, partial(played_again, fmu, playback))


def _of_model(fmu: Fmu, truth: Truth) -> Iterator[Check]:
    yield Check("start of a run", partial(structure.wrong_start, fmu, truth))
    if truth.settled_starts:
        yield Check(
            "settled start", partial(structure.settled_start_error, fmu, truth), _START_LIMIT
        )
    yield Check("event indicators of the model", partial(structure.wrong_indicators, fmu, truth))
    yield Check("equations", partial(structure.equation_error, fmu, truth), _EQUATION_LIMIT)
    for run in truth.runs:
        yield Check(run.name, partial(_compared, fmu, truth, run), run.limit)
    if truth.problem:
        remark = f"the comparison stopped: {truth.problem}"
        yield Check("trajectories", partial(stopped, "trajectories", remark))


def _compared(fmu: Fmu, truth: Truth, run: Run) -> CheckRow:
    """Return the row of a run: the largest difference over the scale, and which output has it."""
    names = truth.compared
    if run.integrated:
        values = integrate(fmu, run.times, run.inputs, names, tolerance=run.tolerance or run.limit)
    else:
        values = co_simulate(
            fmu, run.times, run.inputs, names, tolerance=run.tolerance, settled=truth.settled
        )
    scale = truth.scale if run.scale is None else run.scale
    error = np.max(np.abs(values - run.expected), axis=0) / scale
    worst = int(np.argmax(error))
    largest = float(error[worst])
    remark = f"largest in {names[worst]}, against the {run.by or truth.by}"
    return CheckRow(run.name, largest, run.limit, largest <= run.limit, remark)


def _load(task: Task, archive: Archive, loaded: list[Fmu]) -> Iterator[str]:
    """Append the FMU with its binary; what prevents that is the problem."""
    try:
        fmu = Fmu(task.path, task.unpacked)
        for interface in fmu.interfaces():
            fmu.loaded(interface)
    except BREAKDOWNS as error:
        folders = {p.parent.name for p in archive.binaries()}
        yield f"{error} (it has {', '.join(sorted(folders)) or 'none'})"
    else:
        loaded.append(fmu)


def _instantiates(fmu: Fmu, interface: int, loaded: list[Fmu]) -> Iterator[str]:
    """Make an instance; an FMU that gives none is not among the loaded ones any more."""
    try:
        fmu.open(interface).free()
    except FmuError:
        loaded.clear()
        yield "there is no instance: description and binary are not of the same export"


_INTERFACES = {
    "co-simulation instantiates": CO_SIMULATION,
    "model exchange instantiates": MODEL_EXCHANGE,
}
_CALLS: dict[str, Callable[[Fmu], Findings]] = {
    **CALLS,
    "nominal values": structure.wrong_nominals,
    "event indicators": structure.event_indicators,
    "dependencies complete": structure.incomplete_dependencies,
}
