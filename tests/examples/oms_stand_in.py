"""Stands in for OMSimulator's Python interface (version 3), as far as the recipe uses it.

Wires co-simulation FMUs and steps them side by side with fmpy, inputs held during each step.
Unknown FMUs, variables and functions are errors, and so are connections of other than an output to
an input of the same unit. Of an archive it reads the elements and the connections.
"""

# ruff: noqa: N802 (the functions have the names of that interface)

from pathlib import Path

from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.export.ssp.archive import STOP_TIME
from psa_casadi.export.ssp.drawing import OUTSIDE, Port, Wire
from tests.export.ssp_master import SspArchive


class CRef:
    """The name of an element or of a variable: system, element, variable."""

    def __init__(self, *names: str) -> None:
        self.names = names


class SSP:
    """A system that is wired by hand, or read from an archive."""

    def __init__(self, path: str | None = None) -> None:
        self.resources: dict[str, Path] = {}
        self.parts: dict[str, Fmu] = {}
        self.wires: list[Wire] = []
        self.system, self.stop = "default", 1.0
        if path is not None:
            archive = SspArchive(Path(path))
            self.system, self.stop = archive.name, STOP_TIME
            self.parts, self.wires = archive.fmus, list(archive.wires)

    def addResource(self, filename: str, new_name: str) -> None:
        self.resources[new_name] = Path(filename)

    def addComponent(self, cref: CRef, resource: str) -> None:
        self.parts[self._inside(cref)[0]] = Fmu(self.resources[resource])

    def addConnection(self, source: CRef, target: CRef) -> None:
        self.wires.append(Wire(Port(*self._inside(source)), Port(*self._inside(target))))

    def instantiate(self) -> "Model":
        return Model(self)

    def _inside(self, cref: CRef) -> tuple[str, ...]:
        system, *names = cref.names
        if system != self.system:
            raise ValueError(f"no system {system}")
        return tuple(names)


class Model:
    """An instantiated system; what was called, in order, is in `calls`."""

    def __init__(self, system: SSP) -> None:
        self.system, self.stop, self.step = system, system.stop, 1e-3
        self.outside: dict[str, float] = {}
        self.calls: list[str] = []
        self.wires = system.wires
        for wire in self.wires:
            _check(system.parts, wire)
        self.parts = {name: fmu.open(CO_SIMULATION) for name, fmu in system.parts.items()}

    def setResultFile(self, path: str) -> None:
        self.calls.append("setResultFile")

    def setStopTime(self, time: float) -> None:
        self.stop = time
        self.calls.append("setStopTime")

    def setFixedStepSize(self, step: float) -> None:
        self.step = step
        self.calls.append("setFixedStepSize")

    def setValue(self, cref: CRef, value: float) -> None:
        *where, name = self.system._inside(cref)
        if where:
            self.parts[where[0]].set({name: value})
        elif Port(OUTSIDE, name) in (wire.start for wire in self.wires):
            self.outside[name] = value
        else:
            raise ValueError(f"the system has no input {name}")
        self.calls.append("setValue")

    def getValue(self, cref: CRef) -> float:
        _, part, name = cref.names
        return float(self.parts[part].get([name])[0])

    def initialize(self) -> None:
        for part in self.parts.values():
            part.fmi.setupExperiment(tolerance=1e-6, startTime=0.0, stopTime=self.stop)
            part.fmi.enterInitializationMode()
        self._exchange()
        for part in self.parts.values():
            part.fmi.exitInitializationMode()
        self.calls.append("initialize")

    def simulate(self) -> None:
        for k in range(round(self.stop / self.step)):
            self._exchange()
            for part in self.parts.values():
                part.step(k * self.step, self.step)
        self.calls.append("simulate")

    def terminate(self) -> None:
        for part in self.parts.values():
            part.require("Terminate")
        self.calls.append("terminate")

    def delete(self) -> None:
        for name, part in self.parts.items():
            part.free()
            self.system.parts[name].__exit__()
        self.calls.append("delete")

    def _exchange(self) -> None:
        values = [
            self.parts[w.start.part].get([w.start.name])[0]
            if w.start.part
            else self.outside.get(w.start.name)
            for w in self.wires
        ]
        for wire, value in zip(self.wires, values, strict=True):
            if wire.end.part and value is not None:
                self.parts[wire.end.part].set({wire.end.name: value})


def _check(parts: dict[str, Fmu], wire: Wire) -> None:
    """Raise ValueError unless a wire leads from an output to an input of the same unit."""
    found = []
    for port, causality in ((wire.start, "output"), (wire.end, "input")):
        if port.part:
            variables = {v.name: v for v in parts[port.part].description.modelVariables}
            found.append((variables[port.name].causality == causality, variables[port.name].unit))
    if not all(fits for fits, _ in found) or len({unit for _, unit in found}) > 1:
        raise ValueError(f"{wire.start} cannot drive {wire.end}")
