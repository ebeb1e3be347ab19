"""Messages and behaviour of an FMU where calls fail, look wrong, or are sent with ill will.

Refused in words, never a crash or a hang; and what FMI 3.0 has beyond FMI 2.0: event mode,
intermediate updates, early return.
"""

import ctypes
import re
import struct
import time
from collections.abc import Iterator
from ctypes import c_bool, c_double, c_int32, c_size_t
from pathlib import Path

import numpy as np
import pytest
from fmpy.fmi3 import FMU3ScheduledExecution

import psa_casadi as psa
from psa_casadi.export.check.calls import parameter_changes
from psa_casadi.export.check.structure import directional_error, incomplete_dependencies
from psa_casadi.export.importer.fmu import (
    CO_SIMULATION,
    DISCARD,
    ERROR,
    MODEL_EXCHANGE,
    OK,
    Fmu,
    FmuError,
    Instance,
)
from tests.export.c_host.build import HERE
from tests.export.fmi3_instances import Instance3, Update, loaded, restore, saved, try_step
from tests.export.fmu_models import exported, model_named, recompiled
from tests.tiers import slow

STACK = "P-885.51"


@pytest.fixture
def older() -> Iterator[Instance]:
    with Fmu(exported(STACK)) as fmu, fmu.start(CO_SIMULATION) as instance:
        yield instance


def test_refusal_names_call_and_state(older: Instance) -> None:
    older.step(0.0, 1e-3)
    assert older.call("EnterInitializationMode") == ERROR
    assert "fmi2EnterInitializationMode" in older.messages[-1]
    assert "'step complete'" in older.messages[-1]
    assert "t = 0.001 s" in older.messages[-1]


@pytest.mark.parametrize("fmi", [2, 3])
def test_failed_step_names_state_and_time_and_can_be_undone(fmi: int) -> None:
    with Fmu(exported(STACK, fmi)) as fmu, fmu.start(CO_SIMULATION) as slave:
        slave.set({"voltage": 50.0})
        slave.step(0.0, 1e-3)
        snapshot, reached = slave.fmi.getFMUState(), ctypes.c_double()
        slave.set({"voltage": 1e300})
        if fmi == 2:
            assert slave.call("DoStep", 1e-3, 1e-3, 1) == DISCARD
            assert slave.call("GetRealStatus", 2, ctypes.byref(reached)) == OK
        else:
            done = try_step(slave, 1e-3, 1e-3)
            assert done.status == DISCARD
            reached.value = done.time
        match = re.fullmatch(r".* stopped at (\S+) s in state '(\w+)': \S.*", slave.messages[-1])
        assert match is not None
        assert match[2] in fmu.states()
        assert 1e-3 <= reached.value < 2e-3
        assert float(match[1]) == pytest.approx(reached.value, rel=1e-8)
        with pytest.raises(FmuError) as refused:
            slave.step(reached.value, 1e-3)
        assert refused.value.status == ERROR
        slave.fmi.setFMUState(snapshot)
        slave.fmi.freeFMUState(snapshot)
        assert snapshot.value is None
        slave.set({"voltage": 60.0})
        slave.step(1e-3, 1e-3)
        assert 0.0 < slave.get(["displacement"])[0] < 20e-6


@pytest.mark.parametrize(
    ("name", "value"),
    [("load_force", 1e18), ("load_force", -1e24), ("voltage", 1e13), ("voltage", 1e15)],
)
def test_an_absurd_input_ends_the_step_soon(name: str, value: float, older: Instance) -> None:
    older.set({name: value})
    started = time.process_time()
    assert older.call("DoStep", 0.0, 1e-3, 1) == DISCARD
    assert time.process_time() - started < 0.5
    assert "an input or a parameter is far from its physical range" in older.messages[-1]


def test_values_are_set_all_or_none(older: Instance) -> None:
    with pytest.raises(FmuError, match="'current' is calculated and cannot be set"):
        older.set({"voltage": 10.0, "current": 1.0})
    assert older.get(["voltage"])[0] == 0.0


def test_stop_time_is_kept() -> None:
    with Fmu(exported(STACK)) as fmu, fmu.start(CO_SIMULATION, stop_time=2e-3) as slave:
        slave.step(0.0, 2e-3)
        with pytest.raises(FmuError, match="beyond the stop time"):
            slave.step(2e-3, 1e-3)


_COUNTING = (HERE / "counting.c").read_text("utf-8")


