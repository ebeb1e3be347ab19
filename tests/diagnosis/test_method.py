"""The ablation counts the effect of each step and constant of the method."""

from collections.abc import Sequence
from dataclasses import fields, replace
from importlib import resources

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.notes import Note
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.diagnosis.task import LIMITS, STEPS, Method, Thresholds
from tests.studies.benchmarks.ablation import (
    ablation_table,
    moved_constants,
    without_steps,
)
from tests.studies.benchmarks.hidden_cases import Case, CaseResult

NAMES = ("slow_creep", "current_limit", "sensor_nonlinearity")


def _case_result(
    effect: str, named: tuple[str, ...], kind: str = "known", seed: int = 1
) -> CaseResult:
    case = Case(kind, effect, seed)  # type: ignore[arg-type]  # all kinds below are valid
    verdict: Verdict = "cause_named" if named else "unexplained"
    return CaseResult(case, 1.0, verdict, named, named, (), {}, 1.0)


def test_what_a_step_is_good_for_shows_in_the_ablation() -> None:
    """Without the finite steps all three effects are taken for backlash; nothing else changes."""
    whole = [_case_result(n, (n,)) for n in NAMES]
    whole.append(replace(_case_result("dry_friction", (), "foreign", 9), patched=0.75))
    worse = [replace(f, named=("backlash",), within=("backlash",)) for f in whole[:3]]
    methods: list[Method] = []

    def diagnosed(_: Sequence[Case], method: Method) -> list[CaseResult]:
        methods.append(method)
        return [*worse, whole[3]] if "finite steps" in method.without else whole

    table = ablation_table("", without_steps(), whole, diagnosed).table
    rows = {row[0]: row[1:] for row in table.rows}
    assert methods == [Method(frozenset({step})) for step in STEPS]
    right = ("3 of 3", "3 of 3", "0 of 4", "0 of 0", "75 % of 1", "1.0")
    assert rows["the method"] == (*right, "")
    for step in STEPS:
        if step != "finite steps":
            assert rows[f"without {step}"] == (*right, "0 of 4")
    wrong = ("0 of 3", "0 of 3", "3 of 4", "0 of 0", "75 % of 1", "1.0", "3 of 4")
    assert rows["without finite steps"] == wrong


def test_every_constant_is_moved() -> None:
    moved = moved_constants()
    assert {name.split(" = ")[0] for name in moved} == {f.name for f in fields(Thresholds)}
    assert len(fields(Thresholds)) <= 22
    assert moved["price = 16"].thresholds.price == 16.0


def test_a_diagnosis_decides_by_the_constants_that_are_passed() -> None:
    """With those of every other diagnosis gone: whatever would use them fails."""
    time = np.linspace(0.0, 2.0, 600)
    voltage = 40.0 * (1.0 - np.cos(4 * np.pi * time))
    clean = psa.simulate(psa.stack_model("P-885.51"), time, voltage).displacement
    noise = 2e-3 * np.ptp(clean) * np.random.default_rng(4).standard_normal(time.size)
    drift = 0.05 * np.ptp(clean) * time / time[-1]
    record = psa.Record(name="r", time=time, voltage=voltage, displacement=clean + drift + noise)
    effects = [psa.EFFECTS[n] for n in ("offset_drift", "sensor_nonlinearity", "load_stiffness")]
    item, kept = Method(thresholds=Thresholds()), vars(LIMITS).copy()
    try:
        vars(LIMITS).clear()
        vars(LIMITS).update(dict.fromkeys(kept))
        result = psa.diagnose([record], effects=effects, method=item)
    finally:
        vars(LIMITS).update(kept)
    assert [c.effect for c in result.causes] == ["offset_drift"]
    strict = Method(thresholds=replace(item.thresholds, price=1e6))
    assert not psa.diagnose([record], effects=effects, method=strict).causes


def test_a_spent_budget_ends_the_search_and_states_what_was_left() -> None:
    """The first visit is made; what was done and left is the same on one core and on two."""
    record = psa.read_record(str(resources.files("psa_casadi") / "data" / "demo.csv"))
    items = []
    for count in ("1", "2"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PSA_CASADI_THREADS", count)
            result = diagnose([record], method=Method(budget=1.0))
        assert [c.effect for c in result.causes] == ["slow_creep"]
        items += [n for n in result.remarks if isinstance(n, Note) and n.code == "budget"]
    assert len(items) == 2
    assert items[0].values == items[1].values
    assert {"neighbours", "finalists"} <= {*items[0].values["left"]}
    assert "Not tried: " in str(items[0])
