"""A master of SSP archives, and systems: all FMUs are stepped side by side (Jacobi's scheme).

fmpy's passes values on after a step only, and reads no parameter sets. Here, at every
communication point, the parts exchange their outputs in the order in which outputs depend on
inputs, so that all values belong to that point. Over the step that follows each part sees its
inputs held (an error of first order in the step) or, with `rates`, as straight lines whose slopes
are the rates of the outputs that they come from (second order). No step is repeated.
"""

import ctypes
import importlib.metadata
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np
from fmpy.ssp.ssd import read_ssd
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.files import temporary_folder
from psa_casadi.common.units import FloatArray
from psa_casadi.export.importer.archive import unpack
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu, FmuError
from psa_casadi.export.importer.masters import Signals
from psa_casadi.export.ssp import OUTSIDE, Port, Wire
from tests.export.fmu_models import model_named

#: Multiple of a port's nominal size beyond which a co-simulation counts as blown up.
_BEYOND = 1e3


class SspArchive:
    """An SSP archive with its FMUs; a context manager that removes the extracted files.

    `name` is that of the system, `wires` its connections, `parameters` the values that its
    parameter sets give to each part, `fmus` the parts.
    """

    def __init__(self, path: Path) -> None:
        self._held = ExitStack()
        folder = self._held.enter_context(temporary_folder())
        try:
            unpack(path, folder)
            system: Any = read_ssd(str(path)).system
        except BaseException:
            self._held.close()
            raise
        self.name = str(system.name)
        self.fmus = {
            c.name: self._held.enter_context(Fmu(folder / str(c.source))) for c in system.elements
        }
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
        """Return (part, variable) of an output of the system, or of "part.variable"."""
        for wire in self.wires:
            if wire.end == Port(OUTSIDE, name):
                return wire.start.part, wire.start.name
        part, _, variable = name.partition(".")
        return part, variable

    def inner_wires(self) -> list[Wire]:
        """Return the wires between parts, each after those that its output depends on at once."""
        inner = {w.end: w for w in self.wires if OUTSIDE not in (w.start.part, w.end.part)}
        needs = {
            end: {Port(w.start.part, n) for n in self._feedthrough(w.start)} & inner.keys()
            for end, w in inner.items()
        }
        return [inner[end] for end in TopologicalSorter(needs).static_order()]

    def _feedthrough(self, port: Port) -> set[str]:
        """Return the inputs that an output depends on at once, from the part's description."""
        outputs = self.fmus[port.part].description.outputs
        unknown = next(u for u in outputs if u.variable.name == port.name)
        return {d.name for d in unknown.dependencies or () if d.causality == "input"}


def _number(text: str) -> float:
    return float({"true": "1", "false": "0"}.get(text, text))


def _parameters(system: Any) -> dict[str, dict[str, float]]:
    """Return the parameters of each part from the sets of the parts, then those of the system."""
    table: dict[str, dict[str, float]] = {c.name: {} for c in system.elements}
    for owner in (*system.elements, system):
        for binding in owner.parameterBindings:
            inputs = {
                p.name: _number(p.value) for s in binding.parameterValues for p in s.parameters
            }
            if owner is not system:
                table[owner.name] |= inputs
                continue
            for entry in (e for m in binding.parameterMapping for e in m.mappingEntries):
                part, _, variable = entry.target.partition(".")
                table[part][variable] = inputs[entry.source]
    return table


def couple(
    archive: SspArchive,
    times: FloatArray,
    inputs: Signals,
    outputs: Sequence[str],
    *,
    rates: bool = True,
    tolerance: float | None = None,
    values: Mapping[str, float] | None = None,
) -> FloatArray:
    """Simulate a system over communication points `times` (n,); return its outputs (n, ny).

    `inputs` are the system's; the others keep their start values. Parameters are those of
    the archive's parameter sets, but for `values` by "part.parameter". `tolerance` is the relative
    tolerance inside each part.

    Raises FmuError for a step that fails, and where the values grow without end.
    """
    origins = [archive.origin(name) for name in outputs]
    outer = [w for w in archive.wires if w.start.part == OUTSIDE and w.start.name in inputs.names]
    inner, columns = archive.inner_wires(), dict(zip(inputs.names, inputs.at(times).T, strict=True))
    starts = {name: dict(listed) for name, listed in archive.parameters.items()}
    table = {
        **(values or {}),
        **{f"{w.end.part}.{w.end.name}": columns[w.start.name][0] for w in outer},
    }
    for name, value in table.items():
        part, _, variable = name.partition(".")
        starts[part][variable] = float(value)
    options: dict[str, Any] = {"tolerance": tolerance, "start_time": float(times[0])}
    with ExitStack() as held:
        parts = {
            name: held.enter_context(fmu.start(CO_SIMULATION, values=starts[name], **options))
            for name, fmu in archive.fmus.items()
        }
        result = np.empty((len(times), len(outputs)))
        for k, point in enumerate(times):
            for w in outer:
                parts[w.end.part].set({w.end.name: columns[w.start.name][k]})
            for w in inner:
                value = float(parts[w.start.part].get([w.start.name])[0])
                _refuse_growth(archive, w.end, value)
                parts[w.end.part].set({w.end.name: value})
            result[k] = [float(parts[p].get([v])[0]) for p, v in origins]
            if k + 1 == len(times):
                break
            size = float(times[k + 1] - point)
            for w in outer if rates else ():
                change = 0.0 if inputs.held else np.diff(columns[w.start.name][k : k + 2])[0]
                parts[w.end.part].set_rates({w.end.name: change / size})
            for w in inner if rates else ():
                slopes = parts[w.start.part].output_rates([w.start.name])
                parts[w.end.part].set_rates({w.end.name: slopes[0]})
            for instance in parts.values():
                instance.step(float(point), size)
        return result


