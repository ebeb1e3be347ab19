"""Instances of an FMI 2.0 FMU."""

import ctypes
import platform
from collections.abc import Mapping
from ctypes import c_char_p, c_double, c_int, c_size_t, c_void_p
from functools import cache

from psa_casadi.export.importer.calls import Instance
from psa_casadi.export.importer.library import Library

_LOGGER = ctypes.CFUNCTYPE(None, c_void_p, c_char_p, c_int, c_char_p, c_char_p)


class Callbacks(ctypes.Structure):
    """The struct fmi2CallbackFunctions; what is left out is NULL."""

    _fields_ = (
        ("logger", _LOGGER), ("allocate", c_void_p), ("release", c_void_p),
        ("step_finished", c_void_p), ("environment", c_void_p),
    )  # fmt: skip


class _EventInfo(ctypes.Structure):
    """The struct fmi2EventInfo."""

    _fields_ = (
        ("repeat", c_int), ("terminate", c_int), ("nominals_changed", c_int),
        ("values_changed", c_int), ("next_defined", c_int), ("next_time", c_double),
    )  # fmt: skip


@cache
def _memory() -> tuple[int | None, int | None]:
    """Return where the C library's calloc and free are: FMUs may ask for memory by these only."""
    library = ctypes.CDLL("msvcrt" if platform.system() == "Windows" else None)
    allocate, release = (ctypes.cast(f, c_void_p) for f in (library.calloc, library.free))
    return allocate.value, release.value


class Instance2(Instance):
    """One instance; `logger` is "own", "empty" (callbacks that are all NULL) or "none" (NULL)."""

    get_function, set_function = "GetReal", "SetReal"
    derivatives_function, state_word = "GetDerivatives", "FMUstate"
    deserialize_function = "DeSerializeFMUstate"
    has_input_rates = True

    def __init__(
        self, fmu: Library, interface: int, *, token: str | None = None, name: str = "check",
        logger: str = "own",
    ) -> None:  # fmt: skip
        self.fmu, self.interface = fmu, interface
        self.messages: list[str] = []
        self._logger = _LOGGER(self._log)
        own = logger == "own"
        self._callbacks = Callbacks(self._logger, *_memory()) if own else Callbacks()
        pointer = None if logger == "none" else ctypes.byref(self._callbacks)
        proof = (fmu.token if token is None else token).encode()
        self.component: int | None = fmu.library.fmi2Instantiate(
            name.encode(), interface, proof, fmu.resources.as_uri().encode(), pointer, 0, 0
        )

    def _log(self, _env: int, _name: bytes, _status: int, _category: bytes, message: bytes) -> None:
        self.messages.append((message or b"").decode(errors="replace"))

    def setup(
        self, *, tolerance: float | None = None, start_time: float = 0.0,
        stop_time: float | None = None, values: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Set up the experiment, set values, enter and leave initialization mode."""
        precise, ends = int(tolerance is not None), int(stop_time is not None)
        times = (float(start_time), ends, float(stop_time or 0.0))
        self.require("SetupExperiment", precise, float(tolerance or 0.0), *times)
        self.set(values or {})
        self.require("EnterInitializationMode")
        self.require("ExitInitializationMode")

    def counted(self, count: int) -> tuple[c_size_t, ...]:
        """Return nothing: FMI 2.0 does not pass the number of values."""
        del count
        return ()

    def step(self, point: float, size: float) -> None:
        """Do one communication step."""
        self.require("DoStep", float(point), float(size), 1)

    def update_discrete_states(self) -> list[bool]:
        """Call fmi2NewDiscreteStates and return its five flags."""
        info = _EventInfo(1, 1, 1, 1, 1, 0.0)
        self.require("NewDiscreteStates", ctypes.byref(info))
        self.next_event_time = float(info.next_time) if info.next_defined else None
        return [bool(getattr(info, name)) for name, _ in _EventInfo._fields_[:5]]

    def completed_integrator_step(self) -> tuple[bool, bool]:
        """Call fmi2CompletedIntegratorStep and return its two flags."""
        event, end = c_int(1), c_int(1)
        self.require("CompletedIntegratorStep", 1, ctypes.byref(event), ctypes.byref(end))
        return bool(event.value), bool(end.value)
