"""A processor in the place of a GPU: what `simulate_many` calls of CuPy, with the kernel as C++.

Every thread of the launch is one call. A launch with arguments of other types than the kernel's is
an error, as a GPU would read them wrongly.
"""

import ctypes
import hashlib
import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from psa_casadi.common.cache import cached
from psa_casadi.simulation import device, many
from psa_casadi.simulation.compiler import compiler_command, run_compiler

_BEFORE = """\
#define __global__ __attribute__((visibility("default")))
struct psa_place { long long x; };
static psa_place blockIdx, blockDim, threadIdx;
extern "C" __global__ void psa_at(long long block, long long size, long long thread) {
    blockIdx.x = block, blockDim.x = size, threadIdx.x = thread;
}
"""
_FLAGS = ("-x", "c++", "-std=c++17", "-O0", "-ffp-contract=off", "-fvisibility=hidden")
_SCALARS: dict[str, tuple[type[np.generic], Any]] = {
    "long long": (np.int64, ctypes.c_longlong),
    "int": (np.int32, ctypes.c_int),
    "double": (np.float64, ctypes.c_double),
}
_ITEMS = {**{name: kind for name, (kind, _) in _SCALARS.items()}, "char": np.int8}


class HostCuda:
    """The few names of the module cupy; a device with `free` bytes of memory."""

    asarray, asnumpy = staticmethod(np.array), staticmethod(np.array)

    def __init__(self, free: int) -> None:
        self.launches: list[int] = []
        device = SimpleNamespace(mem_info=(free, free), id=0)
        simple_namespace = SimpleNamespace(
            getDeviceProperties=lambda _: {"name": b"this processor"}
        )
        self.cuda = SimpleNamespace(Device=lambda: device, runtime=simple_namespace)

    def empty(self, shape: int | tuple[int, ...], dtype: Any = np.float64) -> Any:
        """Return memory full of what must not be read: numbers in it are nan."""
        return np.full(shape, np.nan if dtype is np.float64 else -1, dtype)

    def RawModule(self, *, code: str, options: tuple[str, ...]) -> "HostModule":  # noqa: N802
        assert "--fmad=false" in options
        return HostModule(code, self.launches)


def lend(monkeypatch: pytest.MonkeyPatch, free: int) -> HostCuda:
    """Put this processor with so much memory in the place of a GPU; return it."""
    host = HostCuda(free)
    for module in (many, device):
        monkeypatch.setattr(module, "device_module", lambda: host)
    return host


class HostModule:
    """The kernels of a text, compiled for this machine."""

    def __init__(self, code: str, launches: list[int]) -> None:
        self._code, self._launches = code, launches
        self._library = _library(code)

    def get_function(self, name: str) -> Any:
        """Return the launch of a kernel over a grid of blocks."""
        result = re.search(rf"__global__ void {name}\(([^)]*)\)", self._code)
        assert result is not None
        wanted = [" ".join(q.replace("const", "").split()) for q in result[1].split(",")]

        def launch(grid: tuple[int], block: tuple[int], arguments: tuple[Any, ...]) -> None:
            passed = [_passed(q, a) for q, a in zip(wanted, arguments, strict=True)]
            for number in range(grid[0] * block[0]):
                self._library.psa_at(*(ctypes.c_longlong(k) for k in _place(number, block[0])))
                getattr(self._library, name)(*passed)
            self._launches.append(grid[0] * block[0])

        return launch


def _place(number: int, size: int) -> tuple[int, int, int]:
    return number // size, size, number % size


def _passed(wanted: str, argument: Any) -> Any:
    """Return an argument for a parameter such as "double *p" or "int lengths"."""
    kind = wanted.rsplit(" ", 1)[0]
    if "*" not in wanted:
        scalar, passed = _SCALARS[kind]
        assert type(argument) is scalar, wanted
        return passed(argument.item())
    if not isinstance(argument, np.ndarray):
        assert type(argument) is np.intp, wanted
        assert argument == 0, wanted
        return ctypes.c_void_p(0)
    assert argument.dtype == _ITEMS[kind], wanted
    assert argument.flags.c_contiguous, wanted
    return ctypes.c_void_p(argument.ctypes.data)


@cache
def _library(code: str) -> ctypes.CDLL:
    text = _BEFORE + code
    command = [*compiler_command(), *_FLAGS]
    name = hashlib.sha256(repr((command, text)).encode()).hexdigest()[:32] + ".so"

    def compile_to(work: Path) -> Path:
        (work / "kernel.cu").write_text(text, encoding="utf-8")
        run_compiler([*command, "-fPIC", "-shared", "kernel.cu", "-lm", "-o", name], work)
        return work / name

    return ctypes.CDLL(str(cached("kernels", name, compile_to, lambda path: None)))
