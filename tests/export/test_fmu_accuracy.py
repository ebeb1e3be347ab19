"""The FMU keeps the tolerance that its importer asks for, whatever input, step and start.

Errors are shares of the output's range, or of its nominal where that is larger (a stack that hardly
moves is compared to the digits of its absolute tolerance)."""

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.check.agreement import expected_outputs
from psa_casadi.export.importer.fmu import CO_SIMULATION, ERROR, MODEL_EXCHANGE, Fmu, FmuError
from psa_casadi.export.importer.masters import Signals, co_simulate, communicate
from psa_casadi.model.variables import nominal_value
from psa_casadi.reference import simulate
from tests.export.fmu_models import exported, model_named
from tests.model.sampled_models import PERIOD, loop
from tests.studies.benchmarks.fmu import STEP_SHARE, TIGHTEST_STEP
from tests.tiers import slow, slow_but

STACKS = ("PTBS200", "WYDS0808020", "P-885.51", "manipulator", "slow_creep")
#: The one of the quick tier.
ONE = "P-885.51"
TOLERANCES = (1e-3, 1e-5, 1e-7)
FACTOR = 10.0


def _grid(end: float, step: float) -> FloatArray:
    return np.array([round(k * step, 12) for k in range(round(end / step) + 1)])


#: 10 kHz, as a recorder keeps it.
GRID = _grid(2e-2, 1e-4)
_TONES = ((50.0, 0.30, 0.0), (170.0, 0.12, 1.0), (610.0, 0.05, 2.0))
_WAVE = sum((a * (np.sin(2 * np.pi * f * GRID + p) - np.sin(p)) for f, a, p in _TONES), 0.0 * GRID)
#: Times, and voltages as shares of the rated one.
SIGNALS: dict[str, tuple[FloatArray, Any]] = {
    # up, down, held and reversed: four kinks, two reversals, one of them within a step
    "ramps": (np.array([0.0, 4e-3, 7e-3, 1e-2, 1.05e-2, 2e-2]),
              np.array([0.0, 1.0, 0.3, 0.3, 0.9, 0.1])),
    # a sum of sines, rounded, with a kink at every sample
    "sampled": (GRID, np.round(0.5 * np.minimum(GRID / 5e-3, 1.0) + 0.5 * _WAVE, 4)),
    # a reversing voltage of a ten-thousandth
    "whisper": (np.array([0.0, 3e-3, 6e-3, 9e-3, 2e-2]),
                1e-4 * np.array([0.0, 1.0, -1.0, 0.5, -0.5])),
}  # fmt: skip


def _signals(name: str, kind: str) -> Signals:
    times, shares = SIGNALS[kind]
    voltage = model_named(name).values["u_rated"] * shares
    columns = np.column_stack([voltage, 0.0 * voltage])
    return Signals(("voltage", "load_force"), times, columns)


@cache
def _expected(name: str, kind: str) -> FloatArray:
    """Return the displacement every 0.1 ms by a computation at 1e-10 or tighter."""
    model = model_named(name).plant()
    values = expected_outputs(model, GRID, _signals(name, kind))
    column: FloatArray = values[:, model.output_names.index("displacement")]
    return column


def _scale(name: str, expected: FloatArray) -> float:
    model = model_named(name).plant()
    nominal = model.output_nominals()[model.output_names.index("displacement")]
    return float(max(np.ptp(expected), nominal))


#: One stack with every signal and tolerance, the others with any two of the three.
PLAYED = [(ONE, kind, tolerance) for kind in SIGNALS for tolerance in TOLERANCES]
IN_TURN = [
    (name, kind, TOLERANCES[(k + j) % 3])
    for k, name in enumerate(n for n in STACKS if n != ONE) for j, kind in enumerate(SIGNALS)
]  # fmt: skip


@pytest.mark.parametrize(("name", "kind", "tolerance"), slow_but(PLAYED, [*PLAYED, *IN_TURN]))
def test_error_is_within_ten_tolerances(name: str, kind: str, tolerance: float) -> None:
    expected = _expected(name, kind)
    with Fmu(exported(name)) as fmu:
        values = co_simulate(fmu, GRID, _signals(name, kind), ["displacement"], tolerance=tolerance)
    error = np.max(np.abs(values[:, 0] - expected)) / _scale(name, expected)
    assert error < FACTOR * tolerance