def test_a_step_writes_no_sentence_that_nobody_reads(tmp_path: Path) -> None:
    """To write one takes a good part of a microsecond, more than a short step's share."""
    edits = ((" vsnprintf(", " counted("), ("#include", f"{_COUNTING}#include"))
    changed = recompiled(tmp_path / "c.fmu", 2, {"log.c": edits})
    with Fmu(changed) as fmu, fmu.start(CO_SIMULATION) as slave:
        count = ctypes.c_int.in_dll(fmu.library, "psa_sentences")
        slave.step(0.0, 1e-3)
        assert count.value == 0
        assert slave.call("SetDebugLogging", True, 0, None) == OK
        slave.step(1e-3, 1e-3)
        assert count.value == 1
        assert "solver steps" in slave.messages[-1]


def test_rate_is_forgotten_after_its_step(older: Instance) -> None:
    older.set_rates({"voltage": 1e4})
    older.step(0.0, 1e-3)
    assert older.get(["voltage"])[0] == pytest.approx(10.0)
    older.step(1e-3, 1e-3)
    assert older.get(["voltage"])[0] == pytest.approx(10.0)


OUTPUTS = ["displacement", "velocity", "current", "charge"]


@pytest.fixture
def slave() -> Iterator[Instance3]:
    with Instance3(loaded(STACK)) as instance:
        yield instance.start()


