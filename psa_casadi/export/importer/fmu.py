"""An FMU with its binary loaded: what `check_fmu` and the small importers drive.

The version of FMI shows in the class of the instances only: every status visible, nothing hidden.
"""

from collections.abc import Mapping
from typing import Any, cast

from psa_casadi.export.importer.calls import (
    CO_SIMULATION,
    DISCARD,
    ERROR,
    MODEL_EXCHANGE,
    OK,
    WARNING,
    FloatArray,
    FmuError,
    Instance,
)
from psa_casadi.export.importer.instance2 import Callbacks, Instance2
from psa_casadi.export.importer.instance3 import Instance3
from psa_casadi.export.importer.library import Library

__all__ = [
    "CO_SIMULATION", "DISCARD", "ERROR", "MODEL_EXCHANGE", "OK", "WARNING", "Callbacks",
    "FloatArray", "Fmu", "FmuError", "Instance", "Instance2", "Instance3",
]  # fmt: skip


class Fmu(Library):
    """An FMU that gives instances; a context manager that removes the extracted files."""

    def instance(self, interface: int, **changes: Any) -> Instance:
        """Return what the FMU answers; `component` is None if it refuses."""
        return (Instance2 if self.version == 2 else Instance3)(self, interface, **changes)

    def instantiate(self, interface: int, **changes: Any) -> Instance | None:
        """Return an instance, or None if the FMU refuses; `changes` are token, name, logger."""
        instance = self.instance(interface, **changes)
        return instance if instance.component else None

    def open(self, interface: int, **changes: Any) -> Instance:
        """Return an instance; raises FmuError if the FMU refuses."""
        instance = self.instance(interface, **changes)
        if not instance.component:
            said = instance.messages or "no message"
            raise FmuError(f"the FMU gives no instance: {said}")
        return instance

    def start(
        self, interface: int, *, tolerance: float | None = None,
        values: Mapping[str, float] | None = None, start_time: float = 0.0,
        stop_time: float | None = None, **changes: Any,
    ) -> Instance:  # fmt: skip
        """Return an instance that is initialised with start values; in step or continuous mode."""
        instance = self.open(interface, **changes)
        instance.setup(
            tolerance=tolerance, start_time=start_time, stop_time=stop_time, values=values
        )
        if interface == MODEL_EXCHANGE:
            instance.require("EnterContinuousTimeMode")
        return instance

    def start3(self, interface: int, **changes: Any) -> Instance3:
        """Return an initialised instance of an FMI 3.0 FMU, with what only that version has."""
        if self.version != 3:
            raise FmuError(f"{self.path}: is of FMI {self.version}, not of FMI 3.")
        return cast(Instance3, self.start(interface, **changes))
