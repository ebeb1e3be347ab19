"""One run of an FMU over a record, in a process that may end with it.

Co-simulation is stepped with inputs at their mean over a step: held at the value of its beginning,
as importers do, they are late by half a step. Model exchange has its events, and inputs as they are
at every time at which the solver, fmpy's CVode, asks for rates.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from fmpy.sundials import CVodeSolver

from psa_casadi.common.units import FloatArray
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, NO_MESSAGE, Fmu, FmuError
from psa_casadi.export.importer.imported import opened
from psa_casadi.export.importer.masters import Signals

#: Relative tolerance of a run by model exchange; CVode's.
_TOLERANCE = 1e-7
#: Steps of the solver between two samples, at most.
_MOST_STEPS = 10_000
#: Intervals that differ by this share are the same.
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Run:
    """What an FMU is to do: values before its initialization, inputs u (n, nu) at times t (n,).

    `interface` is `CO_SIMULATION` or `MODEL_EXCHANGE`; between samples inputs are straight lines,
    or held (`hold` "zero"). A step of co-simulation is divided into `parts`.
    """

    file: str
    digest: str
    interface: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    values: Mapping[str, float]
    t: FloatArray
    u: FloatArray
    hold: str
    parts: int = 1


def play(run: Run) -> FloatArray | str:
    """Return the outputs (n, ny) at the times of a run, or why there are none."""
    try:
        return _played(run)
    except Exception as error:  # noqa: BLE001 - of an FMU and of fmpy, any
        if NO_MESSAGE not in str(error):
            return str(error) or type(error).__name__
    try:  # once more: some give the reason only with logging
        return _played(run, loggingOn=True)
    except Exception as error:  # noqa: BLE001
        return str(error)


def _played(run: Run, **options: Any) -> FloatArray:
    fmu = opened(Path(run.file), run.digest)
    way = stepped if run.interface == CO_SIMULATION else _integrated
    return way(fmu, run, **options)


def stepped(fmu: Fmu, run: Run, **options: Any) -> FloatArray:
    """Step a new instance over a run. Raises FmuError."""
    points, names = communication_points(fmu, run.t, run.parts), run.inputs
    rates = bool(getattr(fmu.description.coSimulation, "canInterpolateInputs", False))
    lines = run.hold != "zero"
    at = _inputs(run, points)
    middle = _inputs(run, 0.5 * (points[:-1] + points[1:]))
    during = at[:-1] if rates and lines else middle
    table = {**run.values, **dict(zip(names, at[0].tolist(), strict=True))}
    result = np.empty((len(points), len(run.outputs)))
    with fmu.open(CO_SIMULATION, **options) as instance:
        instance.setup(values=table, start_time=float(points[0]))
        result[0] = instance.get(run.outputs)
        for k, (begin, end) in enumerate(pairwise(points.tolist())):
            instance.set(dict(zip(names, during[k].tolist(), strict=True)))
            if rates and lines and names:
                slopes = (at[k + 1] - at[k]) / (end - begin)
                instance.set_rates(dict(zip(names, slopes.tolist(), strict=True)))
            done = instance.fmi.doStep(begin, end - begin)
            if done is not None and done[1]:
                raise FmuError(f"the FMU ends the simulation at {end:g} s")
            instance.set(dict(zip(names, at[k + 1].tolist(), strict=True)))
            result[k + 1] = instance.get(run.outputs)
    columns = [np.interp(run.t, points, column) for column in result.T]
    return np.array(columns).reshape(len(run.outputs), len(run.t)).T


def communication_points(fmu: Fmu, t: FloatArray, parts: int = 1) -> FloatArray:
    """Return the communication points of a run over times t (n,).

    They are the times, more where the FMU's default step is shorter, and `parts` points in each
    step; multiples of its internal step, or of one interval, where the FMU takes no other ones.
    """
    co, gaps = fmu.description.coSimulation, np.diff(t)
    if not len(gaps):
        return t
    most = min(fmu.experiment("stepSize") or math.inf, float(np.max(gaps))) / parts
    internal, middle = fmu.internal_step, float(np.median(gaps))
    even = bool(np.ptp(gaps) <= _SAME * middle)
    if internal:
        size = internal * max(1, math.floor(middle / parts / internal * (1 + _SAME)))
    elif co.canHandleVariableCommunicationStepSize:
        counts = np.ceil(gaps / most * (1 - _SAME)).astype(int).clip(1)
        inner = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(t, t[1:], counts)]  # noqa: B905
        return np.concatenate([*inner, t[-1:]])
    else:
        least = middle if even else float(np.min(gaps))
        size = least / math.ceil(least / most * (1 - _SAME) or 1)
    count = math.ceil((t[-1] - t[0]) / size * (1 - _SAME))
    return np.asarray(t[0] + size * np.arange(count + 1))


def _inputs(run: Run, times: FloatArray) -> FloatArray:
    """Return the inputs (m, nu) at times (m,); held ones after a jump, but for rounding."""
    held = run.hold == "zero"
    wanted = times * (1 + 1e-12) + 1e-15 if held else times
    return Signals(run.inputs, run.t, run.u, held).at(wanted)


class _Solver(CVodeSolver):  # type: ignore[misc]
    """fmpy's CVode, with the inputs of the time at which it asks for rates."""

    def f(self, t: float, y: Any, ydot: Any, data: Any) -> int:
        """Set the inputs, then compute the rates: fmpy's has those of the step's beginning."""
        self.input.apply(t)
        return int(super().f(t, y, ydot, data))


