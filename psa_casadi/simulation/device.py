"""Many sets of parameters on a GPU: a kernel through CuPy, in batches that fit its memory."""

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from psa_casadi.common.errors import InputError, MachineError
from psa_casadi.common.units import FloatArray
from psa_casadi.model.compose import Structure
from psa_casadi.simulation.compiler import sources_directory
from psa_casadi.simulation.exact.run import (
    FINEST,
    MOST_IN_LANES,
    NotExact,
    Numbers,
    Task,
    model_text,
    time_steps,
)

#: Options of its compiler: functions without a place are the device's; products and sums are
#: rounded one by one, as on the CPU.
OPTIONS = ("--std=c++17", "--device-as-default-execution-space", "--fmad=false")
_INCLUDE = re.compile(r'^#include "(.*)"\n', re.MULTILINE)


def kernel_text(structure: Structure, output: str) -> str:
    """Return the CUDA C++ of a model, whose kernel `psa_exact_sets` runs one set a thread.

    Raises NotExact where the model is not for exact steps.
    """
    table = {"exact_model.h": model_text(structure, (output,))}
    folder = sources_directory()
    texts: set[str] = set()

    def text(name: str) -> str:
        if name in texts:
            return ""
        texts.add(name)
        source = table.get(name) or (folder / name).read_text(encoding="utf-8")
        return _INCLUDE.sub(lambda match: text(match[1]), source)

    return text("exact_kernel.cu")


#: Sets in one launch at most, threads of a block, and the share of free memory that is taken.
BATCH, _BLOCK, _SHARE = 1 << 17, 128, 0.5
_INSTEAD = "or leave `device` out, which simulates on all cores."


class Summary(NamedTuple):
    """What the device keeps of displacements: (m,) numbers of m sets [m]; nan where a set ended.

    `squares` is the sum of the squares of the distances from what was measured [m^2].
    """

    least: FloatArray
    largest: FloatArray
    last: FloatArray
    squares: FloatArray


def device_module() -> Any:
    """Return the module cupy; raises InputError where it or a GPU is missing."""
    try:
        cupy = import_module("cupy")
    except ImportError as error:
        raise InputError(
            f"device='cuda' needs CuPy, which cannot be loaded ({error}); run"
            f" `pip install 'psa-casadi[gpu]'` on a machine with an NVIDIA GPU, {_INSTEAD}"
        ) from error
    try:
        count = cupy.cuda.runtime.getDeviceCount()
    except RuntimeError as error:
        raise InputError(
            f"device='cuda' finds no GPU ({error}); an NVIDIA GPU with a driver for CUDA 12 is"
            f" needed: see what `nvidia-smi` lists, install the driver, {_INSTEAD}"
        ) from error
    if not count:
        raise InputError(
            "device='cuda' finds no GPU that this process may use (CUDA_VISIBLE_DEVICES may hide"
            f" it); lend it one, {_INSTEAD}"
        )
    return cupy


def run_on_device(
    task: Task, parts: Callable[[int], Iterable[range]], numbers: Callable[[range], Numbers],
    *, whole: bool,
) -> Iterator[tuple[Summary, FloatArray | None]]:  # fmt: skip
    """Yield the sets' summaries batch by batch, with their displacements (m, n) if `whole`.

    `parts` divides the sets into batches of at most its argument, `numbers` gives those of a batch:
    the device works while those of the next are made. Raises InputError where there is no device,
    or model and record are not for exact steps, MachineError where the device fails.
    """
    with _failures():
        cupy = device_module()
        try:
            lengths, which_step = time_steps(task.t)
            kernels = _kernels(cupy, task.structure, task.output)
        except NotExact as error:
            raise InputError(
                f"device='cuda' is for models and records that exact steps fit: {error}; choose"
                f" another, {_INSTEAD}"
            ) from error
        n, s = len(task.t), task.structure
        record = [cupy.asarray(np.ascontiguousarray(a)) for a in (task.t, task.u)]
        steps = [np.int32(len(lengths)), cupy.asarray(lengths), cupy.asarray(which_step)]
        meant, size = cupy.asarray(task.meant), cupy.empty(1, np.int64)
        measure = kernels.get_function("psa_exact_room")
        measure((1,), (1,), (steps[0], np.int32(FINEST), size))
        room = int(cupy.asnumpy(size)[0])
        each = 8 * (len(s.parameters) + 2 * len(s.states) + 4 + (2 * n if whole else 0)) + room
        batch = int(max(1, min(BATCH, _SHARE * cupy.cuda.Device().mem_info[0] / each)))
    rooms: Any = None
    waiting: tuple[Any, Any] | None = None
    for which in (*parts(batch), None):
        inputs = None if which is None else numbers(which)
        with _failures():
            done = None
            if waiting is not None:
                summary, rows = waiting
                kept = Summary(*cupy.asnumpy(summary))
                done = kept, cupy.asnumpy(rows).T if whole else None
            if inputs is not None:
                sets = inputs.p.shape[1]
                if rooms is None:  # the first batch is the largest
                    rooms = cupy.empty(max(1, sets * room), np.int8)
                waiting = cupy.empty((4, sets)), cupy.empty((n, sets)) if whole else np.intp(0)
                arguments = (
                    np.int64(sets), np.int64(n), *record, np.int32(0), *steps,
                    *(cupy.asarray(np.ascontiguousarray(a)) for a in inputs),
                    np.float64(task.tolerance), np.int32(FINEST),
                    np.int64(min(MOST_IN_LANES * n, 2**31 - 1)), meant, rooms, np.int64(room),
                    *waiting,
                )  # fmt: skip
                launch = kernels.get_function("psa_exact_sets")
                launch((-(-sets // _BLOCK),), (_BLOCK,), arguments)
        if done is not None:
            yield done


@contextmanager
def _failures() -> Iterator[None]:
    """Say what fails on the device; CuPy's errors are of these two kinds."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        raise MachineError(
            f"The GPU failed ({error}); too little free memory (`nvidia-smi` lists its users) or"
            " a CuPy without CUDA's compiler (`pip install 'psa-casadi[gpu]'` brings it) is the"
            f" likely cause: mend it, {_INSTEAD}"
        ) from error


@cache
def _kernels(cupy: Any, structure: Structure, output: str) -> Any:
    """Return a model's compiled kernels; CuPy caches them, too."""
    return cupy.RawModule(code=kernel_text(structure, output), options=OPTIONS)
