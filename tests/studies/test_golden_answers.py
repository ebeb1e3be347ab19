"""A twelfth of the golden answers, the quick ones: `tests.studies.golden` has them all."""

import math

import pytest

from build_scripts.measured_data import measured_data_directory
from tests.studies.golden.__main__ import run
from tests.studies.golden.cases import CASES
from tests.studies.golden.compare import changes, kept, slower, table, totals, twelfth
from tests.tiers import slow


def test_every_case_has_one_kept_answer_and_no_answer_lacks_its_case() -> None:
    assert set(kept()) == set(CASES)


@slow
def test_a_twelfth_of_the_golden_answers_is_as_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    data, before = measured_data_directory(), kept()
    ids = twelfth([i for i in CASES if data.is_dir() or not i.startswith("measured/")], before)
    assert len(ids) >= math.ceil(len(CASES) / 12)
    monkeypatch.setenv("PSA_CASADI_DATA", str(data))
    assert table(before, run(ids, 2), times=False) == []


def test_what_rounding_moves_is_no_change_and_a_name_or_an_error_is_one() -> None:
    row = {
        "verdict": "cause_named", "causes": "slow_creep 0.970 (or drive_lag)", "removed": "0.9500",
        "base": "2e-08 1.5", "extended": "1e-08 0.2", "seconds": "10.0",
    }  # fmt: skip
    near = {
        "causes": "slow_creep 0.955 (or drive_lag)",
        "removed": "0.9550",
        "base": "2.01e-08 1.5",
    }
    assert changes(row, {**row, **near, "seconds": "11.0"}) == []
    for name, value in {
        "verdict": "ambiguous",
        "causes": "slow_creep 0.970 (or sensor_lag)",
        "removed": "0.9300",
        "base": "2e-08 1.6",
        "extended": "1.02e-08 0.2",
    }.items():
        assert changes(row, {**row, name: value}) == [(name, row[name], value)]
    for causes in ("slow_creep 0.940 (or drive_lag)", "slow_creep 0.970", "-"):
        assert changes(row, {**row, "causes": causes}) == [("causes", row["causes"], causes)]
    assert slower(row, {**row, "seconds": "11.0"}) is None
    assert slower(row, {**row, "seconds": "14.0"}) == ("time x1.40", "10.0 s", "14.0 s")
    failed = {"failed": "ValueError: no", "seconds": "0"}
    assert ("x", "failed", "none", "ValueError: no") in table({"x": row}, {"x": failed})


def test_totals_count_right_names_and_compare_errors_of_the_same_cases() -> None:
    row = {"mark": "right alone", "base": "2e-08", "extended": "1e-08", "seconds": "10.0"}
    before = {"exam/a": row, "exam/b": row, "own/c": {**row, "mark": "wrong name"}}
    now = {**before, "exam/b": {**row, "mark": "unexplained", "extended": "8e-08"}}
    assert totals(before, now | {"exam/new": row}) == [
        ("exam, 2 cases", "right", "2", "1"),
        ("own, 1 cases", "right", "0", "0"),
        ("all, 3 cases", "processor time", "30 s", "30 s"),
        ("all, 3 cases", "held-out error, extended over base", "0.5000", "1.0000"),
    ]
