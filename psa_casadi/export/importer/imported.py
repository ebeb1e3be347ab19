"""An FMU of model exchange as compiled functions that equations can call.

    w = (x', y) = F(t, v, p),  v = (x, u)

and its derivative along a change of v and p. By v it is the FMU's directional derivative where
it has one, else a central difference; by p, whose values an FMU takes before its initialization
only, a central difference of instances that were initialised with other values.
"""

import atexit
import ctypes
import hashlib
import math
from collections.abc import Mapping, Sequence
from ctypes import c_double, c_int, c_uint, c_void_p
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import casadi as ca

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.export.importer.fmu import MODEL_EXCHANGE, Fmu, FmuError, Instance
from psa_casadi.model.component import FmuUsed, Foreign
from psa_casadi.simulation.compiler import shared_library

_PREPARE = ctypes.CFUNCTYPE(c_void_p, c_int, c_int, ctypes.POINTER(c_double))
#: Functions of `psa_imported` by version: name of a field, name in the standard.
_BOTH = {"set_time": "SetTime", "set_states": "SetContinuousStates"}
_FUNCTIONS = {
    2: {**_BOTH, "get_rates": "GetDerivatives", "set_real2": "SetReal", "get_real2": "GetReal"},
    3: {**_BOTH, "get_rates": "GetContinuousStateDerivatives", "set_real3": "SetFloat64",
        "get_real3": "GetFloat64"},
}  # fmt: skip


class TimeEventError(FmuError):
    """An FMU has events at times, which only its initialisation shows."""


class _ImportedFmu(ctypes.Structure):
    """Mirror of `psa_imported` in imported.h."""

    _fields_ = (
        ("version", c_int), ("set_time", c_void_p), ("set_states", c_void_p),
        ("get_rates", c_void_p), ("set_real2", c_void_p), ("set_real3", c_void_p),
        ("get_real2", c_void_p), ("get_real3", c_void_p), ("slope2", c_void_p),
        ("slope3", c_void_p), ("prepare", _PREPARE), ("inputs", c_void_p), ("shown", c_void_p),
        ("known", c_void_p), ("sizes", c_void_p),
    )  # fmt: skip


@dataclass(frozen=True)
class Selected:
    """The variables of an FMU that its function has, by their names in there.

    `rates` are the derivatives of the `states`; `fixed` are values of further parameters.
    """

    states: tuple[str, ...]
    rates: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    fixed: tuple[tuple[str, float], ...]


