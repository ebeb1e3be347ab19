"""Instances of an FMI 3.0 FMU."""

import ctypes
import os
from collections.abc import Callable, Mapping, Sequence
from ctypes import c_bool, c_char_p, c_double, c_int, c_size_t, c_void_p
from typing import NamedTuple

from psa_casadi.export.importer.calls import CO_SIMULATION, WARNING, FloatArray, FmuError, Instance
from psa_casadi.export.importer.library import Library

_LOGGER = ctypes.CFUNCTYPE(None, c_void_p, c_int, c_char_p, c_char_p)
_UPDATE = ctypes.CFUNCTYPE(
    None, c_void_p, c_double, c_bool, c_bool, c_bool, c_bool,
    ctypes.POINTER(c_bool), ctypes.POINTER(c_double),
)  # fmt: skip


class Update(NamedTuple):
    """What the FMU says between two steps of its solver."""

    time: float
    set_requested: bool
    get_allowed: bool
    step_finished: bool
    can_return_early: bool


class Step(NamedTuple):
    """What fmi3DoStep returned."""

    status: int
    event_needed: bool
    terminate: bool
    early: bool
    time: float


#: Called between solver steps; returns the time at which the step shall end early, or None.
Watcher = Callable[["Instance3", Update], float | None]


class Instance3(Instance):
    """One instance; `logger` is "own", or "none" for no logger.

    `watcher` is called between two steps of the solver (intermediate update) and may end the step
    there if `early`; `events` asks for event mode in co-simulation.
    """

    get_function, set_function = "GetFloat64", "SetFloat64"
    derivatives_function, state_word = "GetContinuousStateDerivatives", "FMUState"
    deserialize_function = "DeserializeFMUState"
    has_input_rates = False

    def __init__(
        self, fmu: Library, interface: int, *, token: str | None = None,
        name: str | None = "check", logger: str = "own", events: bool = False,
        early: bool = True, watcher: Watcher | None = None,
    ) -> None:  # fmt: skip
        self.fmu, self.interface, self._watcher = fmu, interface, watcher
        self.messages: list[str] = []
        self._logger = _LOGGER(self._log) if logger == "own" else None
        self._update = _UPDATE(self._look) if watcher else None
        proof = (fmu.token if token is None else token).encode()
        files = f"{fmu.resources}{os.sep}".encode()
        head = (None if name is None else name.encode(), proof, files, c_bool(False), c_bool(False))
        if interface == CO_SIMULATION:
            allowed = (c_bool(events), c_bool(early), None, c_size_t(0))
            made = fmu.library.fmi3InstantiateCoSimulation(
                *head, *allowed, None, self._logger, self._update
            )
        else:
            made = fmu.library.fmi3InstantiateModelExchange(*head, None, self._logger)
        self.component: int | None = made

    def _log(self, _environment: int, _status: int, _category: bytes, message: bytes) -> None:
        self.messages.append((message or b"").decode(errors="replace"))

    def _look(
        self, _environment: int, time: float, asked: bool, allowed: bool, finished: bool,
        can: bool, wanted: "ctypes._Pointer[c_bool]", until: "ctypes._Pointer[c_double]",
    ) -> None:  # fmt: skip
        update = Update(time, asked, allowed, finished, can)
        end = self._watcher(self, update) if self._watcher else None
        if end is not None:
            wanted[0], until[0] = c_bool(True), c_double(end)

    def setup(
        self, *, tolerance: float | None = None, start_time: float = 0.0,
        stop_time: float | None = None, values: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Set values, enter and leave initialization mode."""
        self.set(values or {})
        self.require(
            "EnterInitializationMode",
            c_bool(tolerance is not None), float(tolerance or 0.0), float(start_time),
            c_bool(stop_time is not None), float(stop_time or 0.0),
        )  # fmt: skip
        self.require("ExitInitializationMode")

    def counted(self, count: int) -> tuple[c_size_t, ...]:
        """Return the number of values, which FMI 3.0 passes after them."""
        return (c_size_t(count),)

    def try_step(self, point: float, size: float) -> Step:
        """Do one communication step and return all it says, the status included."""
        event, end, early, reached = c_bool(), c_bool(), c_bool(), c_double()
        places = (ctypes.byref(v) for v in (event, end, early, reached))
        status = self.call("DoStep", float(point), float(size), c_bool(True), *places)
        return Step(status, event.value, end.value, early.value, reached.value)

    def step(self, point: float, size: float) -> None:
        """Do one communication step."""
        status = self.try_step(point, size).status
        if status > WARNING:
            said = self.messages[-1] if self.messages else "no message"
            raise FmuError(f"fmi3DoStep returned status {status}: {said}", status)

    def update_discrete_states(self) -> list[bool]:
        """Call fmi3UpdateDiscreteStates and return its five flags."""
        flags, time = [c_bool(True) for _ in range(5)], c_double()
        places = [ctypes.byref(f) for f in flags]
        self.require("UpdateDiscreteStates", *places, ctypes.byref(time))
        self.next_event_time = time.value if flags[4].value else None
        return [f.value for f in flags]

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Call fmi3CompletedIntegratorStep and return its two flags."""
        event, end = c_bool(True), c_bool(True)
        places = (ctypes.byref(event), ctypes.byref(end))
        self.require("CompletedIntegratorStep", c_bool(True), *places)
        return event.value, end.value

    def adjoint(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float] | FloatArray
    ) -> FloatArray:
        """Return the gradient with respect to knowns of a weighted sum of unknowns."""
        return self._product("Adjoint", unknowns, knowns, seed, len(knowns))

    def number(self, function: str) -> int:
        """Return what fmi3GetNumberOf... tells."""
        count = c_size_t()
        self.require(function, ctypes.byref(count))
        return count.value
