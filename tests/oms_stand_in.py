"""Stands in for OMSimulator's Python interface (version 2), as far as the recipe uses it.

Wires co-simulation FMUs and steps them side by side with fmpy, inputs held during each step.
Unknown FMUs, variables and functions are errors, and so are connections of other than an output to
an input of the same unit.
"""

# ruff: noqa: N802 (the functions have the names of that interface)

import shutil
from pathlib import Path
from typing import Any

from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave


class OMSimulator:
    """The functions that a script calls, under their own names; 0 is success."""

    system_wc = 2

    def __init__(self) -> None:
        self.parts: dict[str, _Part] = {}
        self.wires: list[tuple[_Part, str, _Part, str]] = []
        self.stop, self.step, self.calls = 0.0, 0.0, list[str]()

    def setTempDirectory(self, path: str) -> int:
        return self._done("setTempDirectory")

    def newModel(self, name: str) -> int:
        self.model = name
        return self._done("newModel")

    def addSystem(self, name: str, kind: int) -> int:
        if (name.partition(".")[0], kind) != (self.model, self.system_wc):
            raise ValueError(f"no system {name} of kind {kind}")
        self.system = name
        return self._done("addSystem")

    def addSubModel(self, name: str, path: str) -> int:
        system, _, part = name.rpartition(".")
        if system != self.system:
            raise ValueError(f"no system {system}")
        self.parts[part] = _Part(Path(path))
        return self._done("addSubModel")

    def addConnection(self, source: str, target: str) -> int:
        (one, out), (other, into) = self._variable(source), self._variable(target)
        left, right = one.variables[out], other.variables[into]
        if (left.causality, right.causality) != ("output", "input") or left.unit != right.unit:
            raise ValueError(f"{source} [{left.unit}] cannot drive {target} [{right.unit}]")
        self.wires.append((one, out, other, into))
        return self._done("addConnection")

    def setResultFile(self, model: str, path: str) -> int:
        return self._done("setResultFile")

    def setStopTime(self, model: str, time: float) -> int:
        self.stop = time
        return self._done("setStopTime")

    def setFixedStepSize(self, system: str, step: float) -> int:
        self.step = step
        return self._done("setFixedStepSize")

    def instantiate(self, model: str) -> int:
        for part in self.parts.values():
            part.slave.instantiate()
            part.slave.setupExperiment(tolerance=1e-6, startTime=0.0, stopTime=self.stop)
        return self._done("instantiate")

    def setReal(self, name: str, value: float) -> int:
        part, variable = self._variable(name)
        part.slave.setReal([part.variables[variable].valueReference], [value])
        return self._done("setReal")

    def getReal(self, name: str) -> tuple[float, int]:
        part, variable = self._variable(name)
        return part.get(variable), self._done("getReal")

    def initialize(self, model: str) -> int:
        for part in self.parts.values():
            part.slave.enterInitializationMode()
            part.slave.exitInitializationMode()
        return self._done("initialize")

    def simulate(self, model: str) -> int:
        for k in range(round(self.stop / self.step)):
            values = [one.get(out) for one, out, _, _ in self.wires]
            for (_, _, other, into), value in zip(self.wires, values, strict=True):
                other.slave.setReal([other.variables[into].valueReference], [value])
            for part in self.parts.values():
                part.slave.doStep(k * self.step, self.step)
        return self._done("simulate")

    def terminate(self, model: str) -> int:
        for part in self.parts.values():
            part.slave.terminate()
        return self._done("terminate")

    def delete(self, model: str) -> int:
        for part in self.parts.values():
            part.slave.freeInstance()
            shutil.rmtree(part.unpacked)
        return self._done("delete")

    def _done(self, name: str) -> int:
        self.calls.append(name)
        return 0

    def _variable(self, name: str) -> "tuple[_Part, str]":
        system, part, variable = name.rsplit(".", 2)
        if system != self.system or variable not in self.parts[part].variables:
            raise ValueError(f"no variable {name}")
        return self.parts[part], variable


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
