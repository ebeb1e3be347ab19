"""Starts far from 0 and long communication steps: the same results as near 0."""

from itertools import pairwise

import numpy as np
import pytest

from psa_casadi.errors import InputError
from psa_casadi.export.importer.fmu import CO_SIMULATION, ERROR, MODEL_EXCHANGE, Fmu, FmuError
from psa_casadi.simulation.simulate import simulate
from psa_casadi.simulation.stepper import run
from psa_casadi.units import FloatArray
from tests import sampled_fmus
from tests.fmi3_instances import Instance3, Update
from tests.fmu_models import exported, model_named
from tests.sampled_models import PERIOD, loop
from tests.tiers import slow, slow_but

STACK = "P-885.51"
VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
STARTS = (0.1, 5.0, 1e3, 1e6)
#: None: the importer names no tolerance.
TOLERANCES = pytest.mark.parametrize("tolerance", [None, 1e-8, 1e-12])


def _held(
    fmu: Fmu, points: FloatArray, sizes: FloatArray, tolerance: float | None = None
) -> FloatArray:
    """Hold 100 V and 0 V in turn from each communication point on; return the displacements."""
    found = []
    with fmu.start(CO_SIMULATION, tolerance=tolerance, start_time=float(points[0])) as slave:
        for k, (point, size) in enumerate(zip(points, sizes, strict=True)):
            slave.set({"voltage": 100.0 * (1 - k % 2)})
            slave.step(float(point), float(size))
            found.append(slave.get(["displacement"])[0])
    return np.array(found)


def _sums(start: float, sizes: FloatArray) -> FloatArray:
    """Return the communication points of an importer that adds the sizes up."""
    return np.array([*np.cumsum([start, *sizes[:-1]])])


@VERSIONS
@TOLERANCES
def test_results_do_not_depend_on_the_start(fmi: int, tolerance: float | None) -> None:
    """Bit for bit where the importer adds the sizes up, as the FMU does."""
    sizes = np.full(20, 1e-4)
    with Fmu(exported(STACK, fmi)) as fmu:
        near = _held(fmu, _sums(0.0, sizes), sizes, tolerance)
        assert np.ptp(near) > 5e-6
        for start in STARTS:
            assert np.array_equal(_held(fmu, _sums(start, sizes), sizes, tolerance), near)


def test_points_that_are_rounded_cost_no_more_than_their_rounding() -> None:
    """An importer whose points are start + k size moves each by up to half a last place."""
    sizes = np.full(20, 1e-4)
    with Fmu(exported(STACK)) as fmu:
        near = _held(fmu, _sums(0.0, sizes), sizes, 1e-10)
        for start in STARTS:
            far = _held(fmu, np.array([start + k * 1e-4 for k in range(20)]), sizes, 1e-10)
            fastest = 2.0 * np.abs(np.diff(near)).max() / 1e-4
            assert np.abs(far - near).max() < fastest * np.spacing(start) + 1e-9 * np.ptp(near)


@VERSIONS
@TOLERANCES
def test_long_steps(fmi: int, tolerance: float | None) -> None:
    """A step of up to 10,000 s starts with as short a solver step as its jump needs."""
    rest = {}
    with Fmu(exported(STACK, fmi)) as fmu:
        for start in (0.0, 1e6):
            for size in (1.0, 10.0, 1e4):
                sizes = np.full(3, size)
                rest[start, size] = _held(fmu, _sums(start, sizes), sizes, tolerance)
    found = np.array(list(rest.values()))
    error = np.abs(found - rest[0.0, 1.0]).max() / np.ptp(found)
    assert error < 10.0 * (tolerance or 1e-6)
    assert np.array_equal(rest[0.0, 1e4], rest[1e6, 1e4])


def test_a_jump_within_a_long_step() -> None:
    """An input that is set 1,000 s into a step or later is taken as well as one at its start."""
    moments: list[tuple[float, bool]] = []

    def jump(slave: Instance3, update: Update) -> None:
        if not moments and update.time > 1e6 + 1e3:
            moments.append((update.time, update.set_requested))
            slave.set({"voltage": 30.0})

    with Fmu(exported(STACK, 3)) as fmu:
        with Instance3(fmu, watcher=jump).start(tolerance=1e-10, start_time=1e6) as slave:
            slave.set({"voltage": 100.0})
            slave.step(1e6, 1e4)
            varied = slave.get(["displacement"])[0]
        with fmu.start(CO_SIMULATION, tolerance=1e-10) as other:
            for k, voltage in enumerate((100.0, 30.0)):
                other.set({"voltage": voltage})
                other.step(5e3 * k, 5e3)
            plain = other.get(["displacement"])[0]
    assert len(moments) == 1
    assert moments[0][1]
    assert varied == pytest.approx(plain, rel=1e-8)


@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
def test_a_simulation_that_starts_late(rtol: float) -> None:
    model, t = model_named(STACK).plant(), np.arange(65) / 4096.0  # exact wherever they are put
    v = np.where(t < 4e-3, 100.0, 20.0)
    near = simulate(model, t, v, rtol=rtol, from_rest_at_zero=True)
    for start in (10.0, 1e3, 1e6):
        far = simulate(model, start + t, v, rtol=rtol, from_rest_at_zero=True)
        assert np.abs(far.displacement - near.displacement).max() < 1e-12 * np.ptp(
            near.displacement
        )


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
    with Fmu(sampled_fmus.exported("loop", fmi)) as fmu:
        runs = []
        for start in (0.0, 1e6 * PERIOD, 1e9 * PERIOD):
            with fmu.start(CO_SIMULATION, tolerance=1e-9, start_time=start) as slave:
                slave.set({"reference": 1.0})
                found = []
                for begin, end in pairwise(start + times):
                    slave.step(float(begin), float(end - begin))
                    found.append(slave.get(["shown", "voltage"]))
            runs.append(np.array(found))
    assert np.ptp(runs[0][:, 1]) > 0.05
    assert np.abs(runs[1] - runs[0]).max() < 1e-8
    assert np.abs(runs[2] - runs[0]).max() < 1e-5


@slow
@VERSIONS
def test_instants_that_cannot_be_counted_are_refused(fmi: int) -> None:
    """By the start, by a step, by the period, in model exchange, and outside of an FMU."""
    with Fmu(sampled_fmus.exported("loop", fmi)) as fmu:
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
    with pytest.raises(InputError, match="cannot be counted up to"):
        run(plant, t, np.zeros((2, len(plant.input_names))), np.zeros(len(plant.state_names)))
