"""Many sets of parameters at once: the bits of each alone; a processor in the place of a GPU.

`HostCuda` has what `simulate_many` calls of CuPy, with the kernel as C++. Every thread of the
launch is one call. A launch with arguments of other types than the kernel's is an error, as a GPU
would read them wrongly.
"""

import ctypes
import hashlib
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.cache import cached
from psa_casadi.common.units import FloatArray
from psa_casadi.simulation import device, many
from psa_casadi.simulation.compiler import compiler_command, run_compiler
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.start import start_on, starts_on
from tests.model.stack_models import stack
from tests.simulation.exact_cases import KINK
from tests.tiers import slow

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


def record(uneven: bool = False) -> psa.Record:
    """Return two cycles, a ramp and a hold; with other time steps throughout if `uneven`."""
    t: FloatArray = np.arange(600, dtype=np.float64) * 2e-4
    if uneven:
        t = t + 1e-5 * np.random.default_rng(1).standard_normal(600)
    s = np.arange(600) / 600
    v = np.where(s < 0.6, 40.0 * (1.0 - np.cos(2 * np.pi * s / 0.3)), np.minimum(400 * s - 240, 80))
    return psa.Record(name="sets", time=t, voltage=np.asarray(v, dtype=np.float64))


def sets(model: psa.Model, count: int) -> list[dict[str, float]]:
    rng = np.random.default_rng(3)
    return [
        {
            "k_L": model.values["k_L"] * (1 + 0.2 * rng.random()),
            "n": 1.0 + rng.random(),
            "delta": 20.0 * rng.standard_normal(),
            "R_s": model.values["R_s"] * 10.0 ** rng.uniform(-1, 1),
        }
        for _ in range(count)
    ]


@pytest.mark.parametrize("effect", ["", "load_stiffness", "rate_dependent_hysteresis"])
def test_a_set_has_the_same_bits_alone_and_among_others(effect: str) -> None:
    """Nine sets fill two groups of four lanes and begin a third; loops and turns differ by set."""
    model = stack("P-885.51")
    if effect:
        gains = {"load_stiffness": "load_gain", "rate_dependent_hysteresis": "rate_gain"}
        model = model.with_effect(psa.EFFECTS[effect], {gains[effect]: 0.02})
    values = sets(model, 9)
    together = psa.simulate_many(model, values, record())
    assert together.shape == (9, 600)
    for k in (0, 3, 4, 8):
        assert np.array_equal(psa.simulate_many(model, [values[k]], record())[0], together[k])
    assert np.array_equal(psa.simulate_many(model, values[::-1], record()), together[::-1])


def test_what_is_kept_of_each_set() -> None:
    """Whole rows, a number and an array of each set; of groups of four lanes and of the stepper."""
    model = stack("P-885.51")
    values = sets(model, 5)
    for one in (record(), record(uneven=True)):
        rows = psa.simulate_many(model, values, one)
        ranges = psa.simulate_many(model, values, one, reduce=np.ptp)
        thinned = psa.simulate_many(model, values, one, reduce=lambda row: row[::100])
        assert np.array_equal(ranges, np.ptp(rows, axis=1))
        assert np.array_equal(thinned, rows[:, ::100])


def test_sets_by_the_names_of_parameters() -> None:
    model = stack("P-885.51")
    inputs = sets(model, 5)
    columns = {name: [values[name] for values in inputs] for name in inputs[0]}
    rows = psa.simulate_many(model, inputs, record())
    assert np.array_equal(psa.simulate_many(model, columns, record()), rows)
    with pytest.raises(psa.InputError, match=r"in arrays of one length; .*k_L \(5,\), n \(1,\)"):
        psa.simulate_many(model, {"k_L": columns["k_L"], "n": 1.5}, record())
    with pytest.raises(psa.InputError, match="there are: none"):
        psa.simulate_many(model, {}, record())
    with pytest.raises(psa.InputError, match="no parameter 'stiffness'"):
        psa.simulate_many(model, {"stiffness": [1.0]}, record())
    with pytest.raises(psa.InputError, match="outside its bounds"):
        psa.simulate_many(model, {"n": [1.5, -1.0]}, record())


#: Memory in which some of nine sets' displacements fit at a time.
SMALL = 100_000


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> HostCuda:
    """Put this processor in the place of a GPU with little memory."""
    return lend(monkeypatch, SMALL)


def test_the_kernel_has_the_bits_of_the_lanes(host: HostCuda) -> None:
    """Nine sets in batches, whole rows and what is kept of them; squares are summed otherwise.

    Each thread holds the matrices' ladder.
    """
    model, one = stack("P-885.51"), record()
    values = sets(model, 9)
    rows = psa.simulate_many(model, values, one)
    np.testing.assert_array_equal(psa.simulate_many(model, values, one, device="cuda"), rows)
    assert host.launches[1:] == [128, 128]  # behind the question for the size of a room
    for name in ("range", "peak", "last"):
        ours = psa.simulate_many(model, values, one, reduce=name, device="cuda")
        np.testing.assert_array_equal(ours, psa.simulate_many(model, values, one, reduce=name))
    ours = psa.simulate_many(model, values, one, reduce=lambda row: row[::100], device="cuda")
    np.testing.assert_array_equal(ours, rows[:, ::100])
    measured = replace(one, displacement=rows[3])
    apart = psa.simulate_many(model, values, measured, reduce="misfit", device="cuda")
    np.testing.assert_allclose(apart, np.sqrt(np.mean((rows - rows[3]) ** 2, axis=1)), rtol=1e-13)
    np.testing.assert_allclose(
        apart, psa.simulate_many(model, values, measured, reduce="misfit"), rtol=1e-13
    )
    assert apart[3] == 0.0