def _integrated(fmu: Fmu, run: Run, **options: Any) -> FloatArray:
    """Integrate a new instance of model exchange over a run, with its events. Raises FmuError."""
    t = run.t.tolist()
    with fmu.open(MODEL_EXCHANGE, **options) as instance:
        starts = dict(zip(run.inputs, run.u[0].tolist(), strict=True))
        instance.setup(start_time=t[0], values={**run.values, **starts})
        event, fmi = instance.leave_event_mode(), instance.fmi
        two, output = fmu.version == 2, fmu.description.modelExchange
        finished = getattr(output, "completedIntegratorStepNotNeeded", None)
        needed = bool(output.needsCompletedIntegratorStep) and not finished

        def apply(t: float, *, event: bool = False) -> None:
            """Set the inputs of a time; held ones only at events."""
            if run.inputs and (event or run.hold != "zero"):
                values = _inputs(run, np.array([t]))[0].tolist()
                instance.set(dict(zip(run.inputs, values, strict=True)))

        solver = _Solver(
            nx=len(fmu.state_elements), nz=fmu.indicator_count(),
            get_x=fmi.getContinuousStates, set_x=fmi.setContinuousStates,
            get_dx=fmi.getDerivatives if two else fmi.getContinuousStateDerivatives,
            get_z=fmi.getEventIndicators, get_nominals=fmi.getNominalsOfContinuousStates,
            set_time=fmi.setTime, input=SimpleNamespace(apply=apply), startTime=t[0],
            maxStep=(t[-1] - t[0]) / 50.0, relativeTolerance=_TOLERANCE, maxNumSteps=_MOST_STEPS,
        )  # fmt: skip
        rows = [instance.get(run.outputs)]
        now, same = t[0], 1e-12 * (t[-1] - t[0])
        for target in t[1:]:
            while now < target - same:
                stop = min(target, event)
                happened, _, now = solver.step(now, stop)
                fmi.setTime(now)
                apply(now)
                wants_event, ends = fmi.completedIntegratorStep() if needed else (False, False)
                if ends:
                    raise FmuError(f"the FMU ends the simulation at {now:g} s")
                jumps = run.hold == "zero" and now >= target - same
                if happened or wants_event or jumps or now >= event - same:
                    if jumps:
                        rows.append(instance.get(run.outputs))
                    instance.require("EnterEventMode")
                    apply(now, event=True)
                    event = instance.leave_event_mode()
                    solver.reset(now)
            if len(rows) < 1 + t.index(target):
                rows.append(instance.get(run.outputs))
        return np.array(rows)
