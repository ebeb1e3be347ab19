"""FMI 3.0 instances for tests that look at every status."""

import ctypes
from collections.abc import Mapping
from ctypes import c_bool, c_double, c_size_t
from functools import cache
from typing import Any, Self

from psa_casadi.export.importer import instance3
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, OK, Fmu
from psa_casadi.export.importer.library import Library
from tests.fmu_models import exported


@cache
def loaded(name: str) -> Fmu:
    """Return a loaded FMU of a named model, once per process."""
    return Fmu(exported(name, 3))


class Instance3(instance3.Instance3):
    """One instance; what it does not succeed in raises FmuError, what is tried returns a status."""

    def __init__(self, fmu: Library, interface: int = CO_SIMULATION, **changes: Any) -> None:
        super().__init__(fmu, interface, **changes)

    def call(self, function: str, *arguments: Any) -> int:
        """As in the package; truth values are passed as C's."""
        passed = [c_bool(a) if isinstance(a, bool) else a for a in arguments]
        return super().call(function, *passed)

    def start(
        self, values: Mapping[str, float] | None = None, *, tolerance: float | None = None
    ) -> Self:
        """Initialise with start values, into step mode or continuous-time mode."""
        self.setup(values=values, tolerance=tolerance)
        if self.interface == MODEL_EXCHANGE:
            self.require("EnterContinuousTimeMode")
        return self

    def try_set(self, values: Mapping[str, float]) -> int:
        """Set variables and return the status."""
        numbers, count = (c_double * len(values))(*values.values()), c_size_t(len(values))
        return self.call("SetFloat64", self.references(values), count, numbers, count)

    def serialized(self) -> bytes:
        """Return the instance's state as bytes."""
        snapshot = self.save()
        data = self.serialize(snapshot)
        self.drop(snapshot)
        return data

    def try_restore(self, data: bytes) -> int:
        """Go to a state given as bytes; return the status of the first call that fails."""
        snapshot = ctypes.c_void_p()
        status = self.call("DeserializeFMUState", data, c_size_t(len(data)), ctypes.byref(snapshot))
        if status == OK:
            status = self.call("SetFMUState", snapshot)
            self.drop(snapshot)
        return status
