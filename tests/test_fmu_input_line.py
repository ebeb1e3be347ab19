"""The option input_line: inputs go on along the line through their last two values."""

from itertools import pairwise

import numpy as np
import pytest

from psa_casadi.export.importer.fmu import CO_SIMULATION, ERROR, Fmu, FmuError, Instance
from psa_casadi.reference import simulate
from psa_casadi.units import FloatArray
from tests.fmi3_instances import Instance3
from tests.fmu_models import exported, model_named

STACK = "P-885.51"
FREQUENCY = 50.0
END = 2.0 / FREQUENCY
VERSIONS = pytest.mark.parametrize("fmi", [2, 3])


def _signal(t: FloatArray) -> FloatArray:
    return 60.0 - 60.0 * np.cos(2 * np.pi * FREQUENCY * t)


@pytest.fixture(scope="module")
def truth() -> dict[float, float]:
    """Displacement at the ends of all steps that are tried, by a computation of its own."""
    times = np.linspace(0.0, END, 2 * 3200 + 1)
    run = simulate(model_named(STACK).values, lambda t: float(_signal(np.array(t))), times)
    return dict(zip(np.round(times, 9).tolist(), run.displacement.tolist(), strict=True))


def _run(slave: Instance, count: int, first: int = 0, end: int | None = None) -> FloatArray:
    """Hold samples of the signal over steps; return the displacements at their ends."""
    times = np.linspace(0.0, END, count + 1)
    found = []
    for begin, stop in pairwise(times[first : end and end + 1]):
        slave.set({"voltage": float(_signal(begin))})
        slave.step(float(begin), float(stop - begin))
        found.append(slave.get(["displacement"])[0])
    return np.array(found)


def _error(fmu: Fmu, count: int, line: float, truth: dict[float, float]) -> float:
    """Return the largest error over the second period, as a share of the range."""
    with fmu.start(CO_SIMULATION, tolerance=1e-8, values={"input_line": line}) as slave:
        found = _run(slave, count)
    ends = np.round(np.linspace(0.0, END, count + 1)[1:], 9)
    known = np.array([truth[t] for t in ends.tolist()])
    return float(np.abs(found - known)[count // 2 :].max() / np.ptp(list(truth.values())))


@VERSIONS
def test_coarse_steps(fmi: int, truth: dict[float, float]) -> None:
    """Steps of a 100th to a 400th of a period: held the error falls with the step, else faster."""
    with Fmu(exported(STACK, fmi)) as fmu:
        held, line = ([_error(fmu, n, x, truth) for n in (200, 400, 800)] for x in (0.0, 1.0))
    assert all(1.8 < a / b < 2.4 for a, b in pairwise(held))
    assert all(a / b > 3.5 for a, b in pairwise(line))
    assert held[0] > 0.015
    assert line[0] < held[0] / 3.5
    assert line[1] < held[1] / 10.0


def test_steps_that_the_page_promises(truth: dict[float, float]) -> None:
    """0.1 % of the range at 1/1600 of a period held, at 1/200 along the line."""
    with Fmu(exported(STACK, 3)) as fmu:
        assert 5e-4 < _error(fmu, 2 * 1600, 0.0, truth) < 1e-3
        assert 5e-4 < _error(fmu, 2 * 200, 1.0, truth) < 1e-3


@VERSIONS
def test_a_value_that_is_not_set_again_is_held(fmi: int) -> None:
    """What an importer leaves alone does not drift on, nor does a long step go far on its line."""
    with Fmu(exported(STACK, fmi)) as fmu:
        for line in (0.0, 0.5, 1.0):
            with fmu.start(CO_SIMULATION, values={"input_line": line}) as slave:
                _run(slave, 200, end=20)
                last = float(_signal(np.array(19 * END / 200)))
                slave.set({"voltage": 40.0})
                found = []
                for k in range(4):
                    slave.step(20 * END / 200 + k * 0.2, 0.2)
                    found.append(slave.get(["voltage"])[0])
            assert found == pytest.approx([40.0 + line * (40.0 - last), 40.0, 40.0, 40.0])


def test_given_rates_come_first(truth: dict[float, float]) -> None:
    """FMI 2.0: an input with a rate for the step does not follow the line."""
    del truth
    with Fmu(exported(STACK, 2)) as fmu:
        runs = []
        for line in (0.0, 1.0):
            with fmu.start(CO_SIMULATION, values={"input_line": line}) as slave:
                found = []
                for k in range(10):
                    slave.set({"voltage": 5.0 * k})
                    slave.set_rates({"voltage": 1e4})
                    slave.step(k * 1e-3, 1e-3)
                    found.append(slave.get(["displacement", "voltage"]))
                runs.append(np.array(found))
    assert np.array_equal(runs[0], runs[1])


@VERSIONS
def test_the_line_is_part_of_the_state(fmi: int) -> None:
    with Fmu(exported(STACK, fmi)) as fmu:
        with fmu.start(CO_SIMULATION, values={"input_line": 1.0}) as slave:
            _run(slave, 100, end=10)
            snapshot = slave.save()
            data = slave.serialize(snapshot)
            first = _run(slave, 100, first=10, end=20)
            slave.restore(snapshot)
            slave.drop(snapshot)
            assert np.array_equal(_run(slave, 100, first=10, end=20), first)
            slave.require("Reset")
            slave.setup()
            assert slave.get(["input_line"])[0] == 0.0
        with fmu.open(CO_SIMULATION) as other:
            copy = other.deserialize(data)
            other.restore(copy)
            other.drop(copy)
            assert np.array_equal(_run(other, 100, first=10, end=20), first)
            with pytest.raises(FmuError, match="'input_line' can be set only before the first"):
                other.set({"input_line": 0.0})
        with fmu.open(CO_SIMULATION) as other:
            with pytest.raises(FmuError, match="'input_line' cannot be set to 2: it must") as told:
                other.set({"input_line": 2.0})
            assert told.value.status == ERROR


def test_a_jump_in_event_mode_starts_a_new_line() -> None:
    """FMI 3.0: the step after event mode is held, whatever was given before."""
    with Fmu(exported(STACK, 3)) as fmu:
        ends = []
        for line in (0.0, 1.0):
            with Instance3(fmu, events=True).start({"input_line": line}) as slave:
                slave.require("EnterStepMode")
                for k, voltage in enumerate((20.0, 20.0, 90.0)):
                    if k == 2:
                        slave.require("EnterEventMode")
                        slave.update_discrete_states()
                    slave.set({"voltage": voltage})
                    if k == 2:
                        slave.require("EnterStepMode")
                    slave.step(k * 1e-3, 1e-3)
                ends.append(slave.get(["displacement", "voltage"]))
    assert np.array_equal(ends[0], ends[1])
    assert ends[0][1] == 90.0
