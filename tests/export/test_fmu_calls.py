"""What an FMU says and does where calls fail or look wrong, and its derivatives and states."""

import ctypes
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from psa_casadi.export.fmu.platforms import compile_library, host_platform
from psa_casadi.export.importer.fmu import (
    CO_SIMULATION,
    DISCARD,
    ERROR,
    OK,
    Fmu,
    FmuError,
    Instance,
)
from tests.export.fmi3_instances import try_step
from tests.export.fmu_models import entries, exported, rewritten
from tests.tiers import slow_but

STACK = "P-885.51"


@pytest.fixture
def slave() -> Iterator[Instance]:
    with Fmu(exported(STACK)) as fmu, fmu.start(CO_SIMULATION) as instance:
        yield instance


def test_refusal_names_call_and_state(slave: Instance) -> None:
    slave.step(0.0, 1e-3)
    assert slave.call("EnterInitializationMode") == ERROR
    assert "fmi2EnterInitializationMode" in slave.messages[-1]
    assert "'step complete'" in slave.messages[-1]
    assert "t = 0.001 s" in slave.messages[-1]


@pytest.mark.parametrize("fmi", [2, 3])
def test_failed_step_names_state_and_time_and_can_be_undone(fmi: int) -> None:
    with Fmu(exported(STACK, fmi)) as fmu, fmu.start(CO_SIMULATION) as slave:
        slave.set({"voltage": 50.0})
        slave.step(0.0, 1e-3)
        snapshot, reached = slave.save(), ctypes.c_double()
        slave.set({"voltage": 1e300})
        if fmi == 2:
            assert slave.call("DoStep", 1e-3, 1e-3, 1) == DISCARD
            assert slave.call("GetRealStatus", 2, ctypes.byref(reached)) == OK
        else:
            done = try_step(slave, 1e-3, 1e-3)
            assert done.status == DISCARD
            reached.value = done.time
        said = re.fullmatch(r".* stopped at (\S+) s in state '(\w+)': \S.*", slave.messages[-1])
        assert said is not None
        assert said[2] in fmu.states()
        assert 1e-3 <= reached.value < 2e-3
        assert float(said[1]) == pytest.approx(reached.value, rel=1e-8)
        with pytest.raises(FmuError) as refused:
            slave.step(reached.value, 1e-3)
        assert refused.value.status == ERROR
        slave.restore(snapshot)
        slave.drop(snapshot)
        assert snapshot.value is None
        slave.set({"voltage": 60.0})
        slave.step(1e-3, 1e-3)
        assert 0.0 < slave.get(["displacement"])[0] < 20e-6


@pytest.mark.parametrize(
    ("name", "value"),
    [("load_force", 1e18), ("load_force", -1e24), ("voltage", 1e13), ("voltage", 1e15)],
)
def test_an_absurd_input_ends_the_step_soon(name: str, value: float, slave: Instance) -> None:
    slave.set({name: value})
    begun = time.process_time()
    assert slave.call("DoStep", 0.0, 1e-3, 1) == DISCARD
    assert time.process_time() - begun < 0.5
    assert "an input or a parameter is far from its physical range" in slave.messages[-1]


def test_values_are_set_all_or_none(slave: Instance) -> None:
    with pytest.raises(FmuError, match="'current' is calculated and cannot be set"):
        slave.set({"voltage": 10.0, "current": 1.0})
    assert slave.get(["voltage"])[0] == 0.0


def test_stop_time_is_kept() -> None:
    with Fmu(exported(STACK)) as fmu, fmu.start(CO_SIMULATION, stop_time=2e-3) as slave:
        slave.step(0.0, 2e-3)
        with pytest.raises(FmuError, match="beyond the stop time"):
            slave.step(2e-3, 1e-3)


def test_initial_states_are_taken() -> None:
    with Fmu(exported(STACK)) as fmu, fmu.start(CO_SIMULATION, values={"u": 80.0}) as slave:
        assert slave.get(["u", "charge"]) == pytest.approx([80.0, 80.0 * 1.5e-6])
        assert slave.get(["current"])[0] == pytest.approx(-80.0 / 8.0)


_COUNTING = """
#include <stdarg.h>
#include <stdio.h>
__attribute__((visibility("default"))) int psa_sentences = 0;
static int counted(char *text, size_t size, const char *format, va_list arguments) {
    ++psa_sentences;
    return vsnprintf(text, size, format, arguments);
}
"""


@pytest.mark.parametrize("fmi", slow_but([2], [2, 3]))
def test_a_step_writes_no_sentence_that_nobody_reads(fmi: int, tmp_path: Path) -> None:
    """To write one takes a good part of a microsecond, more than a short step's share."""
    inside = {n.removeprefix("sources/"): c for n, c in entries(STACK, fmi).items()}
    texts = {n: c.decode() for n, c in inside.items() if n.endswith((".c", ".h"))}
    texts["log.c"] = _COUNTING + texts["log.c"].replace(" vsnprintf(", " counted(")
    library = compile_library(texts, "psa", host_platform())
    binary = next(n for n in inside if n.startswith("binaries/"))
    changed = rewritten(exported(STACK, fmi), tmp_path / "c.fmu", {binary: lambda _: library})
    with Fmu(changed) as fmu, fmu.start(CO_SIMULATION) as slave:
        count = ctypes.c_int.in_dll(fmu.library, "psa_sentences")
        slave.step(0.0, 1e-3)
        assert count.value == 0
        assert slave.call("SetDebugLogging", True, 0, None) == OK
        slave.step(1e-3, 1e-3)
        assert count.value == 1
        assert "solver steps" in slave.messages[-1]


def test_rate_is_forgotten_after_its_step(slave: Instance) -> None:
    slave.set_rates({"voltage": 1e4})
    slave.step(0.0, 1e-3)
    assert slave.get(["voltage"])[0] == pytest.approx(10.0)
    slave.step(1e-3, 1e-3)
    assert slave.get(["voltage"])[0] == pytest.approx(10.0)
