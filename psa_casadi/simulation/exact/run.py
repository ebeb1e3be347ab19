"""Runs of a model by exact steps of its linear part: for fits and simulations of sampled records.

Works where the model splits (`split_of`) and the record has few different time steps. The C code is
`fmu_src/exact.c`; its sensitivities are the derivatives of its discrete equations.
"""

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from psa_casadi.common.interruption import flag_address
from psa_casadi.common.symbolic import in_turn
from psa_casadi.common.units import FloatArray
from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation.compiler import fingerprint, generated_library, vector_flags
from psa_casadi.simulation.exact.generate import generate
from psa_casadi.simulation.exact.printing import Unprintable
from psa_casadi.simulation.exact.split import split_of
from psa_casadi.simulation.stepper import doubles, unit_columns, which_of
from psa_casadi.simulation.timings import count_run

#: A sample is halved this many times at most; what then misses the tolerance is counted as forced.
FINEST = 12
#: Sets of parameters that run side by side in the vectors of one core.
LANES = 4
#: Tried steps over the samples, times 2^coarsest, beyond which a run is left to the stepper, which
#: takes the time of 10 to 60 of them for a sample: at this tolerance of a step, and as its root
#: below. A set in lanes has no other way.
MOST, AT, MOST_IN_LANES = 60, 1e-6, 100_000
#: Time steps that differ by less than this share count as one, and LENGTHS of them may differ by
#: more.
EQUAL_STEPS, LENGTHS = 1e-6, 8
#: Vectors of four numbers whatever the processor; strict C99 has no vectors.
_FLAGS = ("-std=gnu99", "-fno-math-errno")
#: With -O1 a model compiles in 0.5 s, with -O3 in 1.2 s, and runs as fast within 10 %. Many sets
#: run long enough for -O3.
_OPTIMISE, _OPTIMISE_LANES = ("-O1",), ("-O3", "-ftree-vectorize")
_POINTER = ctypes.c_void_p
#: Status of a run that an interrupt has ended.
_STOPPED = 4


class NotExact(Exception):  # noqa: N818 - the stepper is taken instead, which is no mistake
    """A run that exact steps do not do; the message gives the reason."""


class _Request(ctypes.Structure):
    """Mirror of `psa_exact` in exact.h."""

    _fields_ = [
        ("samples", ctypes.c_long), ("t", _POINTER), ("v", _POINTER),
        ("zero_order_hold", ctypes.c_int), ("lengths", ctypes.c_int), ("length", _POINTER),
        ("which_step", _POINTER), ("sets", ctypes.c_int), ("p", _POINTER), ("x0", _POINTER),
        ("nominal", _POINTER), ("tolerance", ctypes.c_double), ("coarsest", ctypes.c_int),
        ("finest", ctypes.c_int), ("steps_limit", ctypes.c_long), ("x", _POINTER),
        ("y", _POINTER), ("shown", _POINTER), ("count", ctypes.c_int), ("which", _POINTER),
        ("s0", _POINTER), ("dy", _POINTER), ("stop", _POINTER), ("steps", ctypes.c_long),
        ("rejected", ctypes.c_long), ("forced", ctypes.c_long), ("t_failed", ctypes.c_double),
    ]  # fmt: skip


@dataclass(frozen=True)
class ExactSteps:
    """What a run returns: outputs `requested` (n, m), their derivatives `sensitivity` (n, m, k).

    `x` (n, nx) and `y` (n, ny) are all states and outputs, without rows if the run is not for
    `everything`. `forced` counts the steps that exceed the tolerance at the finest length.
    """

    requested: FloatArray
    sensitivity: FloatArray
    x: FloatArray
    y: FloatArray
    steps: int
    rejected: int
    forced: int


def why_not(structure: Structure, outputs: tuple[str, ...]) -> str | None:
    """Return why outputs of a model cannot be had by exact steps; None if they can."""
    result = _unfit(structure, outputs) or _compiled(structure, outputs, 1)
    return result if isinstance(result, str) else None


def _unfit(structure: Structure, outputs: tuple[str, ...]) -> str | None:
    missing = set(outputs) - {o.name for o in structure.outputs}
    if missing or not outputs:
        return f"it has no output {', '.join(sorted(missing))}"
    return "it calls an FMU, which has no formula" if structure.foreign else None


@in_turn
def model_text(structure: Structure, outputs: tuple[str, ...]) -> str:
    """Return a model's generated C (`exact_model.h`); raises NotExact where there is none."""
    split = _unfit(structure, outputs) or split_of(structure)
    if isinstance(split, str):
        raise NotExact(split)
    try:
        return generate(split, outputs)
    except Unprintable as reason:
        raise NotExact(str(reason)) from reason


@cache
def _compiled(structure: Structure, outputs: tuple[str, ...], lanes: int) -> Path | str:
    """Return the model's library, or why there is none; the text is made where it is not cached."""
    optimise = _OPTIMISE if lanes == 1 else _OPTIMISE_LANES
    flags = (*_FLAGS, *optimise, *vector_flags(), f"-DPSA_LANES={lanes}")
    sources = sorted(Path(__file__).parent.glob("*.py"))  # another generator: other libraries
    named = repr((fingerprint(structure), outputs, [q.read_text("utf-8") for q in sources]))
    try:
        return generated_library(
            named, lambda: {"exact_model.h": model_text(structure, outputs)}, ("exact.c",), flags
        )
    except NotExact as reason:
        return str(reason)


@cache
def _library(structure: Structure, outputs: tuple[str, ...], lanes: int) -> ctypes.CDLL:
    library = ctypes.CDLL(str(_compiled(structure, outputs, lanes)))
    library.psa_run_exact.argtypes = [ctypes.POINTER(_Request)]
    library.psa_run_exact.restype = ctypes.c_int
    return library


