"""FMI 3.0 instances through their C functions, for tests that look at every status."""

import ctypes
import tempfile
from collections.abc import Callable, Mapping, Sequence
from ctypes import c_bool, c_char_p, c_double, c_int, c_int32, c_size_t, c_uint32, c_void_p
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import fmpy
import numpy as np
import numpy.typing as npt

from tests.fmu_models import exported

FloatArray = npt.NDArray[np.float64]

OK, WARNING, DISCARD, ERROR = 0, 1, 2, 3
CO_SIMULATION, MODEL_EXCHANGE = "CoSimulation", "ModelExchange"

_LOGGER = ctypes.CFUNCTYPE(None, c_void_p, c_int, c_char_p, c_char_p)
_UPDATE = ctypes.CFUNCTYPE(
    None, c_void_p, c_double, c_bool, c_bool, c_bool, c_bool,
    ctypes.POINTER(c_bool), ctypes.POINTER(c_double),
)  # fmt: skip
_FOLDER = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)


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


class Fmu3:
    """A loaded FMI 3 binary with its description."""

    def __init__(self, name: str) -> None:
        directory = Path(_FOLDER.name) / name
        fmpy.extract(str(exported(name, 3)), unzipdir=str(directory))
        self.description: Any = fmpy.read_model_description(str(directory))
        identifier = self.description.coSimulation.modelIdentifier
        binary = f"{identifier}{fmpy.sharedLibraryExtension}"
        self.library = ctypes.CDLL(str(directory / "binaries" / fmpy.platform_tuple / binary))
        self.references = {v.name: int(v.valueReference) for v in self.description.modelVariables}
        self.library.fmi3GetVersion.restype = c_char_p
        for interface in (CO_SIMULATION, MODEL_EXCHANGE, "ScheduledExecution"):
            getattr(self.library, f"fmi3Instantiate{interface}").restype = c_void_p
        self.library.fmi3FreeInstance.restype = None

    def of(self, causality: str) -> list[str]:
        """Return the names of the variables of one causality."""
        return [v.name for v in self.description.modelVariables if v.causality == causality]

    def states(self) -> list[str]:
        """Return the names of the continuous states in the order of the state vector."""
        return [u.variable.derivative.name for u in self.description.derivatives]


@cache
def loaded(name: str) -> Fmu3:
    """Return a loaded FMU of a named model, once per process."""
    return Fmu3(name)