def _held(
    fmu: Fmu, points: FloatArray, sizes: FloatArray, levels: FloatArray, tolerance: float | None
) -> FloatArray:
    """Hold a level from each point on; return the displacement at the ends of the steps."""
    items = []
    with fmu.start(CO_SIMULATION, tolerance=tolerance, start_time=float(points[0])) as slave:
        for point, size, level in zip(points, sizes, levels, strict=True):
            slave.set({"voltage": float(level)})
            slave.step(float(point), float(size))
            items.append(slave.get(["displacement"])[0])
    return np.array(items)


#: Within this time [s] of a constant voltage each of the stacks has come to rest.
_REST = 0.3
_SIZES = np.array([1e-6, 1e-2, 1e-5, 1e-3, 1e-4, 10.0, 1e-6, 3e-5, 1000.0])
_SHARES = np.array([1.0, 0.0, 0.6, -0.1, 0.8, 0.2, 1.0, 0.1, 0.5])


@cache
def _after_jumps(name: str) -> FloatArray:
    """Return the displacement at the end of every level; the reference does not wait past rest."""
    model = model_named(name)
    times = np.concatenate([[0.0], np.cumsum(np.minimum(_SIZES, _REST))])
    levels = model.values["u_rated"] * _SHARES

    def voltage(t: float) -> float:
        level = int(np.searchsorted(times, t, side="right")) - 1
        return float(levels[min(level, len(levels) - 1)])

    return simulate(model.values, voltage, times, breakpoints=list(times)).displacement[1:]


@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize("name", slow_but(["PTBS200"], ["PTBS200", ONE, "manipulator"]))
def test_jumps_and_steps_from_a_microsecond_to_a_quarter_hour(name: str, tolerance: float) -> None:
    """The voltage jumps at every communication point; the steps span nine decades."""
    expected = _after_jumps(name)
    levels = model_named(name).values["u_rated"] * _SHARES
    with Fmu(exported(name)) as fmu:
        result = _held(fmu, _sums(0.0, _SIZES), _SIZES, levels, tolerance)
    error = np.max(np.abs(result - expected)) / _scale(name, expected)
    assert error < FACTOR * tolerance


@pytest.mark.parametrize("name", slow_but([ONE], ["PTBS200", ONE, "slow_creep", "flexure"]))
def test_output_derivatives_are_those_of_the_outputs(name: str) -> None:
    """Against differences of fourth order over 4 us of a run with the same ramps as inputs."""
    model = model_named(name).plant()
    outputs, at, h = model.output_names, 1.3e-3, 1e-6
    slopes = 2e3 * np.array([nominal_value(i.nominal, model.values)
                             for i in model.structure.inputs])  # fmt: skip
    times = np.array([0.0, at - 2 * h, at - h, at, at + h, at + 2 * h])
    inputs = Signals(model.input_names, times, np.outer(times, slopes))
    with Fmu(exported(name)) as fmu:
        y = co_simulate(fmu, times, inputs, outputs, tolerance=1e-9)
        with fmu.start(CO_SIMULATION, tolerance=1e-9) as instance:
            communicate(instance, times[:4], inputs.on(times[:4]), outputs)
            rates = instance.output_rates(outputs)
    expected = (8.0 * (y[4] - y[2]) - (y[5] - y[1])) / (12.0 * h)
    size = np.maximum(np.abs(expected), np.max(np.abs(y), axis=0) / at)
    assert np.all(np.abs(rates - expected) < 1e-4 * size)


def test_every_solver_step_gets_a_share_of_the_tolerance() -> None:
    """The bench counts the work of the FMU: as many steps as the simulator's."""
    name, tolerance = "P-885.51", 1e-5
    times, inputs = GRID, _signals(name, "sampled")
    with Fmu(exported(name)) as fmu, fmu.start(CO_SIMULATION, tolerance=tolerance) as instance:
        instance.require("SetDebugLogging", 1, 0, None)
        communicate(instance, times, inputs, ["displacement"])
        items = [m for m in instance.messages if "solver steps" in m]
    steps = sum(int(m.partition(": ")[2].split()[0]) for m in items)
    model = model_named(name).plant()
    u = np.zeros((len(times), len(model.input_names)))
    u[:, model.input_names.index("voltage")] = inputs.at(times)[:, 0]
    again = psa.run(
        model, times, u, np.zeros(len(model.state_names)),
        rtol=max(STEP_SHARE * tolerance, TIGHTEST_STEP),
    )  # fmt: skip
    assert len(items) == len(times) - 1
    assert steps == again.steps


STACK = "P-885.51"
VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
STARTS = (0.1, 5.0, 1e3, 1e6)
#: None: the importer names no tolerance.
REQUESTED = pytest.mark.parametrize("tolerance", [None, 1e-8, 1e-12])


