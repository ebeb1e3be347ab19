"""Runs of one FMU over a record: stepped (co-simulation), or integrated (model exchange).

Model exchange has its events, and inputs as they are at every time at which the solver, fmpy's
CVode, asks for rates.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
from fmpy.sundials import CVodeSolver

from psa_casadi.common.files import temporary_folder
from psa_casadi.common.units import FloatArray
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.importer.fmu import (
    CO_SIMULATION,
    MODEL_EXCHANGE,
    NO_MESSAGE,
    Fmu,
    FmuError,
    Instance,
)
from psa_casadi.export.importer.imported import opened
from psa_casadi.model.compose import Model
from psa_casadi.simulation.start import start_state

#: Relative tolerance of a run by model exchange; CVode's.
_TOLERANCE = 1e-7
#: Steps of the solver between two samples, at most.
_MOST_STEPS = 10_000
#: Intervals that differ by this share are the same; times that differ by this share of a run are.
_SAME, _SAME_TIME = 1e-6, 1e-12


@dataclass(frozen=True, eq=False)
class Signals:
    """Inputs that are linear between knots: `times` (k,), `values` (k, nu), columns as `names`.

    With `held` they keep the value of a knot up to the next one, where they jump.
    """

    names: tuple[str, ...]
    times: FloatArray
    values: FloatArray
    held: bool = False

    def at(self, times: FloatArray | float, *, before: bool = False) -> FloatArray:
        """Return the inputs at times (n,), shape (n, nu); at a jump those after it, or `before`."""
        wanted = np.atleast_1d(np.asarray(times, dtype=float))
        if self.held:
            side: Literal["left", "right"] = "left" if before else "right"
            rounded = wanted if before else wanted * (1 + _SAME_TIME) + 1e-15
            rows = np.searchsorted(self.times, rounded, side) - 1
            return self.values[np.maximum(rows, 0)]
        columns = [np.interp(wanted, self.times, column) for column in self.values.T]
        return np.array(columns).reshape(len(self.names), len(wanted)).T

    def on(self, times: FloatArray) -> "Signals":
        """Return the signals sampled at times: what an importer that samples them passes on."""
        return Signals(self.names, times, self.at(times), self.held)

    def named(self, values: FloatArray) -> dict[str, float]:
        """Return values (nu,) of the inputs by name."""
        return dict(zip(self.names, values.tolist(), strict=True))


def communicate(
    instance: Instance, times: FloatArray, inputs: Signals, outputs: Sequence[str], *,
    settled: bool = False, centred: bool = False,
) -> FloatArray:  # fmt: skip
    """Step an initialised instance over communication points (n,); return outputs (n, ny).

    Inputs are set at the start of each step; their slope over the step is set too unless they are
    held, or the FMU takes none. Then, `centred`, their value at the middle of the step is set: held
    at that of its beginning, as importers do, they are late by half a step. Outputs are read at the
    end of each step, and at the start; with `settled` after the inputs of that time are set, which
    counts where these jump. Raises FmuError, also where the FMU ends the simulation.
    """
    at, lines = inputs.at(times), instance.fmu.takes_lines and not inputs.held
    during = at[:-1]
    if centred and not lines:
        during = inputs.at(0.5 * (times[:-1] + times[1:]))
    instance.set(inputs.named(at[0]))
    rows = [instance.get(outputs)]
    for k, (begin, end) in enumerate(pairwise(times.tolist())):
        instance.set(inputs.named(during[k]))
        if lines and inputs.names:
            instance.set_rates(inputs.named((at[k + 1] - at[k]) / (end - begin)))
        if instance.step(begin, end - begin):
            raise FmuError(f"the FMU ends the simulation at {end:g} s")
        if settled:
            instance.set(inputs.named(at[k + 1]))
        rows.append(instance.get(outputs))
    return np.array(rows)


def co_simulate(
    fmu: Fmu, times: FloatArray, inputs: Signals, outputs: Sequence[str], *,
    tolerance: float | None = None, values: Mapping[str, float] | None = None,
    settled: bool = False, centred: bool = False, **options: Any,
) -> FloatArray:  # fmt: skip
    """Run a new co-simulation instance over communication points; return outputs (n, ny)."""
    with fmu.open(CO_SIMULATION, **options) as instance:
        instance.setup(tolerance=tolerance, values=values, start_time=float(times[0]))
        return communicate(instance, times, inputs, outputs, settled=settled, centred=centred)


class _Solver(CVodeSolver):  # type: ignore[misc]
    """fmpy's CVode, with the inputs at the time of the rates, and the errors of the FMU."""

    _problem: FmuError | None = None

    def f(self, t: float, y: Any, ydot: Any, data: Any) -> int:
        """Set the inputs, then compute the rates: fmpy's has those of the step's beginning."""
        return self._answered(lambda: self._rates(t, y, ydot, data))

    def _rates(self, t: float, y: Any, ydot: Any, data: Any) -> None:
        self.set_time(t)
        self.input.apply(t)
        super().f(t, y, ydot, data)

    def g(self, t: float, y: Any, gout: Any, data: Any) -> int:
        """Compute the event indicators."""
        return self._answered(lambda: CVodeSolver.g(self, t, y, gout, data))

    def _answered(self, call: Callable[[], object]) -> int:
        """Return 0, or -1 after an error, which ctypes would only print."""
        try:
            call()
        except FmuError as error:
            self._problem = error
            return -1
        return 0

    def step(self, t: float, tNext: float) -> Any:
        """Take a step; raises the error of the FMU that ended it."""
        try:
            return super().step(t, tNext)
        except Exception as error:
            raise self._problem or error from error