def test_a_set_that_ends_leaves_the_others_alone(host: HostCuda) -> None:
    model = stack("PTBS200")
    lost = {"A": -5.0, "beta": -4000.0, "gamma": 0.0, "n": 3.0}
    values: list[dict[str, float]] = [{}, lost, {"k_L": 1.1 * model.values["k_L"]}]
    rows = psa.simulate_many(model, values, record())
    assert np.isnan(rows[1, -1])
    assert np.isfinite(rows[[0, 2]]).all()
    assert np.array_equal(rows[[0, 2]], psa.simulate_many(model, values[::2], record()))
    np.testing.assert_array_equal(psa.simulate_many(model, values, record(), device="cuda"), rows)
    ranges = psa.simulate_many(model, values, record(), reduce="range", device="cuda")
    np.testing.assert_array_equal(ranges, np.ptp(rows, axis=1))
    assert host.launches


@slow
def test_ports_that_feed_back_are_solved_identically(host: HostCuda) -> None:
    """The matrices' ladder is too large for the memory of a thread."""
    model = stack("P-885.51").with_effect(psa.EFFECTS["load_stiffness"], {"load_gain": 0.02})
    values = sets(model, 3)
    rows = psa.simulate_many(model, values, record())
    np.testing.assert_array_equal(psa.simulate_many(model, values, record(), device="cuda"), rows)
    assert host.launches[1:] == [128, 128, 128]  # one fits in the memory


@pytest.mark.parametrize("effect", ["slow_creep", "structural_mode"])
def test_starts_of_many_sets_have_the_bits_of_each(effect: str) -> None:
    """Creep has a memory that settles; a gain of zero is not taken out before."""
    gain = psa.EFFECTS[effect].gain
    assert gain is not None
    model = stack("P-885.51").with_effect(psa.EFFECTS[effect], {gain: 0.01})
    changed = [{**values, gain: 0.0 if k == 3 else 0.01} for k, values in enumerate(sets(model, 9))]
    models = [model.with_values(values) for values in changed]
    t, u = record().time, record_inputs(model, record(), 600)
    p, nominal = (
        np.array(rows).T
        for rows in ([m.parameter_vector() for m in models], [m.state_nominals() for m in models])
    )
    alone = np.column_stack([start_on(m, t, u).x for m in models])
    np.testing.assert_array_equal(starts_on(model, p, nominal, t, u), alone)
    assert np.ptp(alone, axis=1).any()


def test_what_a_gpu_cannot_do_is_refused(host: HostCuda) -> None:
    model = stack("P-885.51")
    with pytest.raises(psa.InputError, match="exact steps fit: the record has 595 different time"):
        psa.simulate_many(model, [{}], record(uneven=True), device="cuda")
    with pytest.raises(psa.InputError, match=r"exact steps fit: .* another kink"):
        psa.simulate_many(psa.compose((*psa.BASE, KINK)), [{}], record(), device="cuda")
    with pytest.raises(psa.InputError, match=r"no device 'tpu'; choose one of \('cpu', 'cuda'\)"):
        psa.simulate_many(model, [{}], record(), device="tpu")  # type: ignore[arg-type]
    with pytest.raises(psa.InputError, match=r"no reduction 'mean'; choose one of .*'misfit'"):
        psa.simulate_many(model, [{}], record(), reduce="mean")  # type: ignore[arg-type]
    with pytest.raises(
        psa.InputError, match="'misfit' needs the displacement of the record 'sets'"
    ):
        psa.simulate_many(model, [{}], record(), reduce="misfit")
    assert not host.launches
    assert psa.simulate_many(model, [], record(), device="cuda").shape == (0, 600)


def test_a_gpu_that_fails_is_an_error(host: HostCuda, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(shape: object, dtype: object = None) -> None:
        raise MemoryError("out of memory allocating 512 bytes")

    monkeypatch.setattr(host, "empty", full)
    with pytest.raises(psa.MachineError, match=r"GPU failed \(out of memory .*nvidia-smi"):
        psa.simulate_many(stack("P-885.51"), [{}], record(), device="cuda")


@pytest.mark.parametrize(
    ("cupy", "message"),
    [
        ({"side_effect": ModuleNotFoundError("No module named 'cupy'")}, r"No .*'cupy'.*\[gpu\]"),
        (
            {"return_value.cuda.runtime.getDeviceCount.side_effect": RuntimeError("no driver")},
            r"no GPU \(no driver\); .*nvidia-smi",
        ),
        ({"return_value.cuda.runtime.getDeviceCount.return_value": 0}, "CUDA_VISIBLE_DEVICES"),
    ],
    ids=["no CuPy", "no driver", "no GPU"],
)
def test_a_missing_gpu_is_an_error(
    monkeypatch: pytest.MonkeyPatch, cupy: dict[str, object], message: str
) -> None:
    monkeypatch.setattr(device, "import_module", Mock(**cupy))
    with pytest.raises(psa.InputError, match=message):
        psa.simulate_many(stack("P-885.51"), [{}], record(), device="cuda")


def test_a_gpu_gives_what_the_processor_gives() -> None:
    """Where there is a GPU: the same equations in double precision, rounded one by one."""
    try:
        device.device_module()
    except psa.InputError as error:
        pytest.skip(str(error))
    model = stack("P-885.51")
    inputs = sets(model, 300)
    rows = psa.simulate_many(model, inputs, record())
    size = np.ptp(rows, axis=1)
    values = psa.simulate_many(model, inputs, record(), device="cuda")
    assert np.max(np.abs(values - rows) / size[:, None]) < 1e-9
    ranges = psa.simulate_many(model, inputs, record(), reduce="range", device="cuda")
    np.testing.assert_array_equal(ranges, np.ptp(values, axis=1))
