"""What importers get wrong or send with ill will: refused in words, never a crash or a hang."""

import ctypes
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from psa_casadi.components import BASE
from psa_casadi.export.check.calls import parameter_changes
from psa_casadi.export.check.structure import directional_error, incomplete_dependencies
from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.importer.fmu import (
    CO_SIMULATION,
    ERROR,
    MODEL_EXCHANGE,
    OK,
    Fmu,
    FmuError,
    Instance,
)
from psa_casadi.model.compose import compose
from tests.export.fmu_models import exported, model_named
from tests.tiers import slow

STACK = "P-885.51"
VERSIONS = pytest.mark.parametrize("fmi", [2, 3])
#: Bytes in front of the state in a serialised snapshot; the last eight are the checksum.
STAMP = 32
#: A word of eight bytes that is no number, a count without end, a negative index, a huge number.
WORDS = (
    struct.pack("<d", float("nan")), struct.pack("<q", 2**62), struct.pack("<q", -1),
    struct.pack("<d", 1e300),
)  # fmt: skip


@pytest.fixture(params=[2, 3])
def slave(request: pytest.FixtureRequest) -> Iterator[Instance]:
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


def _saved(instance: Instance, moved: str) -> bytes:
    """Return the state after a step, as bytes."""
    instance.set({moved: 5.0})
    instance.step(0.0, 1e-3)
    snapshot = instance.save()
    data = instance.serialize(snapshot)
    instance.drop(snapshot)
    return data


def _use(instance: Instance, moved: str) -> str:
    """Set, step, differentiate and read an instance; return what it says if it refuses."""
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
    said, slowest = set(), 0.0
    with Fmu(path) as fmu, fmu.start(CO_SIMULATION) as instance:
        data = _saved(instance, moved)
        assert _forged(data, 0, data[STAMP : STAMP + 8]) == data
        for word in range((len(data) - STAMP) // 8):
            for content in WORDS:
                begin = time.monotonic()
                try:
                    snapshot = instance.deserialize(_forged(data, word, content))
                except FmuError as refusal:
                    refused[word, content] = refusal.status
                    continue
                instance.restore(snapshot)
                instance.drop(snapshot)
                said.add(_use(instance, moved))
                slowest = max(slowest, time.monotonic() - begin)
        snapshot = instance.deserialize(data)
        instance.restore(snapshot)
        instance.drop(snapshot)
        instance.step(1e-3, 1e-3)
    states = range(3, 3 + len(fmu.states()))
    assert {(w, c) for w in states for c in (WORDS[0], WORDS[3])} <= set(refused)
    assert set(refused.values()) == {ERROR}
    assert all(len(text) > 60 for text in said - {""})
    assert slowest < 5.0


def test_a_forged_parameter_is_named(slave: Instance) -> None:
    kept = 0.0123456789
    slave.set({"m_B": kept})
    data = _saved(slave, "voltage")
    place = data.index(struct.pack("<d", kept), STAMP) - STAMP
    with pytest.raises(FmuError, match="altered: m_B cannot be"):
        slave.deserialize(_forged(data, place // 8, struct.pack("<d", -kept)))


def test_a_snapshot_that_frees_itself(slave: Instance) -> None:
    """Some importers pass the snapshot where its address is asked for; reference FMUs bear it."""
    snapshot = slave.save()
    word = "FMUstate" if slave.fmu.version == 2 else "FMUState"
    assert (
        getattr(slave.fmu.library, f"fmi{slave.fmu.version}Free{word}")(
            slave.fmi.component, ctypes.cast(snapshot, ctypes.POINTER(ctypes.c_void_p))
        )
        == OK
    )
    slave.set({"voltage": 20.0})
    slave.step(0.0, 1e-3)
    slave.restore(snapshot)  # nothing was freed, nothing written
    assert slave.get(["time", "voltage"]) == pytest.approx([0.0, 0.0])
    slave.drop(snapshot)
    assert snapshot.value is None


@VERSIONS
def test_messages_of_fmi_2_are_formats_and_those_of_fmi_3_are_not(fmi: int) -> None:
    """Printed as a format, the message is what was meant: nothing is inserted or looked up."""
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
            said = r"'m_B' cannot be set to -0\.001: it must be at least 1e-09"
            with pytest.raises(FmuError, match=said) as refusal:
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
    model = compose(BASE, {**model_named(STACK).values, **edges})
    with Fmu(export_fmu(model, tmp_path / "edges.fmu", fmi=3)) as fmu:
        assert [fmu.bounds[n] for n in ("n", "m_B")] == [(1.0, 4.0), (1e-9, 1e3)]
        assert not [*parameter_changes(fmu), *incomplete_dependencies(fmu)]
        assert directional_error(fmu) < 1e-4
