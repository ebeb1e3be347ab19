"""An FMU with its binary loaded, and instances of it; the classes of fmpy call its functions.

Here is what fmpy lacks: variables by name, errors with the FMU's messages, statuses as numbers, and
many instances of a library that is loaded once.
"""

import ctypes
from collections.abc import Iterator, Mapping, Sequence
from contextlib import chdir
from copy import copy
from ctypes import c_double, c_uint
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import fmpy
import numpy as np
from fmpy import fmi1, fmi2, fmi3

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.export.importer.archive import Archive

MODEL_EXCHANGE, CO_SIMULATION = 0, 1
#: As often an FMU may ask for another update of its discrete states.
_UPDATES = 100
#: Message of an FMU that logs nothing when a call fails.
NO_MESSAGE = "no message"
OK, WARNING, DISCARD, ERROR = 0, 1, 2, 3

_CLASSES = {
    (2, MODEL_EXCHANGE): fmi2.FMU2Model, (2, CO_SIMULATION): fmi2.FMU2Slave,
    (3, MODEL_EXCHANGE): fmi3.FMU3Model, (3, CO_SIMULATION): fmi3.FMU3Slave,
}  # fmt: skip


class FmuError(PsaError):
    """A call of an FMU failed that should succeed; `status` is what it returned."""

    def __init__(self, message: str, status: int = ERROR) -> None:
        super().__init__(message)
        self.status = status


class Fmu(Archive):
    """An FMU that gives instances; a context manager that removes the unpacked files.

    Its binary is loaded when the first instance is made. Raises InputError if the file is no FMU.
    """

    def __init__(self, path: Path, unpacked: Path | None = None) -> None:
        super().__init__(path, unpacked)
        self._loaded: dict[int, Any] = {}
        self._groups: dict[tuple[str, ...], list[_Group]] = {}

    @property
    def library(self) -> ctypes.CDLL:
        """The binary, loaded."""
        loaded: ctypes.CDLL = self.loaded(self.interfaces()[-1]).dll
        return loaded

    def loaded(self, interface: int) -> Any:
        """Return fmpy's object with the functions of an interface, without an instance.

        Raises InputError if the FMU has no binary for this machine, or one that cannot be loaded.
        """
        if interface in self._loaded:
            return self._loaded[interface]
        folders = (fmpy.platform_tuple, fmpy.platform)[: 1 if self.version == 3 else 2]
        name = self.identifier + fmpy.sharedLibraryExtension
        places = [self.directory / "binaries" / folder / name for folder in folders]
        binary = next((p for p in places if p.is_file()), None)
        if binary is None:
            raise InputError(
                f"{self.path}: has no binary for this machine, binaries/{folders[0]}/{name}; export"
                " it for this platform."
            )
        try:
            with chdir("."):  # fmpy does not leave the folder of a library that does not load
                self._loaded[interface] = _CLASSES[self.version, interface](
                    guid=self.token, modelIdentifier=self.identifier, instanceName="psa_casadi",
                    unzipDirectory=str(self.directory.absolute()), libraryPath=str(binary),
                )  # fmt: skip
        except Exception as error:  # fmpy raises it for any fault
            raise InputError(
                f"{self.path}: its binary cannot be loaded ({error}); export it here."
            ) from error
        return self._loaded[interface]

    def groups(self, names: tuple[str, ...]) -> list["_Group"]:
        """Return the numbers of these names by the calls that get or set them."""
        if names not in self._groups:
            self._groups[names] = list(self._grouped(names))
        return self._groups[names]

    def _grouped(self, names: tuple[str, ...]) -> Iterator["_Group"]:
        calls = {"Enumeration": "Integer" if self.version == 2 else "Int64"}
        rows: dict[str, dict[int, list[int]]] = {}
        for row, name in enumerate(names):
            e = self.elements[name]
            rows.setdefault(calls.get(e.type, e.type), {}).setdefault(e.reference, []).append(row)
        for kind, variables in rows.items():
            order, places, starts = list[int](), list[int](), list[float]()
            for of in variables.values():
                order += of
                places += [len(starts) + self.elements[names[row]].place for row in of]
                starts += self.elements[names[of[0]]].starts
            references = (c_uint * len(variables))(*variables)
            yield _Group(kind, references, order, places, tuple(starts))

    def open(self, interface: int, **options: Any) -> "Instance":
        """Return an instance; raises FmuError if the FMU refuses, InputError as `loaded`."""
        return Instance(self, interface, **options)

    def start(self, interface: int, **experiment: Any) -> "Instance":
        """Return an instance that `setup` has initialised; in step or continuous mode."""
        instance = self.open(interface)
        instance.setup(**experiment)
        if interface == MODEL_EXCHANGE:
            instance.require("EnterContinuousTimeMode")
        return instance