@dataclass(eq=False)
class Imported:
    """The function of one FMU with some of its variables; it lives as long as the process.

    `digest` is the SHA-256 of its file, `name` that of the function; `sizes` are the usual sizes of
    states, inputs and parameters.
    """

    fmu: Fmu
    digest: str
    name: str
    selected: Selected
    sizes: Sequence[float]
    instances: dict[tuple[int, int], Instance] = field(default_factory=dict)
    #: The FMU's message when it could not be initialised.
    refused: str = ""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle where the FMU is and what is in it: it is opened again, if it is the same."""
        path = Path(self.fmu.path).resolve()
        return _again, (path, self.digest, self.selected, self.sizes)

    @cached_property
    def path(self) -> str:
        """Where the compiled functions are."""
        s = self.selected
        sizes = {"NX": s.states, "NU": s.inputs, "NP": s.parameters, "NY": s.outputs}
        config = "".join(f"#define PSA_{k} {len(v)}\n" for k, v in sizes.items())
        text = f"#define PSA_IMPORTED_NAME {self.name}\n{config}"
        return str(shared_library({"imported_config.h": text}, ("imported.c",)))

    @cached_property
    def library(self) -> ctypes.CDLL:
        """The compiled functions, loaded, with pointers to functions and variables of the FMU."""
        s, of, fmu, version = self.selected, self.fmu.references, self.fmu, self.fmu.version
        known = {"inputs": s.inputs, "shown": (*s.rates, *s.outputs),
                 "known": (*s.states, *s.inputs)}  # fmt: skip
        arrays: dict[str, Any] = {
            name: (c_uint * len(names))(*(of[n] for n in names)) for name, names in known.items()
        }
        arrays["sizes"] = (c_double * len(self.sizes))(*self.sizes)
        functions = dict(_FUNCTIONS[version])
        if fmu.description.modelExchange.providesDirectionalDerivative:
            functions[f"slope{version}"] = "GetDirectionalDerivative"
        called = {f: getattr(fmu.library, f"fmi{version}{n}") for f, n in functions.items()}
        pointers = {k: ctypes.cast(q, c_void_p) for k, q in (called | arrays).items()}
        prepare = _PREPARE(self._prepared)
        self._kept = arrays, prepare  # C points to these
        library = ctypes.CDLL(self.path)
        library.psa_import(ctypes.byref(_ImportedFmu(version=version, prepare=prepare, **pointers)))
        return library

    @property
    def foreign(self) -> Foreign:
        """What a component declares of it."""
        s, file = self.selected, Path(self.fmu.path)
        used = FmuUsed(file.name, self.digest, s.parameters, dict(s.fixed))
        return Foreign(self.name, self._addresses, used, str(file))

    def _addresses(self) -> tuple[int, int]:  # a method, as it is pickled
        names = (self.name, f"fwd1_{self.name}")
        value, slope = (ctypes.cast(self.library[n], c_void_p).value or 0 for n in names)
        return value, slope

    @cached_property
    def function(self) -> ca.Function:
        """Casadi function (t, v, p) -> w; its derivatives are forward ones only."""
        self.library  # noqa: B018  CasADi finds it loaded
        return ca.external(self.name, self.path, {"enable_reverse": False})

    def initialised(self, parameters: Mapping[str, float], old: Instance | None = None) -> Instance:
        """Return an instance in continuous-time mode with values of parameters.

        Raises FmuError where the FMU refuses, or has events from the beginning.
        """
        instance = old or self.fmu.open(MODEL_EXCHANGE)
        if old:
            old.require("Reset")
        instance.setup(values={**dict(self.selected.fixed), **parameters})
        if instance.leave_event_mode() < math.inf:
            raise TimeEventError("the FMU announces a time event")
        return instance

    def _prepared(self, slot: int, place: int, p: "ctypes._Pointer[c_double]") -> int | None:
        names = self.selected.parameters
        values = {n: float(p[k]) for k, n in enumerate(names)}
        old = self.instances.pop((slot, place), None)
        try:
            instance = self.initialised(values, old)
        except PsaError as error:
            self.refused = str(error)
            if old:
                old.free()
            return None
        self.instances[slot, place] = instance
        return int(instance.fmi.component)


def digest_of(file: Path) -> str:
    """Return the SHA-256 of a file. Raises InputError."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); give an FMU.") from error


@cache
def opened(file: Path, digest: str) -> Fmu:
    """Return an FMU, unpacked and loaded while the process lives; once for each content."""
    del digest
    fmu = Fmu(file)
    atexit.register(fmu.__exit__)
    return fmu


@cache
def imported_of(fmu: Fmu, digest: str, selected: Selected, sizes: tuple[float, ...]) -> Imported:
    """Return the function of an FMU; one for models with the same variables and fixed values."""
    output = repr((digest, str(fmu.path), selected, sizes))
    name = f"fmu_{hashlib.sha256(output.encode()).hexdigest()[:16]}"
    return Imported(fmu, digest, name, selected, sizes)


def _again(file: Path, digest: str, selected: Selected, sizes: tuple[float, ...]) -> Imported:
    if digest_of(file) != digest:
        raise InputError(
            f"{file}: is another FMU than the one of the pickled model; put that one back."
        )
    return imported_of(opened(file, digest), digest, selected, sizes)
