"""Models are compiled on free cores before they are asked for."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Event

import pytest

from psa_casadi.component import Component
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import MachineError
from psa_casadi.model.compose import Model, Structure
from psa_casadi.simulation import side_by_side
from psa_casadi.simulation.side_by_side import compiled, compiled_ahead
from tests.stack_models import stack

PATIENCE = 10.0


@pytest.fixture(autouse=True)
def _two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PSA_CASADI_THREADS", "2")


@pytest.fixture
def base() -> Model:
    return stack("P-885.51")


def _with_effects(base: Model, *names: str) -> list[Model]:
    return [base.with_effect(EFFECTS[n]) for n in names]


def _effects_of(structure: Structure) -> tuple[Component, ...]:
    return tuple(c for c in structure.components if c.gain is not None)


def test_models_are_compiled_while_the_block_runs(
    monkeypatch: pytest.MonkeyPatch, base: Model
) -> None:
    done, all_done = [], Event()

    def why_not(structure: Structure, output: str) -> None:
        done.append((*(e.name for e in _effects_of(structure)), output))
        if len(done) == 3:
            all_done.set()

    monkeypatch.setattr(side_by_side, "why_not", why_not)
    models = _with_effects(base, "slow_creep", "sensor_lag")
    with compiled_ahead(models, first=[lambda: done.append(("first",))]):
        assert all_done.wait(PATIENCE)
    shown = "measured_displacement"
    assert done == [("first",), ("slow_creep", shown), ("sensor_lag", shown)]


def test_what_has_not_begun_at_the_end_is_left_out(
    monkeypatch: pytest.MonkeyPatch, base: Model
) -> None:
    begun, over, compiled_models = Event(), Event(), []

    def long() -> None:
        begun.set()
        assert over.wait(PATIENCE)

    monkeypatch.setattr(side_by_side, "why_not", lambda *given: compiled_models.append(given))
    shutdown = ThreadPoolExecutor.shutdown

    def ended(pool: ThreadPoolExecutor, **how: bool) -> None:
        shutdown(pool, **how)
        over.set()

    monkeypatch.setattr(ThreadPoolExecutor, "shutdown", ended)
    with compiled_ahead([base], first=[long]):
        assert begun.wait(PATIENCE)
    assert over.is_set()
    assert not compiled_models


def test_a_failure_ahead_is_left_to_who_needs_the_model(
    monkeypatch: pytest.MonkeyPatch, base: Model
) -> None:
    tried = []

    def why_not(structure: Structure, output: str) -> None:
        tried.append(output)
        raise MachineError("no compiler")

    monkeypatch.setattr(side_by_side, "why_not", why_not)
    compiled([base, *_with_effects(base, "slow_creep")])
    assert len(tried) == 2


def test_models_of_a_screening_are_compiled_at_the_same_time(
    monkeypatch: pytest.MonkeyPatch, base: Model
) -> None:
    both = Barrier(2)
    monkeypatch.setattr(side_by_side, "why_not", lambda *given: both.wait(PATIENCE))
    compiled(_with_effects(base, "slow_creep", "sensor_lag"))
    assert not both.broken
