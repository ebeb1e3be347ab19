"""The exam by another author: its records and its marks; golden answers keep what they hold."""

from pathlib import Path
from typing import Any

import pytest

from tests.studies.exam import marks as m
from tests.studies.exam.play import CAUSES
from tests.studies.exam.records import RECORDS
from tests.studies.exam.voltages import VOLTAGES

BY_NAME = {record.name: record for record in RECORDS}


def test_the_exam_shares_no_code_with_what_it_examines() -> None:
    for path in (Path(__file__).parent / "exam").glob("*.py"):
        imported = [
            x for x in path.read_text("utf-8").split("\n") if x.startswith(("from", "import"))
        ]
        assert not any("psa_casadi" in line or "plants" in line for line in imported)


def test_the_records_are_told_apart_and_hide_what_exists() -> None:
    assert len(BY_NAME) == len({record.seed for record in RECORDS}) == 57
    for record in RECORDS:
        assert set(record.hidden) <= set(CAUSES)
        assert record.test.voltage in VOLTAGES
        of_group = {"clean": 0, "one": 1, "two": 2, "foreign": len(record.accepted)}
        assert len(record.accepted) == of_group[record.question.group]
    assert {c for r in RECORDS for c in r.hidden} == set(CAUSES)
    assert {r.test.voltage for r in RECORDS} == set(VOLTAGES)


def _said(verdict: str, *causes: Any) -> m.Answer:
    return m.Answer(verdict, tuple(m.Named(*cause) for cause in causes))


def _left(family: str) -> m.Answer:
    return m.Answer("unexplained", (), family, 0.7)


ADEQUATE, NOTHING = _said("adequate"), _said("unexplained")
MEMORY = ("hysteresis_memory", 0.99, ())
CREEP, HUM, PLAY = ("slow_creep", 0.99, ()), ("mains_hum", 0.6, ()), ("backlash", 0.99, ())


@pytest.mark.parametrize(
    ("name", "answer", "mark"),
    [
        ("c01", ADEQUATE, m.ADEQUATE),
        ("c01", NOTHING, m.ALARM),
        ("c01", _said("cause_named", CREEP), m.WRONG + m.SURELY),
        ("c05", NOTHING, m.HONEST),
        ("c05", _said("cause_named", MEMORY), m.HYSTERESIS_FOUND),
        ("c05", _said("cause_named", MEMORY, HUM), m.WITH_EXTRA),
        ("c05", _said("cause_named", HUM), m.WRONG),
        ("k01", ADEQUATE, m.MISSED),
        ("k01", NOTHING, m.UNEXPLAINED),
        ("k01", _said("cause_named", CREEP), m.ALONE),
        ("k01", _said("cause_named", CREEP, MEMORY), m.WITH_EXTRA),
        ("k01", _said("ambiguous", ("offset_drift", 0.5, ("slow_creep",))), m.IN_SET),
        ("k01", _said("cause_named", PLAY), m.WRONG + m.SURELY),
        ("k21", _said("cause_named", ("modal_series_2", 0.99, ())), m.ALONE),
        ("k31", _said("cause_named", MEMORY, CREEP), m.ALONE),
        ("k31", _said("cause_named", MEMORY), m.ONLY_HYSTERESIS),
        ("t02", _said("cause_named", PLAY, HUM), m.ALONE),
        ("t02", _said("cause_named", PLAY), m.HALF),
        ("t02", _said("cause_named", PLAY, CREEP), m.HALF_WITH_EXTRA),
        ("f02", NOTHING, m.RIGHTLY_UNEXPLAINED),
        ("f02", ADEQUATE, m.MISSED),
        ("f02", _said("cause_named", PLAY), m.WRONG + m.SURELY),
        ("f03", _said("cause_named", ("ageing", 0.9, ())), m.NEAREST),
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
        ("k01", _said("cause_named", CREEP), {"in_set", "alone", "family", "honest"}),
        ("k01", _said("cause_named", CREEP, HUM), set()),
        ("k04", _said("cause_named", (*MEMORY, "plant hysteresis", 0.9)), {"family", "honest"}),
        ("k04", _left("plant hysteresis"), {"family", "honest"}),
        ("k04", _left("sensor curve"), {"honest"}),
        ("k31", _said("cause_named", MEMORY, CREEP), {"in_set", "alone", "family", "honest"}),
        ("t02", _said("cause_named", PLAY), {"honest"}),
        ("t02", m.Answer("x", (m.Named(*PLAY),), "environment time"), {"family", "honest"}),
        ("f02", _said("cause_named", PLAY), set()),
        ("f02", _said("cause_named", (*CREEP, "plant hysteresis", 0.9)), {"family", "honest"}),
        ("f02", ADEQUATE, set()),
    ],
)
def test_scores_of_answers_made_by_hand(name: str, answer: m.Answer, right: set[str]) -> None:
    score = m.score(BY_NAME[name].question, answer, FAMILIES)
    ask = {"in_set", "alone", "family", "honest"}
    assert {what for what in ask if getattr(score, what)} == right & ask


def test_only_clean_records_alarm_and_other_hysteresis_states_nothing() -> None:
    clean = m.score(BY_NAME["c01"].question, _said("cause_named", CREEP), FAMILIES)
    assert clean.alarm
    assert clean.names == ((0.99, False),)
    other = m.score(BY_NAME["c05"].question, _said("cause_named", MEMORY), FAMILIES)
    assert not other.alarm
    assert other.names == ()
    hum = m.Question("clean", (frozenset({"mains_hum"}),), noise="hum")
    assert m.mark(hum, _said("cause_named", HUM)) == m.NEAREST
    assert m.mark(hum, _said("cause_named", CREEP)) == m.WRONG + m.SURELY
