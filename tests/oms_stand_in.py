"""Stands in for OMSimulator's Python interface (version 3), as far as the recipe uses it.

Wires co-simulation FMUs and steps them side by side with fmpy, inputs held during each step.
Unknown FMUs, variables and functions are errors, and so are connections of other than an output to
an input of the same unit. Of an archive it reads the elements and the connections.
"""

# ruff: noqa: N802 (the functions have the names of that interface)

import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave

_SSD = "{http://ssp-standard.org/SSP1/SystemStructureDescription}"


class CRef:
    """The name of an element or of a variable: system, element, variable."""

    def __init__(self, *names: str) -> None:
        self.names = names


class SSP:
    """A system that is wired by hand, or read from an archive."""

    def __init__(self, path: str | None = None) -> None:
        self.resources: dict[str, Path] = {}
        self.parts: dict[str, Path] = {}
        self.wires: list[tuple[tuple[str, str], tuple[str, str]]] = []
        self.system, self.stop = "default", 1.0
        if path is not None:
            self._read(Path(path))

    def addResource(self, filename: str, new_name: str) -> None:
        if not Path(filename).is_file():
            raise ValueError(f"no file {filename}")
        self.resources[new_name] = Path(filename)

    def addComponent(self, cref: CRef, resource: str) -> None:
        system, part = cref.names
        if system != self.system:
            raise ValueError(f"no system {system}")
        self.parts[part] = self.resources[resource]

    def addConnection(self, source: CRef, target: CRef) -> None:
        self.wires.append((self._port(source), self._port(target)))

    def instantiate(self) -> "Model":
        return Model(self)

    def _port(self, cref: CRef) -> tuple[str, str]:
        system, part, variable = cref.names
        if system != self.system or part not in self.parts:
            raise ValueError(f"no element {system}.{part}")
        return part, variable

    def _read(self, path: Path) -> None:
        folder = Path(tempfile.mkdtemp())
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        root = ET.parse(folder / "SystemStructure.ssd").getroot()
        system = root.find(f"{_SSD}System")
        experiment = root.find(f"{_SSD}DefaultExperiment")
        if system is None or experiment is None:
            raise ValueError(f"{path} has no system or no experiment")
        self.system, self.stop = system.attrib["name"], float(experiment.attrib["stopTime"])
        for element in system.iter(f"{_SSD}Component"):
            self.parts[element.attrib["name"]] = folder / element.attrib["source"]
        for wire in system.iter(f"{_SSD}Connection"):
            ends = [(wire.get(f"{s}Element", ""), wire.attrib[f"{s}Connector"])
                    for s in ("start", "end")]  # fmt: skip
            self.wires.append((ends[0], ends[1]))


class Model:
    """An instantiated system; what was called, in order, is in `calls`."""

    def __init__(self, system: SSP) -> None:
        self.system, self.stop, self.step = system.system, system.stop, 1e-3
        self.parts = {name: _Part(path) for name, path in system.parts.items()}
        self.outside: dict[str, float] = {}
        self.calls: list[str] = []
        for start, end in system.wires:
            self._check(start, end)
        self.wires = system.wires
        for part in self.parts.values():
            part.slave.instantiate()

    def setResultFile(self, path: str) -> None:
        self.calls.append("setResultFile")

    def setStopTime(self, time: float) -> None:
        self.stop = time
        self.calls.append("setStopTime")

    def setFixedStepSize(self, step: float) -> None:
        self.step = step
        self.calls.append("setFixedStepSize")

    def setValue(self, cref: CRef, value: float) -> None:
        system, *where, name = cref.names
        if system != self.system:
            raise ValueError(f"no system {system}")
        if where:
            self.parts[where[0]].set(name, value)
        elif ("", name) in (start for start, _ in self.wires):
            self.outside[name] = value
        else:
            raise ValueError(f"the system has no input {name}")
        self.calls.append("setValue")

    def getValue(self, cref: CRef) -> float:
        _, part, name = cref.names
        return self.parts[part].get(name)

    def initialize(self) -> None:
        for part in self.parts.values():
            part.slave.setupExperiment(tolerance=1e-6, startTime=0.0, stopTime=self.stop)
            part.slave.enterInitializationMode()
        self._exchange()
        for part in self.parts.values():
            part.slave.exitInitializationMode()
        self.calls.append("initialize")

    def simulate(self) -> None:
        for k in range(round(self.stop / self.step)):
            self._exchange()
            for part in self.parts.values():
                part.slave.doStep(k * self.step, self.step)
        self.calls.append("simulate")

    def terminate(self) -> None:
        for part in self.parts.values():
            part.slave.terminate()
        self.calls.append("terminate")

    def delete(self) -> None:
        for part in self.parts.values():
            part.slave.freeInstance()
            shutil.rmtree(part.unpacked)
        self.calls.append("delete")

    def _exchange(self) -> None:
        values = [
            self.parts[part].get(name) if part else self.outside.get(name)
            for (part, name), _ in self.wires
        ]
        for (_, (part, name)), value in zip(self.wires, values, strict=True):
            if part and value is not None:
                self.parts[part].set(name, value)

    def _check(self, start: tuple[str, str], end: tuple[str, str]) -> None:
        ends = [self.parts[part].variables[name] for part, name in (start, end) if part]
        kinds = [v.causality for v in ends]
        wanted = [k for (part, _), k in ((start, "output"), (end, "input")) if part]
        if kinds != wanted or len({v.unit for v in ends}) > 1:
            raise ValueError(f"{start} cannot drive {end}")


class _Part:
    def __init__(self, path: Path) -> None:
        description = read_model_description(str(path))
        self.variables: dict[str, Any] = {v.name: v for v in description.modelVariables}
        self.unpacked = str(extract(str(path)))
        self.slave = FMU2Slave(
            guid=description.guid, unzipDirectory=self.unpacked, instanceName=path.stem,
            modelIdentifier=description.coSimulation.modelIdentifier,
        )  # fmt: skip

    def get(self, name: str) -> float:
        return float(self.slave.getReal([self.variables[name].valueReference])[0])

    def set(self, name: str, value: float) -> None:
        self.slave.setReal([self.variables[name].valueReference], [value])