def integrate(
    fmu: Fmu, times: FloatArray, inputs: Signals, outputs: Sequence[str], *,
    tolerance: float = _TOLERANCE, values: Mapping[str, float] | None = None, **options: Any,
) -> FloatArray:  # fmt: skip
    """Integrate a new model exchange instance, with its events; return outputs (n, ny) at `times`.

    At an event of the FMU they are those after it, at a jump of held inputs those before it. Raises
    FmuError, also where the FMU ends the simulation.
    """
    held, same, now = inputs.held, _SAME_TIME * (times[-1] - times[0]), float(times[0])
    starts = inputs.named(inputs.at(now)[0])
    with fmu.open(MODEL_EXCHANGE, **options) as instance:
        instance.setup(start_time=now, values={**(values or {}), **starts})
        event, fmi = instance.leave_event_mode(), instance.fmi
        two, exchange = fmu.version == 2, fmu.description.modelExchange
        finished = getattr(exchange, "completedIntegratorStepNotNeeded", None)
        needed = bool(exchange.needsCompletedIntegratorStep) and not finished

        def apply(t: float, *, event: bool = False) -> None:
            """Set the inputs of a time; held ones only at events."""
            if inputs.names and (event or not held):
                instance.set(inputs.named(inputs.at(t)[0]))

        solver = _Solver(
            nx=len(fmu.state_elements), nz=fmu.indicator_count(),
            get_x=fmi.getContinuousStates, set_x=fmi.setContinuousStates,
            get_dx=fmi.getDerivatives if two else fmi.getContinuousStateDerivatives,
            get_z=fmi.getEventIndicators, get_nominals=fmi.getNominalsOfContinuousStates,
            set_time=fmi.setTime, input=SimpleNamespace(apply=apply), startTime=now,
            maxStep=float(times[-1] - times[0]) / 50.0, relativeTolerance=tolerance,
            maxNumSteps=_MOST_STEPS,
        )  # fmt: skip
        rows = [instance.get(outputs)]
        for k, target in enumerate(times[1:].tolist(), 1):
            while now < target - same:
                happened, _, now = solver.step(now, min(target, event))
                fmi.setTime(now)
                apply(now)
                wants_event, ends = fmi.completedIntegratorStep() if needed else (False, False)
                if ends:
                    raise FmuError(f"the FMU ends the simulation at {now:g} s")
                jumps = held and now >= target - same
                if jumps:
                    rows.append(instance.get(outputs))
                if happened or wants_event or jumps or now >= event - same:
                    instance.require("EnterEventMode")
                    apply(now, event=True)
                    event = instance.leave_event_mode()
                    solver.reset(now)
            if len(rows) == k:
                rows.append(instance.get(outputs))
        return np.array(rows)