def _refuse_growth(archive: SspArchive, port: Port, value: float) -> None:
    """Stop a co-simulation that blows up; the parts' solvers would only get slower and slower."""
    if not abs(value) < _BEYOND * archive.fmus[port.part].nominals[port.name]:
        raise FmuError(f"the coupling is unstable: {port.part}.{port.name} is {value:g}")


def points(step: float, end: float) -> FloatArray:
    """Return the communication points k step from 0 up to the end, shape (n,)."""
    return np.asarray(step * np.arange(round(end / step) + 1), dtype=float)


_KICK, _COUNT, _TOLERANCE = 1.0, 1500, 1e-7
#: Share of the first roughness below which a coupling has settled.
_SETTLED = 1e-4


def settles(archive: SspArchive, step: float, values: Mapping[str, float], *, slopes: bool) -> bool:
    """Return whether the force on the stack settles after a jump of the command.

    It does where its roughness falls, or is as small as what the parts' tolerances leave.
    """
    times = points(step, _COUNT * step)
    kick = Signals(("command",), times[:1], np.array([[_KICK]]), held=True)
    how: Any = {"rates": slopes, "values": values, "tolerance": _TOLERANCE}
    try:
        result = couple(archive, times, kick, ["flexure.reaction_force"], **how)[:, 0]
    except FmuError:
        return False
    rough, third = np.abs(np.diff(result, 2)), _COUNT // 3
    early, later, last = rough[:third].max(), rough[third:-third].max(), rough[-third:].max()
    return bool(last < max(later, _SETTLED * early))


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


# Systems and their archives, each exported once per process

_FOLDER = TemporaryDirectory()

#: Stack, end [s] and rise of the voltage [V/s] of the pushed stage.
STACK, END, RATE = "P-885.51", 4e-4, 2e5


def pushed_stage() -> psa.System:
    """Return a stack that pushes on a flexure: two parts in a loop."""
    wires = {"stack.displacement": "flexure.tip_position", "stack.velocity": "flexure.tip_velocity"}
    return psa.System(
        name="pushed_stage",
        parts={"stack": model_named(STACK).plant(), "flexure": model_named("flexure")},
        wires=(*wires.items(), ("flexure.reaction_force", "stack.load_force")),
        inputs={"command": "stack.voltage"},
        outputs={"stage_position": "flexure.stage_position", "tip": "stack.displacement"},
    )


@cache
def closed_loop() -> psa.System:
    return psa.nanopositioner(STACK)


@cache
def archive_of(name: str) -> Path:
    system = pushed_stage() if name == "pushed_stage" else closed_loop()
    return psa.export_ssp(system, Path(_FOLDER.name) / f"{name}.ssp")


@cache
def monolithic() -> tuple[FloatArray, FloatArray]:
    """Return the final displacements of stack and stage, from one set of equations."""
    stack, flexure = model_named(STACK).plant(), model_named("flexure")
    f, g = stack.structure.f, flexure.structure.f
    p, q = stack.parameter_vector(), flexure.parameter_vector()
    count = len(stack.state_names)
    at = [stack.output_names.index(name) for name in ("displacement", "velocity")]

    def rates(t: float, z: FloatArray) -> FloatArray:
        tip = np.array(f(t, z[:count], [RATE * t, 0.0], p)[1]).ravel()[at]
        slope, out = g(t, z[count:], tip, q)
        force = float(out[flexure.output_names.index("reaction_force")])
        slopes = f(t, z[:count], [RATE * t, force], p)[0]
        return np.concatenate([np.array(slopes).ravel(), np.array(slope).ravel()])

    size = np.concatenate([stack.state_nominals(), flexure.state_nominals()])
    solution = solve_ivp(
        rates, (0.0, END), np.zeros(len(size)), method="LSODA", rtol=1e-9, atol=1e-11 * size
    )
    assert solution.success
    final = solution.y[:, -1]
    return final[stack.state_names.index("x")], final[count]
