"""The FMI 3.0 face: its states, what it refuses and why, intermediate updates, snapshots."""

import struct
from collections.abc import Iterator
from ctypes import c_bool, c_double, c_int32, c_size_t

import numpy as np
import pytest
from fmpy.fmi3 import FMU3ScheduledExecution

from psa_casadi.export.importer.fmu import (
    CO_SIMULATION,
    ERROR,
    MODEL_EXCHANGE,
    OK,
    Fmu,
    FmuError,
)
from tests.export.fmi3_instances import Instance3, Update, loaded
from tests.export.fmu_models import exported

STACK = "P-885.51"
OUTPUTS = ["displacement", "velocity", "current", "charge"]


@pytest.fixture
def slave() -> Iterator[Instance3]:
    with Instance3(loaded(STACK)) as instance:
        yield instance.start()


@pytest.mark.parametrize("interface", [CO_SIMULATION, MODEL_EXCHANGE])
@pytest.mark.parametrize(
    ("changed", "value", "said"),
    [("guid", "{0}", "token"), ("instanceName", "", "name is missing")],
)
def test_wrong_token_and_missing_name_give_no_instance(
    interface: int, changed: str, value: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for fmi in (2, 3):
        with Fmu(exported(STACK, fmi)) as fmu:
            monkeypatch.setattr(fmu.loaded(interface), changed, value)
            with pytest.raises(FmuError, match=said):
                fmu.open(interface)


def test_what_the_model_does_not_have_gives_no_instance() -> None:
    with pytest.raises(FmuError, match="no instance"):
        loaded(STACK).open(CO_SIMULATION, requiredIntermediateVariables=[10**6])
    fmu, said = loaded(STACK), list[bytes]()
    other = FMU3ScheduledExecution(
        guid=fmu.token, modelIdentifier=fmu.identifier, unzipDirectory=str(fmu.directory)
    )
    with pytest.raises(Exception, match="Failed to instantiate"):
        other.instantiate(logMessage=lambda *told: said.append(told[-1]))
    assert b"no scheduled execution" in said[-1]


def test_co_simulation_equals_that_of_fmi_2_bit_for_bit(slave: Instance3) -> None:
    with Fmu(exported(STACK)) as fmu, fmu.start(CO_SIMULATION) as older:
        for k in range(200):
            voltage = 50.0 * np.sin(0.1 * k) if k < 150 else -20.0
            slave.set({"voltage": voltage})
            older.set({"voltage": voltage})
            done = slave.try_step(k * 1e-5, 1e-5)
            assert done[:4] == (OK, False, False, False)
            assert done.time == pytest.approx((k + 1) * 1e-5)
            older.step(k * 1e-5, 1e-5)
            assert slave.get(OUTPUTS).tobytes() == older.get(OUTPUTS).tobytes()


def test_calls_out_of_order_are_refused_with_function_and_state(slave: Instance3) -> None:
    vector = (c_double * 20)()
    illegal: dict[str, tuple[object, ...]] = {
        "EnterInitializationMode": (False, 0.0, 0.0, False, 0.0),
        "ExitInitializationMode": (),
        "EnterContinuousTimeMode": (),
        "EnterStepMode": (),
        "SetTime": (0.0,),
        "EvaluateDiscreteStates": (),
        "GetContinuousStates": (vector, 20),
        "GetContinuousStateDerivatives": (vector, 20),
        "GetNominalsOfContinuousStates": (vector, 20),
    }
    for name, arguments in illegal.items():
        assert slave.call(name, *arguments) == ERROR, name
        assert f"fmi3{name}" in slave.messages[-1]
        assert "'step complete' of this co-simulation" in slave.messages[-1]
    assert slave.call("EnterEventMode") == ERROR
    assert "without event mode" in slave.messages[-1]
    assert slave.call("Terminate") == OK
    assert slave.try_step(0.0, 1e-4).status == ERROR
    assert slave.call("Reset") == OK
    slave.start()
    assert slave.try_step(0.0, 1e-4).status == OK
    with Instance3(slave.fmu, MODEL_EXCHANGE) as exchange:
        exchange.start()
        assert exchange.try_step(0.0, 1e-4).status == ERROR
        assert exchange.call("EnterStepMode") == ERROR
        assert "model exchange instance" in exchange.messages[-1]


def test_what_the_model_does_not_have_is_refused_with_the_reason(slave: Instance3) -> None:
    one, number, flag = slave.references(["voltage"]), (c_size_t * 1)(), (c_bool * 1)()
    refused: dict[str, tuple[tuple[object, ...], str]] = {
        "EnterConfigurationMode": ((), "structural parameters"),
        "GetClock": ((one, 1, flag), "no clocks"),
        "ActivateModelPartition": ((1, 0.0), "no clocks"),
        "GetNumberOfVariableDependencies": ((1, number), "modelDescription.xml"),
        "GetInt32": ((one, 1, (c_int32 * 1)(), 1), "type Float64"),
        "SetBoolean": ((one, 1, flag, 1), "type Float64"),
    }
    for name, (arguments, reason) in refused.items():
        assert slave.call(name, *arguments) == ERROR, name
        assert reason in slave.messages[-1], name
    for name in ("GetFloat32", "SetUInt8", "GetString"):
        assert slave.call(name, None, 0, None, 0) == OK
    assert slave.try_step(0.0, 1e-4).status == OK


def test_intermediate_updates_follow_the_solver_and_change_nothing(slave: Instance3) -> None:
    seen: list[tuple[Update, float]] = []

    def watcher(instance: Instance3, update: Update) -> None:
        seen.append((update, float(instance.get(["displacement"])[0])))
        assert instance.get(["time"])[0] == update.time
        assert np.isfinite(instance.output_rates(["displacement"])).all()
        assert instance.call("Reset") == ERROR

    with Instance3(loaded(STACK), watcher=watcher) as watched:
        watched.start()
        for instance in (slave, watched):
            instance.set({"voltage": 50.0})
            assert instance.try_step(0.0, 1e-3).status == OK
        times = [u.time for u, _ in seen]
        assert len(times) > 5
        assert np.all(np.diff(times) > 0.0)
        assert times[-1] == pytest.approx(1e-3)
        assert all(u.get_allowed and u.step_finished for u, _ in seen)
        assert [u.can_return_early for u, _ in seen] == [True] * (len(seen) - 1) + [False]
        assert [u.set_requested for u, _ in seen] == [True] * (len(seen) - 1) + [False]
        path = [d for _, d in seen]
        assert 0.0 < path[0] < path[-1]
        assert slave.get(OUTPUTS).tobytes() == watched.get(OUTPUTS).tobytes()
        assert slave.serialized() == watched.serialized()


@pytest.mark.parametrize("late", [0.0, 1e-4])
def test_early_return_is_honoured_where_it_was_allowed(late: float) -> None:
    asked: list[float] = []

    def watcher(_: Instance3, update: Update) -> float | None:
        if update.time > 3e-4 and not asked:
            asked.append(update.time + late)
            return asked[0]
        return None

    with Instance3(loaded(STACK), watcher=watcher) as slave, Instance3(loaded(STACK)) as plain:
        for instance in (slave, plain):
            instance.start({"voltage": 50.0})
        done = slave.try_step(0.0, 1e-3)
        assert (done.status, done.early) == (OK, True)
        assert done.time == asked.pop()
        asked.append(done.time)
        slave.step(done.time, 1e-3 - done.time)
        plain.step(0.0, 1e-3)
        both = [instance.get(["time", "displacement", "charge"]) for instance in (slave, plain)]
        assert both[0] == pytest.approx(both[1], rel=1e-5)
    asked.clear()
    with Instance3(loaded(STACK), early=False, watcher=watcher) as slave:
        slave.start({"voltage": 50.0})
        done = slave.try_step(0.0, 1e-3)
        assert (done.status, done.early) == (OK, False)
        assert done.time == pytest.approx(1e-3)
        assert asked


def test_input_set_in_an_intermediate_update_holds_from_there_on() -> None:
    """The same as a communication step that ends there and a second one with the new input."""
    jump: list[float] = []

    def watcher(instance: Instance3, update: Update) -> None:
        if update.time > 4e-4 and not jump:
            jump.append(update.time)
            assert instance.try_set({"C_p": 1e-6}) == ERROR
            assert "only inputs can" in instance.messages[-1]
            instance.set({"voltage": 80.0})

    with Instance3(loaded(STACK), watcher=watcher) as slave, Instance3(loaded(STACK)) as plain:
        slave.start({"voltage": 50.0}, tolerance=1e-7)
        assert slave.try_step(0.0, 1e-3).status == OK
        plain.start({"voltage": 50.0}, tolerance=1e-7)
        plain.try_step(0.0, jump[0])
        plain.set({"voltage": 80.0})
        plain.try_step(jump[0], 1e-3 - jump[0])
        assert slave.get(OUTPUTS) == pytest.approx(plain.get(OUTPUTS), rel=1e-6, abs=1e-12)
        assert slave.get(["charge"])[0] > 1.5e-6 * 70.0


def test_event_mode_in_co_simulation() -> None:
    with Instance3(loaded(STACK), events=True) as slave, Instance3(loaded(STACK)) as plain:
        slave.set({"voltage": 50.0})
        slave.start()
        assert slave.try_step(0.0, 1e-4).status == ERROR
        assert "'event mode'" in slave.messages[-1]
        assert slave.call("EnterContinuousTimeMode") == ERROR
        assert slave.call("EvaluateDiscreteStates") == OK
        assert slave.update_discrete_states() == [False] * 5
        slave.require("EnterStepMode")
        slave.try_step(0.0, 1e-3)
        slave.require("EnterEventMode")
        slave.set({"voltage": -10.0})
        slave.update_discrete_states()
        slave.require("EnterStepMode")
        slave.try_step(1e-3, 1e-3)
        plain.start({"voltage": 50.0})
        plain.try_step(0.0, 1e-3)
        plain.set({"voltage": -10.0})
        plain.try_step(1e-3, 1e-3)
        assert slave.get(OUTPUTS).tobytes() == plain.get(OUTPUTS).tobytes()


def _play(slave: Instance3, first: int, last: int) -> bytes:
    rows = []
    for k in range(first, last):
        slave.set({"voltage": 40.0 + 40.0 * np.sin(0.7 * k)})
        assert slave.try_step(k * 2e-5, 2e-5).status == OK
        rows.append(slave.get(OUTPUTS))
    return np.array(rows).tobytes()


def test_foreign_truncated_and_corrupted_states_are_refused(slave: Instance3) -> None:
    _play(slave, 0, 5)
    data = slave.serialized()
    assert slave.try_restore(data[:-1]) == ERROR
    assert "no snapshot of this model" in slave.messages[-1]
    assert slave.try_restore(data + b"\0") == ERROR
    for place in (40, len(data) // 2, len(data) - 1):
        broken = bytearray(data)
        broken[place] ^= 1
        assert slave.try_restore(bytes(broken)) == ERROR
        assert "damaged" in slave.messages[-1]
    for place in (0, 8, 16):
        broken = bytearray(data)
        broken[place] ^= 1
        assert slave.try_restore(bytes(broken)) == ERROR
        assert "another model, version or kind of machine" in slave.messages[-1]
    with Instance3(slave.fmu, MODEL_EXCHANGE) as other:
        assert other.try_restore(data) == ERROR
        assert "other interface" in other.messages[-1]
    assert slave.serialized() == data


def test_state_bytes_are_numbers_of_eight_bytes_and_hold_no_pointer(slave: Instance3) -> None:
    """Two instances at different addresses write the same bytes; time stands where it should."""
    _play(slave, 0, 7)
    data = slave.serialized()
    with Instance3(slave.fmu) as other:
        other.start()
        _play(other, 0, 7)
        assert other.serialized() == data
    assert data[:8] == b"psasnap\0"
    assert (len(data) - 32) % 8 == 0
    assert struct.unpack("<I", data[12:16])[0] == len(data) - 32
    assert struct.unpack("<d", data[32:40])[0] == slave.get(["time"])[0]