@dataclass(frozen=True, eq=False)
class _Group:
    """Numbers that one call gets or sets: those of variables of a type.

    They are the `rows` among the wanted names, and the `places` among the values of
    the call; `starts` are all of these.
    """

    type: str
    references: Any
    rows: list[int]
    places: list[int]
    starts: tuple[float, ...]


class Instance:
    """One instance; `messages` holds what it logged. A context manager that frees it.

    `fmi` is fmpy's object, `options` are those of its `instantiate`. All methods but `call` raise
    FmuError unless the FMU succeeds.
    """

    def __init__(self, fmu: Fmu, interface: int, **options: Any) -> None:
        self.fmu, self.interface = fmu, interface
        self.messages: list[str] = []
        #: Time of the next time event that the last update in event mode announced.
        self.next_event_time: float | None = None
        self.fmi = copy(fmu.loaded(interface))
        self.fmi._call = self._call
        logging: dict[str, Any] = {"logMessage": self._log}
        if fmu.version == 2:
            memory = fmi2.defaultCallbacks.allocateMemory, fmi2.defaultCallbacks.freeMemory
            logger = fmi2.fmi2CallbackLoggerTYPE(self._log)
            logging = {"callbacks": fmi2.fmi2CallbackFunctions(logger, *memory)}
        try:
            self.fmi.instantiate(**{**logging, **options})
        except Exception as error:  # fmpy's only one
            logged = self.messages or NO_MESSAGE
            raise FmuError(f"the FMU gives no instance: {logged}") from error

    def _log(self, *arguments: Any) -> None:
        self.messages.append((arguments[-1] or b"").decode(errors="replace"))

    def _call(self, function: str, *arguments: Any) -> Any:
        """Call a function in the place of fmpy's method of this name."""
        try:
            return type(self.fmi)._call(self.fmi, function, *arguments)
        except fmi1.FMICallException as error:
            logged = self.messages[-1] if self.messages else NO_MESSAGE
            text = f"{function} returned status {error.status}: {logged}"
            raise FmuError(text, error.status) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.free()

    def free(self) -> None:
        """Free the instance; harmless when called twice."""
        if self.fmi.component:
            self.require("FreeInstance")
            self.fmi.component = None

    def call(self, function: str, *arguments: Any) -> int:
        """Call a function, named without prefix, and return its status."""
        try:
            return int(self.require(function, *arguments))
        except FmuError as error:
            return error.status

    def require(self, function: str, *arguments: Any) -> Any:
        """Call a function, named without prefix; raises FmuError unless it succeeds."""
        called = getattr(self.fmi, f"fmi{self.fmu.version}{function}")
        return called(self.fmi.component, *arguments)

    def setup(
        self, *, tolerance: float | None = None, start_time: float = 0.0,
        stop_time: float | None = None, values: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Initialise: set values, enter and leave initialization mode."""
        experiment = {"tolerance": tolerance, "startTime": start_time, "stopTime": stop_time}
        if self.fmu.version == 2:
            self.fmi.setupExperiment(**experiment)
            experiment = {}
        self.set(values or {})
        self.fmi.enterInitializationMode(**experiment)
        self.fmi.exitInitializationMode()

    def references(self, names: Sequence[str]) -> Any:
        """Return the value references of names as a C array."""
        return (c_uint * len(names))(*(self.fmu.references[n] for n in names))

    def get(self, names: Sequence[str]) -> FloatArray:
        """Return the values of variables whose type is a number, and of elements of arrays."""
        result = np.empty(len(names))
        for g in self.fmu.groups(tuple(names)):
            sizes = () if self.fmu.version == 2 else (len(g.starts),)
            values = getattr(self.fmi, f"get{g.type}")(g.references, *sizes)
            result[g.rows] = np.array(values, dtype=float)[g.places]
        return result

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables; elements of arrays without a value here are set to their starts."""
        numbers = np.array(list(values.values()), dtype=float)
        for g in self.fmu.groups(tuple(values)):
            every = np.array(g.starts)
            every[g.places] = numbers[g.rows]
            real = g.type in ("Real", "Float64", "Float32")
            whole = every if real else [int(v) for v in np.rint(every)]
            getattr(self.fmi, f"set{g.type}")(g.references, whole)

    def step(self, point: float, size: float) -> bool:
        """Do one communication step; return whether the FMU ends the simulation (FMI 3.0)."""
        done = self.fmi.doStep(point, size)
        return bool(done and done[1])

    def set_rates(self, rates: Mapping[str, float]) -> None:
        """Set the time derivatives of inputs for the next communication step (FMI 2.0 only)."""
        names = self.references(list(rates))
        self.fmi.setRealInputDerivatives(names, [1] * len(rates), list(rates.values()))

    def output_rates(self, names: Sequence[str]) -> FloatArray:
        """Return the time derivatives of outputs at the end of the last communication step."""
        two = self.fmu.version == 2
        read = self.fmi.getRealOutputDerivatives if two else self.fmi.getOutputDerivatives
        return np.array(read(self.references(names), [1] * len(names)))

    def update_discrete_states(self) -> list[bool]:
        """Update in event mode; return whether to repeat, end, look at nominals, states, time.

        The time is then in `next_event_time`, which is None without one.
        """
        two = self.fmu.version == 2
        *flags, time = (self.fmi.newDiscreteStates if two else self.fmi.updateDiscreteStates)()
        self.next_event_time = time if flags[4] else None
        return [bool(flag) for flag in flags]

    def leave_event_mode(self) -> float:
        """Update in event mode and leave it; return the time of the next time event, else infinity.

        Raises FmuError where the updates have no end, or end the simulation.
        """
        for _ in range(_UPDATES):
            again, end, *_ = self.update_discrete_states()
            if end:
                raise FmuError("the FMU ends the simulation at an event")
            if not again:
                break
        else:
            raise FmuError("the FMU updates its discrete states without end")
        self.require("EnterContinuousTimeMode")
        return np.inf if self.next_event_time is None else self.next_event_time

    def vector(self, function: str, count: int) -> FloatArray:
        """Return a vector that a function of model exchange fills."""
        values = (c_double * count)()
        self.require(function, values, count)
        return np.array(values)

    def derivatives(self, time: float, x: FloatArray, inputs: Mapping[str, float]) -> FloatArray:
        """Return x' at a time, state vector and inputs (model exchange, continuous-time mode)."""
        self.fmi.setTime(float(time))
        self.fmi.setContinuousStates((c_double * len(x))(*x), len(x))
        self.set(inputs)
        two = self.fmu.version == 2
        return self.vector("GetDerivatives" if two else "GetContinuousStateDerivatives", len(x))

    def directional(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float] | FloatArray
    ) -> FloatArray:
        """Return the derivative of unknowns along a change of knowns."""
        names = self.references(unknowns), self.references(knowns)
        return np.array(self.fmi.getDirectionalDerivative(*names, list(seed)))

    def adjoint(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float] | FloatArray
    ) -> FloatArray:
        """Return the gradient with respect to knowns of a weighted sum of unknowns (FMI 3.0)."""
        names = self.references(unknowns), self.references(knowns)
        return np.array(self.fmi.getAdjointDerivative(*names, list(seed), len(knowns)))
