"""The stages of long work: what each took, and the simulations of all its threads."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.cli.app import app
from psa_casadi.model.compose import Structure
from psa_casadi.records.excitation import time_grid, triangle
from psa_casadi.report.words.tables import timings_table
from psa_casadi.simulation import side_by_side as module
from psa_casadi.simulation.exact import run as exact
from psa_casadi.simulation.side_by_side import (
    VARIABLE,
    compiled,
    one_thread_of_algebra,
    side_by_side,
)
from psa_casadi.simulation.timings import REST, Stage, stage
from tests.any_model.own_models import motor
from tests.model.sampled_models import loop
from tests.model.stack_models import stack


@pytest.fixture(autouse=True)
def _two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PSA_CASADI_THREADS", "2")


@pytest.fixture
def base() -> psa.Model:
    return stack("P-885.51")


def _with_effects(base: psa.Model, *names: str) -> list[psa.Model]:
    return [base.with_effect(psa.EFFECTS[n]) for n in names]


def test_a_failure_ahead_is_left_to_who_needs_the_model(
    monkeypatch: pytest.MonkeyPatch, base: psa.Model
) -> None:
    tried = []

    def why_not(structure: Structure, outputs: tuple[str, ...]) -> None:
        tried.append(outputs)
        raise psa.MachineError("no compiler")

    monkeypatch.setattr(module, "why_not", why_not)
    compiled([base, *_with_effects(base, "slow_creep")])
    assert len(tried) == 2


def test_models_without_a_displacement_are_compiled_for_all_outputs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where exact steps do not fit, the stepper is."""
    compiled_outputs: set[tuple[str, ...]] = set()
    ready: list[psa.Model] = []

    def why_not(structure: Structure, outputs: tuple[str, ...]) -> str | None:
        compiled_outputs.add(outputs)
        return exact.why_not(structure, outputs)

    monkeypatch.setattr(module, "why_not", why_not)
    monkeypatch.setattr(module, "make_ready", ready.append)
    sampled = loop()
    compiled([motor(), sampled])
    assert compiled_outputs == {("w", "i"), sampled.output_names}
    assert ready == [sampled]


def _threads() -> set[int]:
    np.eye(2) @ np.eye(2)  # there is a library to ask
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@one_thread_of_algebra()
def _within() -> set[int]:
    return _threads()


def test_the_number_of_threads_is_restored() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        before = _threads()
        with one_thread_of_algebra():
            assert _threads() == {1}
            assert _within() == {1}
            assert _threads() == {1}
        assert _threads() == before


@pytest.mark.parametrize(("wanted", "alone"), [("1", True), ("2", False), ("many", False)])
def test_work_has_the_threads_that_are_wanted(
    wanted: str, alone: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A value that is no number counts as none: a thread for each core."""
    monkeypatch.setattr("os.cpu_count", lambda: 3)
    monkeypatch.setenv(VARIABLE, wanted)
    results = side_by_side(lambda _: threading.get_ident(), range(3))
    assert (set(results) == {threading.get_ident()}) == alone


MODEL = psa.compose(psa.BASE)


def _simulate(unknowns: list[str]) -> None:
    with stage("in a worker"):
        t = np.linspace(0.0, 1e-3, 5)
        x0 = np.zeros(len(MODEL.state_names))
        psa.run(MODEL, t, np.zeros((5, len(MODEL.input_names))), x0, unknowns=unknowns)


@stage("outer")
def _work() -> None:
    side_by_side(_simulate, [["tau"], ["tau"], []])
    with stage("inner"):
        time.sleep(0.05)
        _simulate([])


def test_stages_count_for_themselves_and_simulations_of_all_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    _work()  # compiled before
    with psa.timed() as spent:
        _simulate([])
        _work()
        _work()
    table = {s.name: s for s in spent.stages}
    assert list(table) == ["in a worker", "outer", "inner", REST]
    assert (table["outer"].runs, table["outer"].differentiated) == (6, 4)
    assert table["in a worker"].runs == 3
    assert table["inner"].wall > 0.09 > table["outer"].wall
    assert table["inner"].processor < 0.09


def test_a_stage_ends_with_an_error() -> None:
    with psa.timed() as spent:
        with pytest.raises(ZeroDivisionError), stage("failing"):
            _ = 1 / 0
        with stage("next"):
            time.sleep(0.01)
    assert [s.name for s in spent.stages] == ["failing", "next", REST]
    assert spent.stages[1].wall > 0.009 > spent.stages[0].wall


def test_the_table_adds_up() -> None:
    stages = (Stage("fits", 2.0, 3.0, 10, 8), Stage(REST, 1.0, 1.0))
    assert timings_table(stages).rows == (
        ("fits", "2.00 s", "3.00 s", "75 %", "10", "8"),
        (REST, "1.00 s", "1.00 s", "25 %", "", ""),
        ("total", "3.00 s", "4.00 s", "100 %", "10", "8"),
    )


def test_a_diagnosis_reports_its_stages(tmp_path: Path) -> None:
    grid = time_grid(1.0, 4e-3)
    voltage = triangle(grid, 0.0, 100.0, 4.0)
    noise = 1e-8 * np.random.default_rng(5).standard_normal(grid.size)
    moved = psa.simulate(MODEL, grid, voltage).displacement + noise
    path = tmp_path / "a.csv"
    psa.write_record(path, {"time [s]": grid, "voltage [V]": voltage, "displacement [m]": moved})
    result = CliRunner().invoke(app, ["diagnose", str(path), "--timings"])
    assert result.exit_code == 0, result.output
    table = result.stdout[result.stdout.index("stage ") :].splitlines()
    names = [line.split("  ")[0] for line in table]
    assert {"loading", "reading", "base fit", "screening", "judging", "writing"} <= set(names)
    assert int(next(line for line in table if line.startswith("base fit ")).split()[-2]) > 10
    assert table[-1].startswith("processor time with the start of Python:")