@pytest.mark.parametrize("interface", [CO_SIMULATION, MODEL_EXCHANGE])
@pytest.mark.parametrize(
    ("changed", "value", "match"),
    [("guid", "{0}", "token"), ("instanceName", "", "name is missing")],
)
def test_wrong_token_and_missing_name_give_no_instance(
    interface: int, changed: str, value: str, match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for fmi in (2, 3):
        with Fmu(exported(STACK, fmi)) as fmu:
            monkeypatch.setattr(fmu.loaded(interface), changed, value)
            with pytest.raises(FmuError, match=match):
                fmu.open(interface)


def test_what_the_model_does_not_have_gives_no_instance() -> None:
    with pytest.raises(FmuError, match="no instance"):
        loaded(STACK).open(CO_SIMULATION, requiredIntermediateVariables=[10**6])
    fmu, logged = loaded(STACK), list[bytes]()
    other = FMU3ScheduledExecution(
        guid=fmu.token, modelIdentifier=fmu.identifier, unzipDirectory=str(fmu.directory)
    )
    with pytest.raises(Exception, match="Failed to instantiate"):
        other.instantiate(logMessage=lambda *output: logged.append(output[-1]))
    assert b"no scheduled execution" in logged[-1]


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
    updates: list[tuple[Update, float]] = []

    def watcher(instance: Instance3, update: Update) -> None:
        updates.append((update, float(instance.get(["displacement"])[0])))
        assert instance.get(["time"])[0] == update.time
        assert np.isfinite(instance.output_rates(["displacement"])).all()
        assert instance.call("Reset") == ERROR

    with Instance3(loaded(STACK), watcher=watcher) as watched:
        watched.start()
        for instance in (slave, watched):
            instance.set({"voltage": 50.0})
            assert instance.try_step(0.0, 1e-3).status == OK
        times = [u.time for u, _ in updates]
        assert len(times) > 5
        assert np.all(np.diff(times) > 0.0)
        assert times[-1] == pytest.approx(1e-3)
        assert all(u.get_allowed and u.step_finished for u, _ in updates)
        assert [u.can_return_early for u, _ in updates] == [True] * (len(updates) - 1) + [False]
        assert [u.set_requested for u, _ in updates] == [True] * (len(updates) - 1) + [False]
        path = [d for _, d in updates]
        assert 0.0 < path[0] < path[-1]
        assert slave.get(OUTPUTS).tobytes() == watched.get(OUTPUTS).tobytes()
        assert saved(slave) == saved(watched)


@pytest.mark.parametrize("late", [0.0, 1e-4])
def test_early_return_is_honoured_where_it_was_allowed(late: float) -> None:
    numbers: list[float] = []

    def watcher(_: Instance3, update: Update) -> float | None:
        if update.time > 3e-4 and not numbers:
            numbers.append(update.time + late)
            return numbers[0]
        return None

    with Instance3(loaded(STACK), watcher=watcher) as slave, Instance3(loaded(STACK)) as plain:
        for instance in (slave, plain):
            instance.start({"voltage": 50.0})
        done = slave.try_step(0.0, 1e-3)
        assert (done.status, done.early) == (OK, True)
        assert done.time == numbers.pop()
        numbers.append(done.time)
        slave.step(done.time, 1e-3 - done.time)
        plain.step(0.0, 1e-3)
        both = [instance.get(["time", "displacement", "charge"]) for instance in (slave, plain)]
        assert both[0] == pytest.approx(both[1], rel=1e-5)
    numbers.clear()
    with Instance3(loaded(STACK), early=False, watcher=watcher) as slave:
        slave.start({"voltage": 50.0})
        done = slave.try_step(0.0, 1e-3)
        assert (done.status, done.early) == (OK, False)
        assert done.time == pytest.approx(1e-3)
        assert numbers


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


def test_states_are_numbers_without_pointers_and_others_are_refused(slave: Instance3) -> None:
    """Two instances at different addresses write the same bytes; time is at its place."""
    _play(slave, 0, 7)
    data = saved(slave)
    with Instance3(slave.fmu) as other:
        other.start()
        _play(other, 0, 7)
        assert saved(other) == data
    assert data[:8] == b"psasnap\0"
    assert (len(data) - 32) % 8 == 0
    assert struct.unpack("<I", data[12:16])[0] == len(data) - 32
    assert struct.unpack("<d", data[32:40])[0] == slave.get(["time"])[0]
    foreign, damaged = "another model, version or kind of machine", "damaged"
    flips = {0: foreign, 8: foreign, 16: foreign, 40: damaged, len(data) - 1: damaged}
    broken = [
        (data[:k] + bytes([data[k] ^ 1]) + data[k + 1 :], reason) for k, reason in flips.items()
    ]
    broken += [(other, "no snapshot of this model") for other in (data[:-1], data + b"\0")]
    for wrong, reason in broken:
        with pytest.raises(FmuError, match=reason) as refusal:
            restore(slave, wrong)
        assert refusal.value.status == ERROR
    exchange = Instance3(slave.fmu, MODEL_EXCHANGE)
    with exchange, pytest.raises(FmuError, match="other interface"):
        restore(exchange, data)
    assert saved(slave) == data


VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
#: Bytes in front of the state in a serialised snapshot; the last eight are the checksum.
STAMP = 32
#: A word of eight bytes that is no number, a count without end, a negative index, a huge number.
WORDS = (
    struct.pack("<d", float("nan")), struct.pack("<q", 2**62), struct.pack("<q", -1),
    struct.pack("<d", 1e300),
)  # fmt: skip


@pytest.fixture(params=[2, 3])
def either(request: pytest.FixtureRequest) -> Iterator[Instance]:
    with Fmu(exported(STACK, request.param)) as fmu, fmu.start(CO_SIMULATION) as instance:
        yield instance


def _forged(data: bytes, word: int, content: bytes) -> bytes:
    """Replace a word of the state, and make the checksum right: FNV-1a of 64 bits."""
    state = bytearray(data[STAMP:])
    state[8 * word : 8 * word + 8] = content
    checksum = 14695981039346656037
    for byte in state:
        checksum = (checksum ^ byte) * 1099511628211 % 2**64
    return data[: STAMP - 8] + struct.pack("<Q", checksum) + bytes(state)


def _use(instance: Instance, moved: str) -> str:
    """Set, step, differentiate and read an instance; return its message if it refuses."""
    state = instance.fmu.states()[0]
    try:
        now = float(instance.get(["time"])[0])
        instance.set({moved: 6.0})
        instance.step(now, 1e-4)
        instance.directional([state], [moved], [1.0])
        instance.get(instance.fmu.names("output"))
    except FmuError as refusal:
        return str(refusal)
    return ""


@pytest.mark.parametrize("model", ["stack", "sampled"])
def test_forged_snapshots_do_no_harm(model: str) -> None:
    """Every word of a state replaced, with a checksum that is right."""
    path = exported(STACK) if model == "stack" else exported("loop", 3)
    moved = "voltage" if model == "stack" else "reference"
    refused: dict[tuple[int, bytes], int] = {}
    refusals, slowest = set(), 0.0
    with Fmu(path) as fmu, fmu.start(CO_SIMULATION) as instance:
        instance.set({moved: 5.0})
        instance.step(0.0, 1e-3)
        data = saved(instance)
        assert _forged(data, 0, data[STAMP : STAMP + 8]) == data
        for word in range((len(data) - STAMP) // 8):
            for content in WORDS:
                begin = time.monotonic()
                try:
                    restore(instance, _forged(data, word, content))
                except FmuError as refusal:
                    refused[word, content] = refusal.status
                    continue
                refusals.add(_use(instance, moved))
                slowest = max(slowest, time.monotonic() - begin)
        restore(instance, data)
        instance.step(1e-3, 1e-3)
    states = range(3, 3 + len(fmu.states()))
    assert {(w, c) for w in states for c in (WORDS[0], WORDS[3])} <= set(refused)
    assert set(refused.values()) == {ERROR}
    assert all(len(text) > 60 for text in refusals - {""})
    assert slowest < 5.0


def test_a_forged_parameter_is_named(either: Instance) -> None:
    kept = 0.0123456789
    either.set({"m_B": kept})
    data = saved(either)
    place = data.index(struct.pack("<d", kept), STAMP) - STAMP
    with pytest.raises(FmuError, match="altered: m_B cannot be"):
        either.fmi.deserializeFMUState(_forged(data, place // 8, struct.pack("<d", -kept)))


def test_a_snapshot_that_frees_itself(either: Instance) -> None:
    """Some importers pass the snapshot in the place of its address; reference FMUs bear it."""
    snapshot = either.fmi.getFMUState()
    word = "FMUstate" if either.fmu.version == 2 else "FMUState"
    free = getattr(either.fmu.library, f"fmi{either.fmu.version}Free{word}")
    place = ctypes.cast(snapshot, ctypes.POINTER(ctypes.c_void_p))
    assert free(either.fmi.component, place) == OK
    either.set({"voltage": 20.0})
    either.step(0.0, 1e-3)
    either.fmi.setFMUState(snapshot)  # nothing was freed, nothing written
    assert either.get(["time", "voltage"]) == pytest.approx([0.0, 0.0])
    either.fmi.freeFMUState(snapshot)
    assert snapshot.value is None


@VERSIONS
def test_messages_of_fmi_2_are_formats_and_those_of_fmi_3_are_not(fmi: int) -> None:
    """Printed as a format, the message is unchanged: nothing is inserted or looked up."""
    with Fmu(exported(STACK, fmi)) as fmu, fmu.start(CO_SIMULATION) as slave:
        names = (ctypes.c_char_p * 1)(b"%s%s%n #r1# 100 %")
        assert slave.call("SetDebugLogging", 1, 1, names) == ERROR
        wanted, message = "There is no log category '%s%s%n #r1# 100 %'.", slave.messages[-1]
        if fmi == 3:
            assert message == wanted
            return
        assert message % () == wanted.replace("#", "##")
        longest = (ctypes.c_char_p * 1)(b"%" * 2000)
        assert slave.call("SetDebugLogging", 1, 1, longest) == ERROR
        assert set((slave.messages[-1] % ())[30:]) == {"%"}


@pytest.mark.parametrize("interface", [CO_SIMULATION, MODEL_EXCHANGE])
@VERSIONS
def test_a_parameter_out_of_its_bounds_is_refused(fmi: int, interface: int) -> None:
    """A negative mass kept a step busy for a minute. Before initialization, and after it."""
    with Fmu(exported(STACK, fmi)) as fmu, fmu.open(interface) as instance:
        for initialised in (False, True):
            if initialised:
                instance.setup()
            text = r"'m_B' cannot be set to -0\.001: it must be at least 1e-09"
            with pytest.raises(FmuError, match=text) as refusal:
                instance.set({"tau": 2e-4, "m_B": -0.001})
            assert refusal.value.status == ERROR
            with pytest.raises(FmuError, match=r"'n' cannot be set to 4\.1: it must be at most 4"):
                instance.set({"n": 4.1})
            instance.set({"n": 4.0})
        assert instance.get(["n", "tau"]) == pytest.approx([4.0, 1e-4])
        assert instance.get(["m_B"])[0] > 0.0


@slow
def test_the_check_keeps_the_bounds(tmp_path: Path) -> None:
    """A model whose parameters stand at their bounds passes, whatever the check moves."""
    edges = {"n": 4.0, "G": 1e4, "u_rated": 1e-3, "tau": 1.0}
    model = psa.compose(psa.BASE, {**model_named(STACK).values, **edges})
    with Fmu(psa.export_fmu(model, tmp_path / "edges.fmu", fmi=3)) as fmu:
        assert [fmu.bounds[n] for n in ("n", "m_B")] == [(1.0, 4.0), (1e-9, 1e3)]
        assert not [*parameter_changes(fmu), *incomplete_dependencies(fmu)]
        assert directional_error(fmu) < 1e-4
