"""Instances of an FMI 2.0 FMU through its C functions: every status visible, nothing hidden.

It is what `check_fmu` drives an FMU with; `fmu_masters` builds two small importers on it.
"""

import ctypes
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from ctypes import c_char_p, c_double, c_int, c_size_t, c_uint, c_void_p
from pathlib import Path
from typing import Any, Self

import fmpy
import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError, PsaError
from psa_casadi.export.fmi2_functions import FUNCTIONS

FloatArray = npt.NDArray[np.float64]

MODEL_EXCHANGE, CO_SIMULATION = 0, 1
OK, WARNING, DISCARD, ERROR = 0, 1, 2, 3

_LOGGER = ctypes.CFUNCTYPE(None, c_void_p, c_char_p, c_int, c_char_p, c_char_p)


class Callbacks(ctypes.Structure):
    """The struct fmi2CallbackFunctions; what is left out is NULL."""

    _fields_ = (
        ("logger", _LOGGER), ("allocate", c_void_p), ("release", c_void_p),
        ("step_finished", c_void_p), ("environment", c_void_p),
    )  # fmt: skip


class FmuError(PsaError):
    """A call of an FMU failed that should succeed."""


class Fmu:
    """An extracted FMU with its binary loaded; a context manager that removes the extracted files.

    `references` maps variable names to value references, `description` is fmpy's record of the XML.

    Raises InputError if the file is no FMU or has no binary for this machine.
    """

    def __init__(self, path: Path) -> None:
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        try:
            self.directory = Path(fmpy.extract(str(path), unzipdir=self._folder.name))
            self.description: Any = fmpy.read_model_description(str(self.directory), validate=False)
        except Exception as error:  # fmpy raises it for any damage
            self._folder.cleanup()
            problem = f"{path}: cannot be read as an FMU ({error}); export it again."
            raise InputError(problem) from error
        interface = self.description.coSimulation or self.description.modelExchange
        folders = (fmpy.platform, fmpy.platform_tuple)
        binaries = self.directory / "binaries"
        library = interface.modelIdentifier + fmpy.sharedLibraryExtension
        found = [n for n in (binaries / f / library for f in folders) if n.is_file()]
        if not found:
            self._folder.cleanup()
            raise InputError(
                f"{path}: has no binary for {fmpy.platform_tuple}; export it for this platform."
            )
        try:
            self.library = ctypes.CDLL(str(found[0]))
        except OSError as error:
            self._folder.cleanup()
            raise InputError(
                f"{path}: its binary cannot be loaded ({error}); export it here."
            ) from error
        self.references = {v.name: int(v.valueReference) for v in self.description.modelVariables}
        self.nominals = {v.name: float(v.nominal or 1.0) for v in self.description.modelVariables}
        for name in (n for n in FUNCTIONS if hasattr(self.library, "fmi2" + n)):
            getattr(self.library, "fmi2" + name).restype = c_int
        for name, kind in (("Instantiate", c_void_p), ("FreeInstance", None),
                           ("GetVersion", c_char_p), ("GetTypesPlatform", c_char_p)):  # fmt: skip
            if hasattr(self.library, "fmi2" + name):
                getattr(self.library, "fmi2" + name).restype = kind

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    @property
    def step_size(self) -> float:
        """Step size of the default experiment [s], 1 ms if there is none."""
        return float(getattr(self.description.defaultExperiment, "stepSize", None) or 1e-3)

    def names(self, causality: str) -> list[str]:
        """Return the names of the variables of one causality, in the order of the description."""
        return [v.name for v in self.description.modelVariables if v.causality == causality]

    def states(self) -> list[str]:
        """Return the names of the continuous states, in the order of the state vector."""
        return [u.variable.derivative.name for u in self.description.derivatives]

    def instantiate(self, interface: int, **changes: Any) -> "Instance | None":
        """Return an instance, or None if the FMU refuses; `changes` are guid, name, callbacks."""
        instance = Instance(self, interface, **changes)
        return instance if instance.component else None

    def open(self, interface: int) -> "Instance":
        """Return an instance; raises FmuError if the FMU refuses."""
        instance = Instance(self, interface)
        if not instance.component:
            raise FmuError(f"fmi2Instantiate returned NULL: {instance.messages or 'no message'}")
        return instance

    def start(
        self,
        interface: int,
        *,
        tolerance: float | None = None,
        values: Mapping[str, float] | None = None,
        start_time: float = 0.0,
    ) -> "Instance":
        """Return an instance that is initialised with start values; in step or continuous mode."""
        instance = self.open(interface)
        defined = int(tolerance is not None)
        instance.require("SetupExperiment", defined, tolerance or 0.0, start_time, 0, 0.0)
        instance.set(values or {})
        instance.require("EnterInitializationMode")
        instance.require("ExitInitializationMode")
        if interface == MODEL_EXCHANGE:
            instance.require("EnterContinuousTimeMode")
        return instance


