"""FMI 3.0 instances for tests that look at every status, and at what happens within a step."""

import ctypes
from collections.abc import Callable, Mapping
from ctypes import c_bool, c_double
from functools import cache
from typing import Any, NamedTuple, Self

from psa_casadi.export.importer import fmu as importer
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, Instance
from tests.export.fmu_models import exported


class Update(NamedTuple):
    """The arguments of the callback between two steps of the FMU's solver."""

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


@cache
def loaded(name: str) -> Fmu:
    """Return a loaded FMU of a named model, once per process."""
    return Fmu(exported(name, 3))


def saved(instance: Instance) -> bytes:
    """Return an instance's state as bytes."""
    snapshot = instance.fmi.getFMUState()
    data: bytes = instance.fmi.serializeFMUState(snapshot)
    instance.fmi.freeFMUState(snapshot)
    return data


def restore(instance: Instance, data: bytes) -> None:
    """Go to a state from bytes."""
    snapshot = instance.fmi.deserializeFMUState(data)
    instance.fmi.setFMUState(snapshot)
    instance.fmi.freeFMUState(snapshot)


def try_step(instance: Instance, point: float, size: float) -> Step:
    """Do one communication step and return all its results, the status included."""
    event, end, early, reached = c_bool(), c_bool(), c_bool(), c_double()
    places = (ctypes.byref(v) for v in (event, end, early, reached))
    status = instance.call("DoStep", point, size, True, *places)
    return Step(status, event.value, end.value, early.value, reached.value)


class Instance3(importer.Instance):
    """One instance; a failed call raises FmuError, a method `try_*` returns its status.

    `watcher` is called between two steps of the solver (intermediate update) and may end the step
    there if `early`; `events` asks for event mode in co-simulation.
    """

    def __init__(
        self, fmu: Fmu, interface: int = CO_SIMULATION, *, events: bool = False,
        early: bool = True, watcher: Watcher | None = None,
    ) -> None:  # fmt: skip
        def look(_: int, *output: Any) -> None:
            *update, wanted, until = output
            end = watcher(self, Update(*update)) if watcher else None
            if end is not None:
                wanted[0], until[0] = c_bool(True), c_double(end)

        options: dict[str, Any] = {}
        if interface == CO_SIMULATION:
            options = {"eventModeUsed": events, "earlyReturnAllowed": early}
        if watcher:
            options["intermediateUpdate"] = look
        super().__init__(fmu, interface, **options)

    def start(self, values: Mapping[str, float] | None = None, **experiment: Any) -> Self:
        """Initialise with start values, into step mode or continuous-time mode."""
        self.setup(values=values, **experiment)
        if self.interface == MODEL_EXCHANGE:
            self.require("EnterContinuousTimeMode")
        return self

    def try_step(self, point: float, size: float) -> Step:
        """Do one communication step and return all its results, the status included."""
        return try_step(self, point, size)

    def try_set(self, values: Mapping[str, float]) -> int:
        """Set variables and return the status."""
        count = len(values)
        numbers = (c_double * count)(*values.values())
        return self.call("SetFloat64", self.references(list(values)), count, numbers, count)
