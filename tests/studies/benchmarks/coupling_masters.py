"""One SSP archive in masters that others wrote: fmpy's SSP reader, and ecos wired by its API.

Both step all parts side by side with inputs held (Jacobi's scheme). fmpy hands the system's inputs
on after a step, so they are given to it one step early; it writes the values at the end of a step
beside the time of its start, which is put right here.
"""

import ctypes
import importlib.metadata
import sys
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from fmpy.ssp.simulation import simulate_ssp

from psa_casadi.export.ssp.drawing import OUTSIDE, Wire
from tests.export.ssp_master import SspArchive

FloatArray = npt.NDArray[np.float64]
#: The system's inputs as functions of time; 0 at the start, as fmpy sets them so.
Inputs = Mapping[str, Callable[[float], float]]


def by_fmpy(
    path: Path, step: float, count: int, inputs: Inputs, outputs: Sequence[str]
) -> FloatArray:
    """Return outputs ("part.port" or of the system) at the points k step, shape (count + 1, ny)."""
    early = {name: _early(f, step) for name, f in inputs.items()}
    rows = simulate_ssp(str(path), stop_time=(count - 0.5) * step, step_size=step, input=early)
    if len(rows) != count:
        raise RuntimeError(f"fmpy made {len(rows)} steps where {count} were asked for")
    found = np.array([rows[name] for name in outputs]).T
    return np.vstack([np.zeros(len(outputs)), found])


def _early(f: Callable[[float], float], step: float) -> Callable[[float], float]:
    return lambda t: f(t + step)


def load_ecos() -> Any | None:
    """Return the module ecospy, with the TBB library that it needs loaded; None if one lacks."""
    if sys.platform != "linux":
        return None
    try:
        files = importlib.metadata.files("tbb") or []
        libraries = [f for f in files if Path(str(f)).name == "libtbb.so.12"]
        if not libraries:
            return None
        ctypes.CDLL(str(libraries[0].locate()), mode=ctypes.RTLD_GLOBAL)
        return import_module("ecospy")
    except (importlib.metadata.PackageNotFoundError, ImportError, OSError):
        return None


def by_ecos(
    ecos: Any, path: Path, step: float, count: int, inputs: Inputs, outputs: Sequence[str]
) -> FloatArray:
    """Return outputs at the points k step, shape (count + 1, ny).

    The wires are those of the archive; the parameters are those that its FMUs carry.
    """
    with SspArchive(path) as archive, tempfile.TemporaryDirectory() as folder:
        with zipfile.ZipFile(path) as files:
            files.extractall(folder)
        structure = ecos.EcosSimulationStructure()
        for name in archive.fmus:
            structure.add_model(name, Path(folder) / "resources" / f"{name}.fmu")
        inner = [w for w in archive.wires if OUTSIDE not in (w.start.part, w.end.part)]
        for wire in inner:
            structure.make_real_connection(*_words(wire))
        outer = [w for w in archive.wires if w.start.part == OUTSIDE]
        wanted = ["::".join(archive.origin(name)) for name in outputs]
        simulation = ecos.EcosSimulation(step_size=step, structure=structure)
        simulation.init()
        rows = [[simulation.get_real(name) for name in wanted]]
        for k in range(count):
            for wire in outer:
                if wire.start.name in inputs:
                    value = inputs[wire.start.name](k * step)
                    simulation.set_real(f"{wire.end.part}::{wire.end.name}", value)
            simulation.step(1)
            rows.append([simulation.get_real(name) for name in wanted])
        simulation.terminate()
        simulation.free()
        structure.free()
    return np.array(rows)


def _words(wire: Wire) -> tuple[str, str]:
    """Return both ends as ecos writes them."""
    first, second = (f"{port.part}::{port.name}" for port in (wire.start, wire.end))
    return first, second
