"""Sampled states in an FMU: both versions and interfaces, against an independent recursion."""

import fmpy
import numpy as np
import pytest

from psa_casadi.export.importer.fmu import (
    CO_SIMULATION,
    MODEL_EXCHANGE,
    Fmu,
    Instance,
)
from psa_casadi.export.importer.masters import Signals, co_simulate, integrate
from tests.fmi3_instances import Instance3
from tests.sampled_fmus import exported
from tests.sampled_models import PERIOD, FloatArray, expected, grid

VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
SLOPE = 30.0
OUTPUTS = ("shown", "voltage")

#: Communication steps in periods: they divide it, are it, do not divide it, exceed it.
STEPS = pytest.mark.parametrize("step", [0.25, 1.0, 0.7, 2.5])


def reference(slope: float) -> Signals:
    """Return no disturbance, and a reference that starts at 1 m and rises."""
    values = np.array([[0.0, 1.0], [0.0, 1.0 + slope]])
    return Signals(("disturbance", "reference"), np.array([0.0, 1.0]), values)


def error(found: FloatArray, times: FloatArray, slope: float) -> float:
    truth = expected(times, 1.0, slope)
    return float(np.abs(found - np.column_stack([truth.position, truth.voltage])).max())


@VERSIONS
@STEPS
@pytest.mark.parametrize("start", [0.0, 3.0, 0.4])
def test_co_simulation(fmi: int, step: float, start: float) -> None:
    slope = SLOPE if fmi == 2 else 0.0  # FMI 3.0 has no rates of inputs
    times = grid(round(30 / step), step, start)
    with Fmu(exported("loop", fmi)) as fmu:
        found = co_simulate(fmu, times, reference(slope), OUTPUTS, tolerance=1e-10)
    assert error(found, times, slope) < 1e-9


@VERSIONS
@STEPS
@pytest.mark.parametrize("start", [0.0, 0.4])
def test_model_exchange(fmi: int, step: float, start: float) -> None:
    times = grid(round(30 / step), step, start)
    with Fmu(exported("loop", fmi)) as fmu:
        found = integrate(fmu, times, reference(SLOPE), OUTPUTS, tolerance=1e-11)
    assert error(found, times, SLOPE) < 1e-9


@pytest.mark.parametrize("toward", [-1.0, 1.0])
def test_a_knot_that_is_an_instant_but_for_rounding(toward: float) -> None:
    times = grid(25, 0.25)
    knot = float(np.nextafter(3 * PERIOD, toward))
    jump = Signals(
        ("disturbance", "reference"), np.array([0.0, knot]), np.array([[0, 1], [0, 2.0]])
    )
    with Fmu(exported("loop", 2)) as fmu:
        held = Signals(jump.names, jump.times, jump.values, held=True)
        found = integrate(fmu, times, held, OUTPUTS, tolerance=1e-11)
    assert error(found[:12], times[:12], 0.0) < 1e-9
    assert found[12, 1] - found[11, 1] > 0.5  # the instant sees the reference after the jump


@VERSIONS
@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_fmpy_simulates_both_interfaces(fmi: int, kind: str) -> None:
    inputs = np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0)], dtype=[
        ("time", float), ("disturbance", float), ("reference", float)])  # fmt: skip
    result = fmpy.simulate_fmu(
        str(exported("loop", fmi)), stop_time=0.03, fmi_type=kind, relative_tolerance=1e-9,
        output_interval=0.7e-3, step_size=0.7e-3, input=inputs, output=list(OUTPUTS),
    )  # fmt: skip
    last = {float(row["time"]): row for row in result}  # after the events of a time
    times = np.array(sorted(last))
    found = np.array([[last[float(t)][n] for n in OUTPUTS] for t in times])
    assert len(times) > 40
    assert error(found, times, 0.0) < 1e-6


@VERSIONS
def test_rollback_between_instants(fmi: int) -> None:
    """A state taken between two instants replays the same bits, in another instance too."""
    with Fmu(exported("loop", fmi)) as fmu, fmu.start(CO_SIMULATION) as slave:
        slave.set({"reference": 1.0})
        slave.step(0.0, 1.5 * PERIOD)
        snapshot = slave.save()
        data = slave.serialize(snapshot)
        first = _replay(slave)
        assert len({row[2] for row in first}) > 3  # instants fell into it
        slave.restore(snapshot)
        assert _replay(slave) == first
        slave.drop(snapshot)
        with fmu.open(CO_SIMULATION) as other:
            copy = other.deserialize(data)
            other.restore(copy)
            other.drop(copy)
            assert _replay(other) == first