class Instance:
    """One instance; `messages` holds what it logged. A context manager that frees it."""

    def __init__(
        self, fmu: Fmu, interface: int, *, guid: str | None = None, name: str = "check",
        callbacks: Callbacks | str | None = "own",
    ) -> None:  # fmt: skip
        self.fmu = fmu
        self.messages: list[str] = []
        self._logger = _LOGGER(self._log)
        own = Callbacks(self._logger)
        chosen = own if callbacks == "own" else callbacks
        self._callbacks = chosen
        pointer = ctypes.byref(chosen) if isinstance(chosen, Callbacks) else None
        token = (guid if guid is not None else fmu.description.guid).encode()
        self.component: int | None = fmu.library.fmi2Instantiate(
            name.encode(), interface, token, b"", pointer, 0, 0
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.free()

    def _log(self, _env: int, _name: bytes, _status: int, _category: bytes, message: bytes) -> None:
        self.messages.append((message or b"").decode(errors="replace"))

    def free(self) -> None:
        """Free the instance; harmless when called twice."""
        if self.component:
            self.fmu.library.fmi2FreeInstance(c_void_p(self.component))
            self.component = None

    def call(self, function: str, *arguments: Any) -> int:
        """Call `fmi2` + function and return its status; Python floats are passed as doubles."""
        passed = [c_double(a) if isinstance(a, float) else a for a in arguments]
        called = getattr(self.fmu.library, "fmi2" + function)
        return int(called(c_void_p(self.component), *passed))

    def require(self, function: str, *arguments: Any) -> None:
        """Call, and raise FmuError with the FMU's last message unless it succeeds."""
        status = self.call(function, *arguments)
        if status > WARNING:
            said = self.messages[-1] if self.messages else "no message"
            raise FmuError(f"fmi2{function} returned status {status}: {said}")

    def references(self, names: Iterable[str]) -> Any:
        """Return the value references of names as a C array."""
        numbers = [self.fmu.references[n] for n in names]
        return (c_uint * len(numbers))(*numbers)

    def get(self, names: Sequence[str]) -> FloatArray:
        """Return the values of variables."""
        values = (c_double * len(names))()
        self.require("GetReal", self.references(names), c_size_t(len(names)), values)
        return np.array(values)

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables."""
        numbers = (c_double * len(values))(*values.values())
        self.require("SetReal", self.references(values), c_size_t(len(values)), numbers)

    def set_rates(self, rates: Mapping[str, float]) -> None:
        """Set the time derivatives of inputs for the next communication step."""
        count = len(rates)
        first, numbers = (c_int * count)(*[1] * count), (c_double * count)(*rates.values())
        names = self.references(rates)
        self.require("SetRealInputDerivatives", names, c_size_t(count), first, numbers)

    def output_rates(self, names: Sequence[str]) -> FloatArray:
        """Return the time derivatives of outputs at the end of the last communication step."""
        count = len(names)
        first, values = (c_int * count)(*[1] * count), (c_double * count)()
        wanted = self.references(names)
        self.require("GetRealOutputDerivatives", wanted, c_size_t(count), first, values)
        return np.array(values)

    def step(self, point: float, size: float) -> None:
        """Do one communication step."""
        self.require("DoStep", float(point), float(size), 1)

    def derivatives(self, time: float, x: FloatArray, inputs: Mapping[str, float]) -> FloatArray:
        """Return x' at a time, state vector and inputs (model exchange, continuous-time mode)."""
        count = c_size_t(len(x))
        result = np.empty(len(x))
        states = np.ascontiguousarray(x, dtype=float)
        self.require("SetTime", float(time))
        self.require("SetContinuousStates", states.ctypes.data_as(c_void_p), count)
        self.set(inputs)
        self.require("GetDerivatives", result.ctypes.data_as(c_void_p), count)
        return result

    def save(self) -> c_void_p:
        """Return a snapshot of the instance's state; release it with `drop`."""
        snapshot = c_void_p()
        self.require("GetFMUstate", ctypes.byref(snapshot))
        return snapshot

    def restore(self, snapshot: c_void_p) -> None:
        """Set the instance to a snapshot."""
        self.require("SetFMUstate", snapshot)

    def drop(self, snapshot: c_void_p) -> None:
        """Release a snapshot."""
        self.require("FreeFMUstate", ctypes.byref(snapshot))

    def serialize(self, snapshot: c_void_p) -> bytes:
        """Return a snapshot as bytes."""
        size = c_size_t()
        self.require("SerializedFMUstateSize", snapshot, ctypes.byref(size))
        data = ctypes.create_string_buffer(size.value)
        self.require("SerializeFMUstate", snapshot, data, size)
        return data.raw

    def deserialize(self, data: bytes) -> c_void_p:
        """Return the snapshot that bytes hold; release it with `drop`."""
        snapshot = c_void_p()
        self.require("DeSerializeFMUstate", data, c_size_t(len(data)), ctypes.byref(snapshot))
        return snapshot
