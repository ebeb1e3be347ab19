"""The exams by other authors: their records and marks; golden answers and their comparison."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from build_scripts.measured_data import measured_data_directory
from tests.studies.exam import marks as m
from tests.studies.exam.marks import HYSTERESIS
from tests.studies.exam.play import CAUSES
from tests.studies.exam.records import RECORDS
from tests.studies.exam.voltages import VOLTAGES
from tests.studies.golden.__main__ import run
from tests.studies.golden.cases import CASES
from tests.studies.golden.compare import changes, kept, slower, table, totals, twelfth
from tests.studies.second_exam.cases import HALVES, TABLE, play, question, size_um, write
from tests.studies.second_exam.lab import FOREIGN
from tests.studies.second_exam.lab import VOLTAGES as LABORATORY_VOLTAGES
from tests.studies.second_exam.plants import SUB, simulate
from tests.tiers import slow, slow_but

BY_NAME = {record.name: record for record in RECORDS}


def test_the_exam_shares_no_code_with_what_it_examines() -> None:
    for path in (Path(__file__).parent / "exam").glob("*.py"):
        imported = [
            x for x in path.read_text("utf-8").split("\n") if x.startswith(("from", "import"))
        ]
        assert not any("psa_casadi" in line or "plants" in line for line in imported)


def test_the_records_are_distinguished_and_hide_what_exists() -> None:
    assert len(BY_NAME) == len({record.seed for record in RECORDS}) == 57
    for record in RECORDS:
        assert set(record.hidden) <= set(CAUSES)
        assert record.test.voltage in VOLTAGES
        of_group = {"clean": 0, "one": 1, "two": 2, "foreign": len(record.accepted)}
        assert len(record.accepted) == of_group[record.question.group]
    assert {c for r in RECORDS for c in r.hidden} == set(CAUSES)
    assert {r.test.voltage for r in RECORDS} == set(VOLTAGES)


def _answer(verdict: str, *causes: Any) -> m.Answer:
    return m.Answer(verdict, tuple(m.Named(*cause) for cause in causes))


def _left(family: str) -> m.Answer:
    return m.Answer("unexplained", (), family, 0.7)


ADEQUATE, NOTHING = _answer("adequate"), _answer("unexplained")
MEMORY = ("hysteresis_memory", 0.99, ())
CREEP, HUM, PLAY = ("slow_creep", 0.99, ()), ("mains_hum", 0.6, ()), ("backlash", 0.99, ())


@pytest.mark.parametrize(
    ("name", "answer", "mark"),
    [
        ("c01", ADEQUATE, m.ADEQUATE),
        ("c01", NOTHING, m.ALARM),
        ("c01", _answer("cause_named", CREEP), m.WRONG + m.SURELY),
        ("c05", NOTHING, m.HONEST),
        ("c05", _answer("cause_named", MEMORY), m.HYSTERESIS_FOUND),
        ("c05", _answer("cause_named", MEMORY, HUM), m.WITH_EXTRA),
        ("c05", _answer("cause_named", HUM), m.WRONG),
        ("k01", ADEQUATE, m.NOT_DETECTED),
        ("k01", NOTHING, m.UNEXPLAINED),
        ("k01", _answer("cause_named", CREEP), m.ALONE),
        ("k01", _answer("cause_named", CREEP, MEMORY), m.WITH_EXTRA),
        ("k01", _answer("ambiguous", ("offset_drift", 0.5, ("slow_creep",))), m.IN_SET),
        ("k01", _answer("cause_named", PLAY), m.WRONG + m.SURELY),
        ("k21", _answer("cause_named", ("modal_series_2", 0.99, ())), m.ALONE),
        ("k31", _answer("cause_named", MEMORY, CREEP), m.ALONE),
        ("k31", _answer("cause_named", MEMORY), m.ONLY_HYSTERESIS),
        ("t02", _answer("cause_named", PLAY, HUM), m.ALONE),
        ("t02", _answer("cause_named", PLAY), m.HALF),
        ("t02", _answer("cause_named", PLAY, CREEP), m.HALF_WITH_EXTRA),
        ("f02", NOTHING, m.RIGHTLY_UNEXPLAINED),
        ("f02", ADEQUATE, m.NOT_DETECTED),
        ("f02", _answer("cause_named", PLAY), m.WRONG + m.SURELY),
        ("f03", _answer("cause_named", ("ageing", 0.9, ())), m.NEAREST),
    ],
)
def test_marks_of_answers_made_by_hand(name: str, answer: m.Answer, mark: str) -> None:
    assert m.mark(BY_NAME[name].question, answer) == mark


FAMILIES = {
    "slow_creep": "plant relaxation", "backlash": "plant hysteresis",
    "hysteresis_memory": "plant hysteresis", "mains_hum": "environment time",
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "answer", "right"),
    [
        ("k01", _answer("cause_named", CREEP), {"in_set", "alone", "family", "honest"}),
        ("k01", _answer("cause_named", CREEP, HUM), set()),
        ("k04", _answer("cause_named", (*MEMORY, "plant hysteresis", 0.9)), {"family", "honest"}),
        ("k04", _left("plant hysteresis"), {"family", "honest"}),
        ("k04", _left("sensor curve"), {"honest"}),
        ("k31", _answer("cause_named", MEMORY, CREEP), {"in_set", "alone", "family", "honest"}),
        ("t02", _answer("cause_named", PLAY), {"honest"}),
        ("t02", m.Answer("x", (m.Named(*PLAY),), "environment time"), {"family", "honest"}),
        ("f02", _answer("cause_named", PLAY), set()),
        ("f02", _answer("cause_named", (*CREEP, "plant hysteresis", 0.9)), {"family", "honest"}),
        ("f02", ADEQUATE, set()),
    ],
)
def test_scores_of_answers_made_by_hand(name: str, answer: m.Answer, right: set[str]) -> None:
    score = m.score(BY_NAME[name].question, answer, FAMILIES)
    ask = {"in_set", "alone", "family", "honest"}
    assert {what for what in ask if getattr(score, what)} == right & ask


def test_only_clean_records_alarm_and_other_hysteresis_states_nothing() -> None:
    clean = m.score(BY_NAME["c01"].question, _answer("cause_named", CREEP), FAMILIES)
    assert clean.alarm
    assert clean.names == ((0.99, False),)
    other = m.score(BY_NAME["c05"].question, _answer("cause_named", MEMORY), FAMILIES)
    assert not other.alarm
    assert other.names == ()
    hum = m.Question("clean", (frozenset({"mains_hum"}),), noise="hum")
    assert m.mark(hum, _answer("cause_named", HUM)) == m.NEAREST
    assert m.mark(hum, _answer("cause_named", CREEP)) == m.WRONG + m.SURELY


HIDDEN = [name for name in TABLE if question(name).group != "clean"]
CLEAN = [name for name in TABLE if question(name).group == "clean"]


def test_it_shares_no_code_with_what_it_examines() -> None:
    for path in (Path(__file__).parent / "second_exam").glob("*.py"):
        imported = [x for x in path.read_text("utf-8").split("\n") if x.startswith("from")]
        assert not any("psa_casadi" in line or "studies.plants" in line for line in imported)


def test_the_halves_have_the_same_number_of_each_group_and_name_what_exists() -> None:
    groups = [
        [question(name).group for name in TABLE if name[0] == letter] for letter in HALVES.values()
    ]
    assert len(TABLE) == 72
    assert sorted(groups[0]) == sorted(groups[1])
    assert {row["wave"][0] for row in TABLE.values()} == set(LABORATORY_VOLTAGES)
    assert {row["extra"] for row in TABLE.values() if "extra" in row} == set(FOREIGN)
    of_group = {"clean": 0, "one": 1, "two": 2, "three": 3, "foreign": 1}
    for name in TABLE:
        requested = question(name)
        assert len(requested.accepted) in {of_group[requested.group], "hum" in name}


def test_a_seed_makes_a_record_and_another_one_another(tmp_path: Path) -> None:
    def written(seed: int) -> bytes:
        write("t_single_play", seed, tmp_path / "record.csv")
        return (tmp_path / "record.csv").read_bytes()

    assert written(1) == written(1) != written(2)


@pytest.mark.parametrize("name", slow_but(("t_single_quad", "r_foreign_brownout"), HIDDEN))
def test_what_is_hidden_is_larger_than_the_noise(name: str) -> None:
    assert size_um(name, 3) > 5.0 * TABLE[name]["noise_um"]


@pytest.mark.parametrize("name", slow_but(("t_clean_pink_stairs",), CLEAN))
def test_healthy_stacks_are_healthy_and_their_noise_is_as_large_as_stated(name: str) -> None:
    p, statement = play(name, 3), TABLE[name]["noise_um"]
    assert not p.plant.hidden
    assert not question(name).other_hysteresis
    assert size_um(name, 3) < 1e-9
    spread = float(np.std(p.reading - p.clean))
    assert spread == pytest.approx(statement, rel={"outliers": 3.0}.get(name.split("_")[2], 0.35))


def test_hidden_forms_move_the_reading_as_stated() -> None:
    """A gauge's sag by 1.5 %, a missing code of 0.22 um, no strain beyond where a stage ends."""
    sag = play("r_foreign_brownout", 3)
    step = 1 / TABLE["r_foreign_brownout"]["rate"]
    _, well = simulate(sag.plant, sag.voltage, step, np.random.default_rng(0))
    assert set(np.round(sag.clean[1:] / well[SUB::SUB], 9).tolist()) == {0.985, 1.0}
    jump = play("r_single_jump", 3)
    steps = np.abs(np.diff(jump.clean))
    assert np.max(steps) == pytest.approx(0.22, rel=0.3)
    assert np.median(steps) < 0.05
    clip = play("r_single_clip", 3)
    whole = np.quantile(clip.voltage, 0.999) - clip.plant.lo
    assert whole > 0.9 * (clip.plant.hi - clip.plant.lo)
    assert np.ptp(clip.clean) < 0.92 * clip.plant.stroke


def test_other_hysteresis_counts_neither_way_unless_it_is_what_is_hidden() -> None:
    for name in TABLE:
        requested = question(name)
        if requested.other_hysteresis and requested.group != "foreign":
            memory = [names for names in requested.accepted if names & HYSTERESIS]
            assert all("hysteresis_memory" in names for names in memory)


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
    before = {"exam/a": row, "exam/b": row, "measured/c": {**row, "mark": "wrong name"}}
    now = {**before, "exam/b": {**row, "mark": "unexplained", "extended": "8e-08"}}
    assert totals(before, now | {"exam/new": row}) == [
        ("exam, 2 cases", "right", "2", "1"),
        ("measured, 1 cases", "right", "0", "0"),
        ("all, 3 cases", "processor time", "30 s", "30 s"),
        ("all, 3 cases", "held-out error, extended over base", "0.5000", "1.0000"),
    ]
