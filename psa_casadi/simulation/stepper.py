"""The compiled stepper of a model: one trajectory, with or without sensitivities.

The method is ESDIRK4(3)6L[2]SA (Kennedy and Carpenter 2003): L-stable, stiffly accurate, order 4
with an embedded error estimate; its discrete equations are differentiated exactly for the
sensitivities. It is the C code of `fmu_src/solver.c`, the same that runs inside an exported FMU.
"""

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.common.errors import InputError, Problems, PsaError
from psa_casadi.common.interruption import flag_address
from psa_casadi.common.units import FloatArray
from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.compiler import fingerprint, generate_c, generated_library
from psa_casadi.simulation.timings import count_run

#: The files of `fmu_src` that integrate a model.
SOURCES = ("solver.c", "linear.c", "instants.c", "model_casadi.c", "trajectory.c")
_STAGES = 6
#: As in instants.c: further from 0 a double does not separate the sample instants.
_MOST_PERIODS = 1e13
_POINTER = ctypes.c_void_p
#: A step takes this many times as long as an exact one.
_DEARER = 4
#: Status of a run that an interrupt has ended.
_STOPPED = 4
#: Status of a run for which there was no memory.
_NO_MEMORY = 5
_REASONS = {
    1: "the step size became too small",
    2: "the model returned a value that is not finite",
    3: "too many steps were needed",
}


class SimulationError(PsaError):
    """A trajectory could not be computed to the tolerance."""


class _Run(ctypes.Structure):
    """Mirror of `psa_trajectory` in trajectory.h."""

    _fields_ = [
        ("samples", ctypes.c_long), ("t", _POINTER), ("u", _POINTER),
        ("zero_order_hold", ctypes.c_int), ("p", _POINTER), ("x0", _POINTER), ("z0", _POINTER),
        ("nominal", _POINTER),
        ("rtol", ctypes.c_double), ("max_step", ctypes.c_double), ("steps_limit", ctypes.c_long),
        ("steps_most", ctypes.c_long),
        ("x", _POINTER), ("z", _POINTER), ("y", _POINTER),
        ("count", ctypes.c_int), ("which", _POINTER), ("s0", _POINTER), ("shown", ctypes.c_int),
        ("outputs", _POINTER), ("dy", _POINTER), ("work", _POINTER), ("stop", _POINTER),
        ("steps", ctypes.c_long), ("rejected", ctypes.c_long),
        ("evaluations", ctypes.c_long), ("t_failed", ctypes.c_double), ("culprit", ctypes.c_int),
    ]  # fmt: skip


@dataclass(frozen=True)
class Steps:
    """What a run returned: states (n, nx), outputs (n, ny), and its cost.

    `z` are the sampled states (n, nz), at an instant those after it. `sensitivity` (n, m, k) are
    the derivatives of m outputs by k unknowns.
    """

    x: FloatArray
    z: FloatArray
    y: FloatArray
    sensitivity: FloatArray
    steps: int
    rejected: int
    evaluations: int


@cache
def _library(structure: Structure) -> ctypes.CDLL:
    path = generated_library(
        fingerprint(structure), lambda: generate_c(structure, sensitivities=True), SOURCES
    )
    library = ctypes.CDLL(str(path))
    library.psa_run.argtypes = [ctypes.POINTER(_Run)]
    library.psa_run.restype = ctypes.c_int
    for foreign in structure.foreign:
        connect = getattr(library, f"connect_{foreign.name}")
        connect.restype = None
        connect(*(_POINTER(address) for address in foreign.addresses()))
    return library


def make_ready(model: Model) -> None:
    """Compile the stepper of a model; else its first `run` does."""
    if model.structure.played is None:
        _library(model.structure)


