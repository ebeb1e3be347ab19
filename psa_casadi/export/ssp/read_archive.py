"""An SSP archive read back: its FMUs loaded, its wires, the values of its parameter sets."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from fmpy.ssp.ssd import read_ssd

from psa_casadi.errors import InputError
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.unpack import unpack
from psa_casadi.export.ssp.layout import OUTSIDE, Port, Wire
from psa_casadi.scratch import temporary_folder


class SspArchive:
    """An SSP archive with its FMUs loaded; a context manager that removes what it extracted.

    `name` is that of the system, `wires` its connections, `parameters` the values that its
    parameter sets give to each part, `fmus` the loaded parts.

    Raises InputError if the file is no SSP archive of FMUs of FMI 2.0.
    """

    def __init__(self, path: Path) -> None:
        self._held = ExitStack()
        folder = self._held.enter_context(temporary_folder())
        try:
            unpack(path, folder)
            system: Any = read_ssd(str(path)).system
        except Exception as error:  # fmpy raises it for any damage
            self._held.close()
            problem = f"{path}: cannot be read as an SSP archive ({error}); export it again."
            raise InputError(problem) from error
        try:
            self.fmus = {
                c.name: self._held.enter_context(Fmu(_inside(folder, str(c.source))))
                for c in system.elements
            }
        except InputError:
            self._held.close()
            raise
        self.name = str(system.name)
        self.wires = tuple(
            Wire(
                Port(c.startElement or OUTSIDE, c.startConnector),
                Port(c.endElement or OUTSIDE, c.endConnector),
            )
            for c in system.connections
        )
        self.parameters = _parameters(system)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def origin(self, name: str) -> tuple[str, str]:
        """Return (part, variable) of an output of the system, or of "part.variable".

        Raises InputError if there is none.
        """
        for wire in self.wires:
            if wire.end == Port(OUTSIDE, name):
                return wire.start.part, wire.start.name
        part, _, variable = name.partition(".")
        if part not in self.fmus or variable not in self.fmus[part].references:
            known = [w.end.name for w in self.wires if w.end.part == OUTSIDE]
            raise InputError(
                f"The system {self.name} has no output '{name}'; it has {', '.join(known)}, and"
                f" every variable of its parts ({', '.join(self.fmus)}) as 'part.variable'."
            )
        return part, variable


def _inside(folder: Path, source: str) -> Path:
    """Return the place of a part; raises InputError if it is not one inside the archive."""
    place = (folder / source).resolve()
    if not place.is_relative_to(folder.resolve()):
        raise InputError(
            f"The part {source!a} lies outside the SSP archive; export the archive again."
        )
    return place


def _parameters(system: Any) -> dict[str, dict[str, float]]:
    """Return the parameters of each part from the sets of the parts, then those of the system."""
    found: dict[str, dict[str, float]] = {c.name: {} for c in system.elements}
    for component in system.elements:
        for binding in component.parameterBindings:
            for values in binding.parameterValues:
                found[component.name] |= {p.name: float(p.value) for p in values.parameters}
    for binding in system.parameterBindings:
        given = {p.name: float(p.value) for s in binding.parameterValues for p in s.parameters}
        entries = [e for m in binding.parameterMapping for e in m.mappingEntries]
        targets = [(e.target, given[e.source]) for e in entries if e.source in given]
        for name, value in targets or given.items():
            part, _, variable = name.partition(".")
            if part in found:
                found[part][variable] = value
    return found
