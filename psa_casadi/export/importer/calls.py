"""One instance of an FMU through its C functions, whichever version of FMI it speaks."""

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from ctypes import c_double, c_int, c_size_t, c_uint, c_void_p
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import PsaError
from psa_casadi.export.importer.library import Library

FloatArray = npt.NDArray[np.float64]

MODEL_EXCHANGE, CO_SIMULATION = 0, 1
OK, WARNING, DISCARD, ERROR = 0, 1, 2, 3


class FmuError(PsaError):
    """A call of an FMU failed that should succeed; `status` is what it returned."""

    def __init__(self, message: str, status: int = ERROR) -> None:
        super().__init__(message)
        self.status = status


class Instance(ABC):
    """One instance; `messages` holds what it logged. A context manager that frees it.

    `call` reaches every function; the other methods mean the same in both versions. All of them
    raise FmuError unless the call succeeds.
    """

    #: Names that differ between the versions.
    get_function: ClassVar[str]
    set_function: ClassVar[str]
    derivatives_function: ClassVar[str]
    state_word: ClassVar[str]
    deserialize_function: ClassVar[str]
    #: Whether inputs can be given a rate for the next communication step.
    has_input_rates: ClassVar[bool]

    fmu: Library
    interface: int
    messages: list[str]
    component: int | None
    #: Time of the next time event that the last update in event mode announced.
    next_event_time: float | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.free()

    def free(self) -> None:
        """Free the instance; harmless when called twice."""
        if self.component:
            getattr(self.fmu.library, self.fmu.prefix + "FreeInstance")(c_void_p(self.component))
            self.component = None

    def call(self, function: str, *arguments: Any) -> int:
        """Call a function, named without prefix, and return its status; floats pass as doubles."""
        passed = [c_double(a) if isinstance(a, float) else a for a in arguments]
        called = getattr(self.fmu.library, self.fmu.prefix + function)
        return int(called(c_void_p(self.component), *passed))

    def require(self, function: str, *arguments: Any) -> None:
        """Call, and raise FmuError with the FMU's last message unless it succeeds."""
        status = self.call(function, *arguments)
        if status > WARNING:
            said = self.messages[-1] if self.messages else "no message"
            name = self.fmu.prefix + function
            raise FmuError(f"{name} returned status {status}: {said}", status)

    @abstractmethod
    def setup(
        self, *, tolerance: float | None = None, start_time: float = 0.0,
        stop_time: float | None = None, values: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Initialise: set values, enter and leave initialization mode."""

    @abstractmethod
    def counted(self, count: int) -> tuple[c_size_t, ...]:
        """Return the arguments that follow an array of values with its length: none in FMI 2."""

    @abstractmethod
    def step(self, point: float, size: float) -> None:
        """Do one communication step."""

    @abstractmethod
    def update_discrete_states(self) -> list[bool]:
        """Update in event mode; return whether to repeat, end, look at nominals, states, time.

        The time is then in `next_event_time`, which is None without one.
        """

    @abstractmethod
    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Tell that the importer's step ended; return whether to enter event mode, and to end."""

    def references(self, names: Iterable[str]) -> Any:
        """Return the value references of names as a C array."""
        numbers = [self.fmu.references[n] for n in names]
        return (c_uint * len(numbers))(*numbers)

    def get(self, names: Sequence[str]) -> FloatArray:
        """Return the values of variables."""
        return self.get_references(self.references(names))

    def get_references(self, references: Any) -> FloatArray:
        """Return the values of variables given by a C array of value references."""
        count = len(references)
        values = (c_double * count)()
        self.require(self.get_function, references, c_size_t(count), values, *self.counted(count))
        return np.array(values)

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables."""
        count = len(values)
        numbers = (c_double * count)(*values.values())
        names = self.references(values)
        self.require(self.set_function, names, c_size_t(count), numbers, *self.counted(count))

    def set_rates(self, rates: Mapping[str, float], order: int = 1) -> None:
        """Set the time derivatives of inputs for the next communication step (FMI 2.0 only)."""
        if not self.has_input_rates:
            raise FmuError("FMI 3.0 has no derivatives of inputs; hold them over a step.")
        count = len(rates)
        orders, numbers = (c_int * count)(*[order] * count), (c_double * count)(*rates.values())
        names = self.references(rates)
        self.require("SetRealInputDerivatives", names, c_size_t(count), orders, numbers)

    def output_rates(self, names: Sequence[str], order: int = 1) -> FloatArray:
        """Return the time derivatives of outputs at the end of the last communication step."""
        count = len(names)
        orders, values = (c_int * count)(*[order] * count), (c_double * count)()
        function = "GetRealOutputDerivatives" if self.fmu.version == 2 else "GetOutputDerivatives"
        wanted = self.references(names)
        self.require(function, wanted, c_size_t(count), orders, values, *self.counted(count))
        return np.array(values)

    def vector(self, function: str, count: int) -> FloatArray:
        """Return a vector that a function of model exchange fills."""
        values = (c_double * count)()
        self.require(function, values, c_size_t(count))
        return np.array(values)

    def derivatives(self, time: float, x: FloatArray, inputs: Mapping[str, float]) -> FloatArray:
        """Return x' at a time, state vector and inputs (model exchange, continuous-time mode)."""
        states = np.ascontiguousarray(x, dtype=float)
        self.require("SetTime", float(time))
        self.require("SetContinuousStates", states.ctypes.data_as(c_void_p), c_size_t(len(x)))
        self.set(inputs)
        return self.vector(self.derivatives_function, len(x))

    def directional(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float] | FloatArray
    ) -> FloatArray:
        """Return the derivative of unknowns along a change of knowns."""
        return self._product("Directional", unknowns, knowns, seed, len(unknowns))

    def _product(
        self, kind: str, unknowns: Sequence[str], knowns: Sequence[str],
        seed: Sequence[float] | FloatArray, size: int,
    ) -> FloatArray:  # fmt: skip
        result = (c_double * size)()
        self.require(
            f"Get{kind}Derivative",
            self.references(unknowns), c_size_t(len(unknowns)),
            self.references(knowns), c_size_t(len(knowns)),
            (c_double * len(seed))(*seed), *self.counted(len(seed)), result, *self.counted(size),
        )  # fmt: skip
        return np.array(result)

    def save(self) -> c_void_p:
        """Return a snapshot of the instance's state; release it with `drop`."""
        snapshot = c_void_p()
        self.require(f"Get{self.state_word}", ctypes.byref(snapshot))
        return snapshot

    def restore(self, snapshot: c_void_p) -> None:
        """Set the instance to a snapshot."""
        self.require(f"Set{self.state_word}", snapshot)

    def drop(self, snapshot: c_void_p) -> None:
        """Release a snapshot."""
        self.require(f"Free{self.state_word}", ctypes.byref(snapshot))

    def serialize(self, snapshot: c_void_p) -> bytes:
        """Return a snapshot as bytes."""
        size = c_size_t()
        self.require(f"Serialized{self.state_word}Size", snapshot, ctypes.byref(size))
        data = ctypes.create_string_buffer(size.value)
        self.require(f"Serialize{self.state_word}", snapshot, data, size)
        return data.raw

    def deserialize(self, data: bytes) -> c_void_p:
        """Return the snapshot that bytes hold; release it with `drop`."""
        snapshot, size = c_void_p(), c_size_t(len(data))
        self.require(self.deserialize_function, data, size, ctypes.byref(snapshot))
        return snapshot
