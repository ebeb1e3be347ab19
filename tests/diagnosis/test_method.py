"""The parts of the method that its negative controls leave out, and how controls are counted."""

from collections.abc import Sequence
from dataclasses import fields, replace

import pytest

from psa_casadi.diagnosis.task import STEPS, Method, Thresholds, thresholds, using
from psa_casadi.simulation.side_by_side import VARIABLE, side_by_side
from tests.studies.benchmarks.ablation import (
    ablation_table,
    moved_constants,
    without_steps,
)
from tests.studies.benchmarks.hidden_cases import Case, Found

NAMES = ("slow_creep", "current_limit", "sensor_nonlinearity")


def _found(effect: str, named: tuple[str, ...], kind: str = "known", seed: int = 1) -> Found:
    case = Case(kind, effect, seed)  # type: ignore[arg-type]  # the kinds below are those it knows
    return Found(
        case,
        1.0,
        "cause_named" if named else "unexplained",
        named,
        named,
        (),
        0.9,
        {},
        {},
        1.0,
        1.0,
    )


def test_what_a_step_is_good_for_shows_in_the_ablation() -> None:
    """Without the finite steps all three effects are taken for backlash; nothing else changes."""
    whole = [_found(n, (n,)) for n in NAMES]
    whole.append(replace(_found("dry_friction", (), "foreign", 9), patched=0.75))
    worse = [replace(f, named=("backlash",), within=("backlash",)) for f in whole[:3]]
    asked: list[Method] = []

    def diagnosed(_: Sequence[Case], method: Method) -> list[Found]:
        asked.append(method)
        return [*worse, whole[3]] if "finite steps" in method.without else whole

    table = ablation_table("", without_steps(), whole, diagnosed).table
    rows = {row[0]: row[1:] for row in table.rows}
    assert asked == [Method(frozenset({step})) for step in STEPS]
    right = ("3 of 3", "3 of 3", "0 of 4", "0 of 0", "75 % of 1", "1.0")
    assert rows["the method"] == (*right, "")
    for step in STEPS:
        if step != "finite steps":
            assert rows[f"without {step}"] == (*right, "0 of 4")
    wrong = ("0 of 3", "0 of 3", "3 of 4", "0 of 0", "75 % of 1", "1.0", "3 of 4")
    assert rows["without finite steps"] == wrong


def test_every_constant_is_moved_and_a_diagnosis_uses_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    moved = moved_constants()
    assert {name.split(" = ")[0] for name in moved} == {f.name for f in fields(Thresholds)}
    assert len(fields(Thresholds)) <= 25
    assert moved["price = 16"].thresholds.price == 16.0
    assert thresholds() == Thresholds()
    for threads in ("1", "2"):
        monkeypatch.setenv(VARIABLE, threads)
        with using(Thresholds(price=3.0)):
            assert side_by_side(lambda _: thresholds().price, range(4)) == [3.0] * 4
    assert thresholds().price == 8.0
