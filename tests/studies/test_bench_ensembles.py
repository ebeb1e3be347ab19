"""The benchmark `ensembles`: every way solves the same problem, and equal error is what it says."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from psa_casadi.errors import InputError
from psa_casadi.model.stacks import stack_model
from psa_casadi.simulation import device
from tests.simulation.cuda_host import lend
from tests.studies.benchmarks import ensembles
from tests.studies.benchmarks.ensembles import (
    Case,
    Solve,
    cases,
    drawn,
    loosest,
    measured,
    on_gpu,
    peers,
)
from tests.tiers import slow


@pytest.fixture(autouse=True)
def _no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent() -> None:
        raise InputError("there is none.")

    monkeypatch.setattr(device, "device_module", absent)


def short() -> Case:
    """Return 40 samples of the sine, up and down in 8 ms."""
    case = cases(40)[0]
    return replace(case, voltage=50.0 - 50.0 * np.cos(2.0 * np.pi * np.arange(40) / 39.0))


def told(step: str) -> None:
    """Tell nobody of a step."""


def test_the_loosest_tolerance_is_the_first_that_is_accurate() -> None:
    """The first set errs by 10 times the tolerance over its range, the second by 50 times."""
    truth = np.array([[0.0, 1.0], [0.0, 2.0]])

    def at(tolerance: float) -> Solve:
        return lambda: np.array([[0.0, 1.0 + 10.0 * tolerance], [0.0, 2.0 + 100.0 * tolerance]])

    found = loosest(at, truth)
    assert found.tolerance == pytest.approx(1e-7)
    assert found.error == pytest.approx(5e-6, rel=1e-6)
    never = loosest(lambda _: lambda: np.array([[0.0, 1.0], [0.0, np.nan]]), truth)
    assert not never.accurate
    assert never.error == np.inf


@slow
def test_all_ways_reach_the_error_on_a_short_record(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight sets of 40 samples, scipy and CVODES beside `simulate_many`."""
    monkeypatch.setattr(ensembles, "find_spec", lambda _: None)
    monkeypatch.setattr(ensembles, "_REPEATS", 1)
    ways, absent = peers()
    whole, beside = measured(told, [short()], 8, 40, ways, absent).tables
    assert [row[1:3] for row in whole.table.rows] == [("8", "40")]
    assert [row[1] for row in beside.table.rows] == [ensembles.OURS, *(w.name for w in ways)]
    assert all(float(row[4]) <= 1e-5 for row in beside.table.rows)
    assert beside.table.rows[0][6] == "1.0"
    assert "pip install --group ensembles" in beside.note
    assert whole.note.endswith("No rows of a GPU: there is none.")


def test_a_gpu_has_rows_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve sets, on this processor in the place of a GPU."""
    host = lend(monkeypatch, 10**9)
    model = stack_model("P-885.51")
    tables, missing = on_gpu(told, model, [(short().record, 1e-6)], partial(drawn, model), 12)
    assert not missing
    (row,) = tables[0].table.rows
    assert row[:5] == ("sine of 10 Hz", "12", "40", "1e-06", "0.0e+00")
    assert "this processor" in tables[0].note
    assert host.launches == [1, 128, 1, 128]