def _replay(instance: Instance) -> list[tuple[float, ...]]:
    rows = []
    for k in range(8):
        instance.step((1.5 + 0.7 * k) * PERIOD, 0.7 * PERIOD)
        rows.append(tuple(instance.get([*OUTPUTS, "command"])))
    return rows


@VERSIONS
def test_rollback_at_an_instant(fmi: int) -> None:
    """What an output shows at an instant is not yet taken: the inputs may be set again."""
    with Fmu(exported("controller", fmi)) as fmu, fmu.start(CO_SIMULATION) as slave:
        slave.set({"reference": 1.0, "position": 0.5})
        assert slave.get(["voltage"])[0] == pytest.approx(0.3)
        slave.set({"position": 0.0})
        assert slave.get(["voltage"])[0] == pytest.approx(0.6)
        snapshot = slave.save()
        slave.step(0.0, 0.5 * PERIOD)
        slave.set({"position": 0.7})
        assert slave.get(["voltage", "integral"]) == pytest.approx([0.6, 0.15])
        slave.restore(snapshot)
        slave.drop(snapshot)
        slave.set({"position": 1.0})
        slave.step(0.0, 0.5 * PERIOD)
        assert slave.get(["voltage", "integral"]) == pytest.approx([0.0, 0.0])


@VERSIONS
def test_time_events_of_model_exchange(fmi: int) -> None:
    with Fmu(exported("loop", fmi)) as fmu, fmu.open(MODEL_EXCHANGE) as instance:
        instance.setup(start_time=0.4 * PERIOD)
        instance.update_discrete_states()
        assert instance.next_event_time == PERIOD
        instance.require("EnterContinuousTimeMode")
        instance.set({"reference": 1.0})
        instance.require("SetTime", 0.7 * PERIOD)
        instance.require("EnterEventMode")  # of the importer, not an instant
        instance.update_discrete_states()
        assert instance.next_event_time == PERIOD
        assert instance.get(["command"])[0] == 0.0
        instance.require("EnterContinuousTimeMode")
        instance.require("SetTime", PERIOD)
        assert instance.get(["command"])[0] == 0.0
        instance.require("EnterEventMode")
        assert instance.update_discrete_states() == [False] * 4 + [True]
        assert instance.next_event_time == 2 * PERIOD
        assert instance.get(["command"])[0] == pytest.approx(0.6)
        instance.set({"reference": 2.0})  # an iteration over the event
        instance.update_discrete_states()
        assert instance.get(["voltage"])[0] == pytest.approx(1.2)
        instance.require("EnterContinuousTimeMode")
        instance.set({"reference": 3.0})
        assert instance.get(["voltage"])[0] == pytest.approx(1.2)
        instance.set({"T_s": 0.3 * PERIOD})
        instance.require("EnterEventMode")
        instance.update_discrete_states()
        assert instance.next_event_time == pytest.approx(1.2 * PERIOD)


def test_event_mode_of_co_simulation() -> None:
    with Fmu(exported("loop", 3)) as fmu, Instance3(fmu, events=True).start() as slave:
        slave.update_discrete_states()
        assert slave.next_event_time == PERIOD
        slave.require("EnterStepMode")
        needed = [slave.try_step(k * PERIOD / 4, PERIOD / 4).event_needed for k in range(8)]
        assert needed == [False, False, False, True] * 2
        slave.require("EnterEventMode")
        slave.set({"reference": 1.0})
        slave.update_discrete_states()
        assert slave.next_event_time == 3 * PERIOD
        assert slave.get(["voltage"])[0] == pytest.approx(0.6)


def test_early_return_at_an_instant() -> None:
    """A step that is ended at an instant inside of it goes on to the same end."""
    ends = []
    for watcher in (None, lambda _, u: u.time if abs(u.time - 2 * PERIOD) < 1e-12 else None):
        with (
            Fmu(exported("loop", 3)) as fmu,
            Instance3(fmu, watcher=watcher).start(tolerance=1e-10) as slave,
        ):
            slave.set({"reference": 1.0})
            done = slave.try_step(0.0, 3.6 * PERIOD)
            assert done.early == (watcher is not None)
            if done.early:
                assert done.time == 2 * PERIOD
                slave.step(done.time, 3.6 * PERIOD - done.time)
            ends.append(slave.get([*OUTPUTS, "integral"]))
    assert np.abs(ends[0] - ends[1]).max() < 1e-9
