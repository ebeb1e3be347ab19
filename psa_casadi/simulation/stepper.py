"""The compiled stepper of a model: one trajectory, with or without sensitivities.

The method is ESDIRK4(3)6L[2]SA (Kennedy and Carpenter 2003): L-stable, stiffly accurate, order 4 with
an embedded error estimate; its discrete equations are differentiated exactly for the sensitivities.
It is the C code of `fmu_src/solver.c`, the same that runs inside an exported FMU.
"""

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import PsaError
from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.codegen import generate_c
from psa_casadi.simulation.compiler import shared_library

FloatArray = npt.NDArray[np.float64]

_SOURCES = ("solver.c", "linear.c", "model_casadi.c", "trajectory.c")
_STAGES = 6
_POINTER = ctypes.c_void_p
_REASONS = {
    1: "the step size became too small",
    2: "the model returned a value that is not finite",
    3: "too many steps were needed",
}


class SimulationError(PsaError):
    """A trajectory could not be computed to the tolerance."""


class _Run(ctypes.Structure):
    """Mirror of `psa_trajectory` in trajectory.h."""

    _fields_ = [  # noqa: RUF012
        ("samples", ctypes.c_long), ("t", _POINTER), ("u", _POINTER),
        ("zero_order_hold", ctypes.c_int), ("p", _POINTER), ("x0", _POINTER), ("nominal", _POINTER),
        ("rtol", ctypes.c_double), ("max_step", ctypes.c_double), ("steps_limit", ctypes.c_long), ("x", _POINTER), ("y", _POINTER),
        ("count", ctypes.c_int), ("which", _POINTER), ("s0", _POINTER), ("output", ctypes.c_int),
        ("dy", _POINTER), ("work", _POINTER), ("steps", ctypes.c_long), ("rejected", ctypes.c_long),
        ("evaluations", ctypes.c_long), ("t_failed", ctypes.c_double), ("culprit", ctypes.c_int),
    ]  # fmt: skip


@dataclass(frozen=True)
class Steps:
    """What a run returned: states (n, nx), outputs (n, ny), sensitivities (n, k), and its cost."""

    x: FloatArray
    y: FloatArray
    sensitivity: FloatArray | None
    steps: int
    rejected: int
    evaluations: int


@cache
def _library(structure: Structure) -> ctypes.CDLL:
    path = shared_library(generate_c(structure, sensitivities=True), _SOURCES)
    library = ctypes.CDLL(str(path))
    library.psa_run.argtypes = [ctypes.POINTER(_Run)]
    library.psa_run.restype = ctypes.c_int
    return library


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
    unknowns: Sequence[str | int] = (),
    s0: FloatArray | None = None,
    output: str = "measured_displacement",
    values: Mapping[str, float] | None = None,
) -> Steps:
    """Integrate a model over the times `t` (n,) with inputs `u` (n, nu) from `x0` (nx,).

    `unknowns` names the parameters of the sensitivities d output / d unknown; an integer k stands
    for the initial value of state k. `s0` (nx, k) is d x0 / d unknown, zero by default except for the
    initial values themselves. `steps_limit` bounds the work between two samples. Raises SimulationError, which names state and time.
    """
    structure = model.structure
    n, nx, ny = len(t), len(structure.states), len(structure.outputs)
    p = model.parameter_vector() if values is None else np.array(
        [values[name] for name in model.parameter_names]
    )  # fmt: skip
    count = len(unknowns)
    which = np.array(
        [model.parameter_names.index(q) if isinstance(q, str) else -1 for q in unknowns],
        dtype=np.int32,
    )
    start = np.zeros((nx, count)) if s0 is None else np.array(s0, dtype=float)
    if s0 is None:
        for column, unknown in enumerate(unknowns):
            if isinstance(unknown, int):
                start[unknown, column] = 1.0
    arrays = {
        "t": np.ascontiguousarray(t, dtype=float), "u": np.ascontiguousarray(u, dtype=float), "p": p,
        "x0": np.ascontiguousarray(x0, dtype=float), "nominal": model.state_nominals(),
        "x": np.empty((n, nx)), "y": np.empty((n, ny)), "which": which,
        "s0": np.ascontiguousarray(start), "dy": np.empty((n, count)),
        "work": np.empty((_STAGES + 3) * nx * max(count, 1)),
    }  # fmt: skip
    request = _Run(
        samples=n, zero_order_hold=int(hold == "zero"), rtol=rtol, max_step=max_step, steps_limit=steps_limit, count=count,
        output=model.output_names.index(output) if count else 0,
        **{name: array.ctypes.data for name, array in arrays.items()},
    )  # fmt: skip
    status = _library(structure).psa_run(ctypes.byref(request))
    if status:
        raise SimulationError(
            f"The simulation stopped at t = {request.t_failed:.6g} s in state"
            f" '{model.state_names[request.culprit]}': {_REASONS[status]}. Parameter values far from"
            " physical ones are the likely cause; check them, or loosen the tolerance."
        )
    return Steps(
        arrays["x"], arrays["y"], arrays["dy"] if count else None,
        request.steps, request.rejected, request.evaluations,
    )  # fmt: skip