def run(
    model: Model,
    t: FloatArray,
    u: FloatArray,
    x0: FloatArray,
    *,
    rtol: float = 1e-6,
    hold: str = "linear",
    max_step: float = 0.0,
    steps_limit: int = 0,
    steps_most: int = 0,
    unknowns: Sequence[str | int] = (),
    s0: FloatArray | None = None,
    outputs: Sequence[str] | None = None,
    values: Mapping[str, float] | None = None,
    z0: FloatArray | None = None,
) -> Steps:
    """Integrate a model over the times `t` (n,) with inputs `u` (n, nu) from `x0` (nx,).

    `unknowns` names the parameters of the sensitivities d output / d unknown of the `outputs`, all
    by default; an integer k denotes the initial value of state k. `s0` (nx, k) is
    d x0 / d unknown, zero by default except for the initial values themselves. `steps_limit` bounds
    the work between two samples, `steps_most` that of the whole run; 0 is none.

    Sampled states start at `z0` (nz,), their declared starts by default. Steps end at their
    instants, also between the times; one at t[0] is taken before the first output, one at another
    time with the input of that time (the one after a jump where inputs are held).

    Raises SimulationError, which names state and time, and InputError for arrays of wrong shape,
    times that do not increase, or numbers that are not finite.
    """
    s, n, nx, count = model.structure, len(t), len(model.state_names), len(unknowns)
    if s.played is not None:
        played: Steps = s.played.run(
            model, t, u, x0, rtol=rtol, hold=hold, unknowns=unknowns, s0=s0, outputs=outputs,
            values=values,
        )  # fmt: skip
        return played
    values = values or model.values
    if z0 is None:
        z0 = np.array([q.start for q in s.sampled])
    if s0 is None:
        s0 = unit_columns(nx, unknowns)
    requested = model.output_names if outputs is None else outputs
    rows = [model.output_names.index(name) for name in requested]
    arrays: dict[str, npt.NDArray[Any]] = {
        "t": doubles(t), "u": doubles(u), "x0": doubles(x0), "z0": doubles(z0), "s0": doubles(s0),
        "p": np.array([values[name] for name in model.parameter_names]),
        "nominal": model.state_nominals() if nx else np.ones(1), "x": np.empty((n, max(1, nx))),
        "z": np.empty((n, len(s.sampled))), "y": np.empty((n, len(s.outputs))),
        "which": which_of(model, unknowns), "outputs": np.array(rows, np.int32),
        "dy": np.empty((n, len(rows), count)),
        "work": np.empty((_STAGES + 3) * max(1, nx) * max(count, 1)),
    }  # fmt: skip
    _check(model, arrays, hold)
    if not nx:  # C has one unused state
        arrays |= {"x0": np.zeros(1), "s0": np.zeros((1, count))}
    request = _Run(
        samples=n, zero_order_hold=int(hold == "zero"), rtol=rtol, max_step=max_step,
        steps_limit=steps_limit, steps_most=steps_most, count=count, stop=flag_address(),
        shown=len(rows),
        **{name: array.ctypes.data for name, array in arrays.items()},
    )  # fmt: skip
    status = _library(model.structure).psa_run(ctypes.byref(request))
    steps = _DEARER * (request.steps + request.rejected) * (1 + count)
    count_run(steps, differentiated=count > 0)
    if status == _STOPPED:
        raise KeyboardInterrupt
    if status == _NO_MEMORY:
        raise MemoryError("There is no memory for a run of this model.")
    if status:
        state = (*model.state_names, *model.sampled_names, "none")[request.culprit]
        raise SimulationError(
            f"The simulation stopped at t = {request.t_failed:.6g} s in state '{state}':"
            f" {_REASONS[status]}. Parameter values far from physical ones are the likely cause;"
            " check them, or loosen the tolerance."
        )
    results = arrays["x"][:, :nx], arrays["z"], arrays["y"], arrays["dy"]
    return Steps(*results, request.steps, request.rejected, request.evaluations)


def doubles(values: npt.ArrayLike) -> FloatArray:
    """Return numbers as C takes them."""
    return np.ascontiguousarray(values, dtype=np.float64)


def unit_columns(nx: int, unknowns: Sequence[str | int]) -> FloatArray:
    """Return d x0 / d unknown (nx, k) where a start does not depend on the parameters."""
    columns = [[float(q == k) for q in unknowns] for k in range(nx)]
    return np.array(columns).reshape(nx, len(unknowns))


def which_of(model: Model, unknowns: Sequence[str | int]) -> npt.NDArray[np.int32]:
    """Return the index of each unknown parameter, -1 for an initial value, shape (k,)."""
    names = model.parameter_names
    return np.array([names.index(q) if isinstance(q, str) else -1 for q in unknowns], np.int32)


def _check(model: Model, arrays: Mapping[str, npt.NDArray[Any]], hold: str) -> None:
    t, k = arrays["t"], arrays["which"].size
    nx, nz = len(model.state_names), len(model.sampled_names)
    shapes: dict[str, tuple[int, ...]] = {
        "t": (t.size,), "u": (t.size, len(model.input_names)), "x0": (nx,), "s0": (nx, k),
        "z0": (nz,),
    }  # fmt: skip
    problems = Problems()
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            problems.add(
                f"The array {name} has the shape {arrays[name].shape} where {shape} is needed; give"
                " one row for each time and one column for each input."
            )
        elif not np.isfinite(arrays[name]).all():
            problems.add(f"The array {name} holds numbers that are not finite; replace them.")
    if t.size == 0 or not (np.diff(t, axis=0) > 0).all():
        problems.add("The times do not strictly increase; sort them and remove the repeated ones.")
    if k and nz:
        problems.add(
            f"Sensitivities of a model with sampled states ({', '.join(model.sampled_names)}) are"
            " not computed; leave the sampled component out, or take differences of two runs."
        )
    if hold not in ("linear", "zero"):
        problems.add(f"The hold '{hold}' does not exist; use 'linear' or 'zero'.")
    problems.raise_if_any()
    if period := model.structure.period:
        seconds = float(arrays["p"][model.parameter_names.index(period)])
        furthest = float(np.abs(t).max())
        if furthest > _MOST_PERIODS * seconds:
            raise InputError(
                f"Sample periods of {seconds:g} s ('{period}') cannot be counted up to"
                f" {furthest:g} s: a double does not tell them apart there. Count the time from a"
                " nearer start."
            )