@dataclass(frozen=True, eq=False)
class Run:
    """What an FMU is to do: values before its initialization, inputs, whose knots are the samples.

    `interface` is `CO_SIMULATION` or `MODEL_EXCHANGE`. A step of co-simulation is divided into
    `parts`.
    """

    file: str
    digest: str
    interface: int
    outputs: tuple[str, ...]
    values: Mapping[str, float]
    inputs: Signals
    parts: int = 1


def play(run: Run) -> FloatArray | str:
    """Return the outputs (n, ny) at the times of a run, or why there are none."""
    reason = ""
    for options in ({}, {"loggingOn": True}):  # some give the reason only with logging
        try:
            fmu = opened(Path(run.file), run.digest)
            if run.interface == CO_SIMULATION:
                return stepped(fmu, run, **options)
            times = run.inputs.times
            return integrate(fmu, times, run.inputs, run.outputs, values=run.values, **options)
        except Exception as error:  # noqa: BLE001 - of an FMU and of fmpy, any
            reason = str(error) or type(error).__name__
        if NO_MESSAGE not in reason:
            break
    return reason


def stepped(fmu: Fmu, run: Run, **options: Any) -> FloatArray:
    """Step a new instance over a run. Raises FmuError."""
    inputs, outputs = run.inputs, run.outputs
    points = communication_points(fmu, inputs.times, run.parts)
    values = {**run.values, **inputs.named(inputs.values[0])}
    rows = co_simulate(
        fmu, points, inputs, outputs, values=values, settled=True, centred=True, **options
    )
    return Signals(outputs, points, rows).at(inputs.times)


def communication_points(fmu: Fmu, t: FloatArray, parts: int = 1) -> FloatArray:
    """Return the communication points of a run over times t (n,).

    They are the times, more where the FMU's default step is shorter, and `parts` points in each
    step; multiples of its internal step, or of one interval, where the FMU takes no other ones.
    """
    gaps = np.diff(t)
    if not len(gaps):
        return t
    most = min(fmu.experiment("stepSize") or math.inf, float(np.max(gaps))) / parts
    internal, middle = fmu.internal_step, float(np.median(gaps))
    even = bool(np.ptp(gaps) <= _SAME * middle)
    if internal:
        size = internal * max(1, math.floor(middle / parts / internal * (1 + _SAME)))
    elif fmu.description.coSimulation.canHandleVariableCommunicationStepSize:
        counts = np.ceil(gaps / most * (1 - _SAME)).astype(int).clip(1)
        inner = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(t, t[1:], counts)]  # noqa: B905
        return np.concatenate([*inner, t[-1:]])
    else:
        least = middle if even else float(np.min(gaps))
        size = least / math.ceil(least / most * (1 - _SAME) or 1)
    count = math.ceil((t[-1] - t[0]) / size * (1 - _SAME))
    return np.asarray(t[0] + size * np.arange(count + 1))


def played_on_fmu(
    model: Model, time: FloatArray, voltage: FloatArray, *, tolerance: float = 1e-7
) -> FloatArray:
    """Export a stack as an FMU, play a voltage (n,) [V] on it, return the displacement (n,) [m].

    The FMU starts in the state that rests at the first voltage and is stepped from sample to
    sample, the voltage linear in between. Raises PsaError if the FMU cannot be made or run.
    """
    u = [i.start for i in model.structure.inputs]
    u[model.input_names.index("voltage")] = float(voltage[0])
    start = dict(zip(model.state_names, start_state(model, u).x.tolist(), strict=True))
    with temporary_folder() as folder:
        path = export_fmu(model, folder / "stack.fmu", name="stack")
        with Fmu(path) as fmu:
            inputs = Signals(("voltage",), time, voltage[:, None])
            values = co_simulate(
                fmu, time, inputs, ["displacement"], tolerance=tolerance, values=start
            )
    return np.asarray(values[:, 0])