class Instance3:
    """One instance; `messages` holds what it logged. A context manager that frees it."""

    def __init__(
        self, fmu: Fmu3, interface: str = CO_SIMULATION, *, events: bool = False,
        early: bool = True, watcher: Watcher | None = None, token: str | None = None,
        logger: bool = True, name: bytes | None = b"test",
    ) -> None:  # fmt: skip
        self.fmu, self.interface, self._watcher = fmu, interface, watcher
        self.messages: list[str] = []
        self._logger = _LOGGER(self._log) if logger else None
        self._update = _UPDATE(self._look) if watcher else None
        proof = (token if token is not None else fmu.description.instantiationToken).encode()
        head = (name, proof, None, c_bool(False), c_bool(False))
        if interface == CO_SIMULATION:
            middle: tuple[Any, ...] = (c_bool(events), c_bool(early), None, c_size_t(0))
            tail: tuple[Any, ...] = (None, self._logger, self._update)
        else:
            middle, tail = (), (None, self._logger)
        self.component: int | None = getattr(fmu.library, f"fmi3Instantiate{interface}")(
            *head, *middle, *tail
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.component:
            self.fmu.library.fmi3FreeInstance(c_void_p(self.component))
            self.component = None

    def _log(self, _environment: int, _status: int, _category: bytes, message: bytes) -> None:
        self.messages.append(message.decode())

    def _look(
        self, _environment: int, time: float, asked: bool, allowed: bool, finished: bool,
        can: bool, wanted: Any, until: Any,
    ) -> None:  # fmt: skip
        assert self._watcher is not None
        end = self._watcher(self, Update(time, asked, allowed, finished, can))
        if end is not None:
            wanted[0], until[0] = True, end

    def call(self, function: str, *arguments: Any) -> int:
        """Call fmi3 + function and return its status; floats are passed as doubles."""
        passed = [
            c_bool(a) if isinstance(a, bool) else c_double(a) if isinstance(a, float) else a
            for a in arguments
        ]
        return int(getattr(self.fmu.library, "fmi3" + function)(c_void_p(self.component), *passed))

    def must(self, function: str, *arguments: Any) -> None:
        """Call, and fail with the FMU's last message unless it succeeds."""
        status = self.call(function, *arguments)
        assert status <= WARNING, (function, status, self.messages[-1:])

    def start(
        self, values: Mapping[str, float] | None = None, *, tolerance: float | None = None
    ) -> Self:
        """Initialise with start values, into step mode or continuous-time mode."""
        self.set(values or {})
        defined = tolerance is not None
        self.must("EnterInitializationMode", defined, tolerance or 0.0, 0.0, False, 0.0)
        self.must("ExitInitializationMode")
        if self.interface == MODEL_EXCHANGE:
            self.must("EnterContinuousTimeMode")
        return self

    def references(self, names: Sequence[str]) -> Any:
        """Return the value references of names as a C array."""
        return (c_uint32 * len(names))(*[self.fmu.references[n] for n in names])

    def get(self, names: Sequence[str]) -> FloatArray:
        """Return the values of variables."""
        values = (c_double * len(names))()
        count = c_size_t(len(names))
        self.must("GetFloat64", self.references(names), count, values, count)
        return np.array(values)

    def try_set(self, values: Mapping[str, float]) -> int:
        """Set variables and return the status."""
        numbers, count = (c_double * len(values))(*values.values()), c_size_t(len(values))
        return self.call("SetFloat64", self.references(list(values)), count, numbers, count)

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables."""
        status = self.try_set(values)
        assert status <= WARNING, (values, self.messages[-1:])

    def step(self, point: float, size: float) -> Step:
        """Do one communication step."""
        event, terminate, early, reached = c_bool(), c_bool(), c_bool(), c_double()
        status = self.call(
            "DoStep", float(point), float(size), True, ctypes.byref(event),
            ctypes.byref(terminate), ctypes.byref(early), ctypes.byref(reached),
        )  # fmt: skip
        return Step(status, event.value, terminate.value, early.value, reached.value)

    def update_discrete_states(self) -> list[bool]:
        """Call fmi3UpdateDiscreteStates and return its five flags."""
        flags, time = [c_bool(True) for _ in range(5)], c_double()
        pointers = [ctypes.byref(f) for f in flags]
        self.must("UpdateDiscreteStates", *pointers, ctypes.byref(time))
        return [f.value for f in flags]

    def vector(self, function: str, count: int) -> FloatArray:
        """Return a vector that a function of model exchange fills."""
        values = (c_double * count)()
        self.must(function, values, c_size_t(count))
        return np.array(values)

    def output_rates(self, names: Sequence[str]) -> FloatArray:
        """Return the time derivatives of outputs."""
        count, values = c_size_t(len(names)), (c_double * len(names))()
        orders = (c_int32 * len(names))(*[1] * len(names))
        self.must("GetOutputDerivatives", self.references(names), count, orders, values, count)
        return np.array(values)

    def directional(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float]
    ) -> FloatArray:
        """Return the derivative of unknowns along a change of knowns."""
        return self._product("Directional", unknowns, knowns, seed, len(unknowns))

    def adjoint(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float]
    ) -> FloatArray:
        """Return the gradient with respect to knowns of a weighted sum of unknowns."""
        return self._product("Adjoint", unknowns, knowns, seed, len(knowns))

    def _product(
        self, kind: str, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float],
        size: int,
    ) -> FloatArray:  # fmt: skip
        result = (c_double * size)()
        self.must(
            f"Get{kind}Derivative",
            self.references(unknowns), c_size_t(len(unknowns)),
            self.references(knowns), c_size_t(len(knowns)),
            (c_double * len(seed))(*seed), c_size_t(len(seed)), result, c_size_t(size),
        )  # fmt: skip
        return np.array(result)

    def save(self) -> c_void_p:
        """Return a snapshot."""
        snapshot = c_void_p()
        self.must("GetFMUState", ctypes.byref(snapshot))
        return snapshot

    def serialized(self) -> bytes:
        """Return the instance's state as bytes."""
        snapshot, size = self.save(), c_size_t()
        self.must("SerializedFMUStateSize", snapshot, ctypes.byref(size))
        data = ctypes.create_string_buffer(size.value)
        self.must("SerializeFMUState", snapshot, data, size)
        self.must("FreeFMUState", ctypes.byref(snapshot))
        return data.raw

    def try_restore(self, data: bytes) -> int:
        """Go to a state given as bytes; return the status of the first call that fails."""
        snapshot = c_void_p()
        status = self.call("DeserializeFMUState", data, c_size_t(len(data)), ctypes.byref(snapshot))
        if status == OK:
            status = self.call("SetFMUState", snapshot)
            self.must("FreeFMUState", ctypes.byref(snapshot))
        return status
