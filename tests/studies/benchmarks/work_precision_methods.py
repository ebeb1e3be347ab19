"""One model, one voltage, four ways to integrate it, each to the tolerance asked for.

Absolute tolerances are rtol times the nominal of each state throughout, which is what CVode in fmpy
and the FMU's own solver take.
"""

from collections.abc import Callable
from ctypes import c_size_t
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from fmpy.sundials import CVodeSolver
from scipy.integrate import solve_ivp

from psa_casadi.export.importer.fmu import MODEL_EXCHANGE, Fmu, FmuError
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.model.compose import Model
from psa_casadi.reference import simulate
from psa_casadi.simulation.stepper import run as run_stepper

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