def time_steps(t: FloatArray) -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """Return the different steps (m,) [s] of times (n,) and which of them each is, (n - 1,).

    Raises NotExact where there are more than a few.
    """
    steps = np.diff(t)
    mean = float(steps.mean())
    if float(np.abs(steps - mean).max()) <= EQUAL_STEPS * mean:
        return np.array([mean]), np.zeros(steps.size, np.int32)
    order = np.argsort(steps, kind="stable")
    sizes = steps[order]
    starts = np.concatenate([[True], np.diff(sizes) > EQUAL_STEPS * sizes[1:]])
    groups = np.cumsum(starts) - 1
    count = int(groups[-1]) + 1
    if count > LENGTHS:
        raise NotExact(f"the record has {count} different time steps")
    which = np.empty(steps.size, np.int32)
    which[order] = groups
    return np.bincount(groups, sizes) / np.bincount(groups), which


def run_exact(
    model: Model,
    t: FloatArray,
    u: FloatArray,
    x0: FloatArray,
    *,
    tolerance: float,
    coarsest: int = 0,
    hold: str = "linear",
    unknowns: Sequence[str | int] = (),
    s0: FloatArray | None = None,
    outputs: Sequence[str],
    everything: bool = False,
) -> ExactSteps:
    """Integrate a model over times `t` (n,) with inputs `u` (n, nu) from `x0` (nx,), for `outputs`.

    `tolerance` bounds the estimated error of a step, over the states' `error_sizes`; every sample
    is divided by 2^coarsest at least. `unknowns` and `s0` are those of the stepper's `run`;
    `everything` asks for all states and outputs. Raises NotExact where this way is not possible,
    where it fails, or where the stepper would be no slower.
    """
    n, nx, m, count = len(t), len(model.state_names), len(outputs), len(unknowns)
    arrays: dict[str, npt.NDArray[Any]] = {
        "p": model.parameter_vector(), "x0": doubles(x0),
        "nominal": model.error_sizes(), "shown": np.empty((n, m)),
        "which": which_of(model, unknowns),
        "s0": doubles(unit_columns(nx, unknowns) if s0 is None else s0),
        "dy": np.empty((n, m, count)),
    }  # fmt: skip
    rows = n if everything else 0
    x, y = np.empty((rows, nx)), np.empty((rows, len(model.output_names)))
    if everything:
        arrays |= {"x": x, "y": y}
    most = int(MOST * max(1.0, AT / tolerance) ** 0.5 * n) << coarsest
    cost = _run(
        model.structure, tuple(outputs), (t, u, hold), arrays,
        count=count, tolerance=tolerance, coarsest=coarsest, steps_limit=most,
    )  # fmt: skip
    return ExactSteps(arrays["shown"], arrays["dy"], x, y, *cost)


@dataclass(frozen=True)
class Task:
    """A model's output under inputs `u` (n, nu) at times `t` (n,) [s], compared with `meant` (n,).

    It is run for many sets of parameters. `tolerance` bounds the error of a step over the states'
    nominal sizes.
    """

    structure: Structure
    output: str
    t: FloatArray
    u: FloatArray
    meant: FloatArray
    tolerance: float


class Numbers(NamedTuple):
    """Parameters p (np, m), initial states and nominal sizes (nx, m) of m sets."""

    p: FloatArray
    x0: FloatArray
    nominal: FloatArray


def run_sets(task: Task, numbers: Numbers) -> FloatArray:
    """Return the output (n, m) of at most `LANES` sets of parameters, run side by side.

    Every column has the bits of a run by itself; one that cannot be integrated is nan from there
    on. Raises NotExact like `run_exact`.
    """
    values = np.empty((len(task.t), numbers.p.shape[1]))
    arrays = {**{n: doubles(a) for n, a in numbers._asdict().items()}, "shown": values}
    _run(
        task.structure, (task.output,), (task.t, task.u, "linear"), arrays, lanes=LANES,
        sets=values.shape[1], tolerance=task.tolerance, steps_limit=MOST_IN_LANES * len(task.t),
    )  # fmt: skip
    return values


def _run(
    structure: Structure,
    outputs: tuple[str, ...],
    record: tuple[FloatArray, FloatArray, str],
    arrays: Mapping[str, npt.NDArray[Any]],
    *,
    lanes: int = 1,
    sets: int = 1,
    count: int = 0,
    coarsest: int = 0,
    **how: Any,
) -> tuple[int, int, int]:
    """Run a model over times, inputs and hold; return steps, rejected and forced ones."""
    reason = why_not(structure, outputs)
    if reason:
        raise NotExact(reason)
    t, u, hold = record
    lengths, which_step = time_steps(t)
    times = {"t": doubles(t), "v": doubles(u), "length": lengths}
    table: dict[str, npt.NDArray[Any]] = {**times, "which_step": which_step, **arrays}
    request = _Request(
        samples=len(t), zero_order_hold=int(hold == "zero"), lengths=len(lengths), sets=sets,
        count=count, coarsest=coarsest, finest=max(FINEST, coarsest), stop=flag_address(), **how,
        **{name: array.ctypes.data for name, array in table.items()},
    )  # fmt: skip
    status = _library(structure, outputs, lanes).psa_run_exact(ctypes.byref(request))
    steps = (request.steps + request.rejected) * (1 + count)
    count_run(steps, differentiated=count > 0)
    if status == _STOPPED:
        raise KeyboardInterrupt
    if status:
        raise NotExact(f"exact steps ended at t = {request.t_failed:.6g} s")
    return request.steps, request.rejected, request.forced