def _alternating(fmu: Fmu, start: float, sizes: FloatArray, tolerance: float | None) -> FloatArray:
    """Hold 100 V and 0 V in turn from each communication point on; return the displacements."""
    levels = np.where(np.arange(len(sizes)) % 2, 0.0, 100.0)
    return _held(fmu, _sums(start, sizes), sizes, levels, tolerance)


def _sums(start: float, sizes: FloatArray) -> FloatArray:
    """Return the communication points of an importer that adds the sizes up."""
    return np.array([*np.cumsum([start, *sizes[:-1]])])


@VERSIONS
@REQUESTED
def test_results_do_not_depend_on_the_start(fmi: int, tolerance: float | None) -> None:
    """Bit for bit where the importer adds the sizes up, as the FMU does."""
    sizes = np.full(20, 1e-4)
    with Fmu(exported(STACK, fmi)) as fmu:
        near = _alternating(fmu, 0.0, sizes, tolerance)
        assert np.ptp(near) > 5e-6
        for start in STARTS:
            assert np.array_equal(_alternating(fmu, start, sizes, tolerance), near)


@VERSIONS
@REQUESTED
def test_long_steps(fmi: int, tolerance: float | None) -> None:
    """A step of up to 10,000 s starts with as short a solver step as its jump needs."""
    rest = {}
    with Fmu(exported(STACK, fmi)) as fmu:
        for start in (0.0, 1e6):
            for size in (1.0, 10.0, 1e4):
                sizes = np.full(3, size)
                rest[start, size] = _alternating(fmu, start, sizes, tolerance)
    result = np.array(list(rest.values()))
    error = np.abs(result - rest[0.0, 1.0]).max() / np.ptp(result)
    assert error < 10.0 * (tolerance or 1e-6)
    assert np.array_equal(rest[0.0, 1e4], rest[1e6, 1e4])


def test_a_step_below_the_resolution_of_time_is_refused() -> None:
    with Fmu(exported(STACK)) as fmu, fmu.start(CO_SIMULATION, start_time=1e9) as slave:
        with pytest.raises(FmuError, match="cannot tell its end from its begin") as refusal:
            slave.step(1e9, 1e-8)
        assert refusal.value.status == ERROR
        slave.step(1e9, 1e-3)


@pytest.mark.parametrize("fmi", slow_but([2], [2, 3]))
def test_sampled_states_far_from_zero(fmi: int) -> None:
    """A million seconds on, each instant is where it is near 0 to the rounding of the time."""
    times = np.arange(24) * (PERIOD / 4.0)
    with Fmu(exported("loop", fmi)) as fmu:
        runs = []
        for start in (0.0, 1e6 * PERIOD, 1e9 * PERIOD):
            with fmu.start(CO_SIMULATION, tolerance=1e-9, start_time=start) as slave:
                slave.set({"reference": 1.0})
                items = []
                for begin, end in pairwise(start + times):
                    slave.step(float(begin), float(end - begin))
                    items.append(slave.get(["measured", "voltage"]))
            runs.append(np.array(items))
    assert np.ptp(runs[0][:, 1]) > 0.05
    assert np.abs(runs[1] - runs[0]).max() < 1e-8
    assert np.abs(runs[2] - runs[0]).max() < 1e-5


@slow
@VERSIONS
def test_instants_that_cannot_be_counted_are_refused(fmi: int) -> None:
    """By the start, by a step, by the period, in model exchange, and outside of an FMU."""
    with Fmu(exported("loop", fmi)) as fmu:
        for start in (1e14 * PERIOD, 1e300):
            with (
                fmu.open(CO_SIMULATION) as slave,
                pytest.raises(FmuError, match="cannot be counted up to"),
            ):
                slave.setup(start_time=start)
        with fmu.start(CO_SIMULATION, start_time=1e12 * PERIOD) as slave:
            slave.step(1e12 * PERIOD, 3 * PERIOD)
            with pytest.raises(FmuError, match="Sample periods of"):
                slave.set({"T_s": PERIOD / 100.0})
            with pytest.raises(FmuError, match="cannot be counted up to"):
                slave.step((1e12 + 3) * PERIOD, 1e14 * PERIOD)
        with fmu.start(MODEL_EXCHANGE) as model:
            assert model.call("SetTime", 1e14 * PERIOD) == ERROR
            assert model.get(["time"])[0] == 0.0
    plant = loop()
    t = 1e14 * PERIOD * (1.0 + np.array([0.0, 1e-9]))
    with pytest.raises(psa.InputError, match="cannot be counted up to"):
        psa.run(plant, t, np.zeros((2, len(plant.input_names))), np.zeros(len(plant.state_names)))
