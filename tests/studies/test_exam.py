"""The exam by another author: its hysteresis, its records and its marks."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from psa_casadi.records.read.reading import read_record
from tests.studies.exam import hysteresis as h
from tests.studies.exam import marks as m
from tests.studies.exam.hysteresis import draw_density, preisach
from tests.studies.exam.play import CAUSES, play, write
from tests.studies.exam.record import Floats
from tests.studies.exam.records import RECORDS
from tests.studies.exam.voltages import VOLTAGES

LIMITS, HISTORY = (-100.0, 100.0), (0.0, 100.0, -100.0)
BY_NAME = {record.name: record for record in RECORDS}
Model = Callable[[Floats, float], Floats]


def _draws() -> np.random.Generator:
    return np.random.default_rng(5)


#: Hysteresis by name: of a voltage and the step of time. Relays have the coarsest output.
KINDS: dict[str, Model] = {
    "Bouc-Wen": lambda u, step: h.bouc_wen(u, HISTORY, (-0.32, 0.06, 0.01, 1.0, 0.0), step),
    "Preisach": lambda u, step: preisach(u, HISTORY, draw_density(LIMITS, _draws())),
    "relays": lambda u, step: h.relays(u, HISTORY, LIMITS, _draws()),
    "Prandtl-Ishlinskii": lambda u, step: h.prandtl_ishlinskii(u, HISTORY, 140.0, step),
    "Coleman-Hodgdon": lambda u, step: h.coleman_hodgdon(u, HISTORY, 120.0),
    "Duhem": lambda u, step: h.duhem(u, HISTORY, 120.0),
}
RATED: dict[str, Model] = {
    "Bouc-Wen with delta": lambda u, step: h.bouc_wen(
        u, HISTORY, (-0.32, 0.06, 0.01, 1.0, 0.02), step
    ),
    "growing thresholds": lambda u, step: h.prandtl_ishlinskii(u, HISTORY, 140.0, step, 0.01),
}


def _loops(samples: int) -> Floats:
    """Two periods between the limits."""
    return np.asarray(-100.0 * np.cos(2 * np.pi * np.linspace(0.0, 2.0, 2 * samples + 1)))


@pytest.mark.parametrize("kind", KINDS)
def test_hysteresis_dissipates_in_a_closed_loop(kind: str) -> None:
    """The area of the loop, more than 1 % of its box, is lost in a period; the loop is closed."""
    u = _loops(1000)
    out = KINDS[kind](u, 1e-3)
    last_u, last = u[1000:], out[1000:]
    assert abs(last[-1] - last[0]) < 2e-3 * np.ptp(last)
    work = float(np.sum((last[1:] + last[:-1]) / 2 * np.diff(last_u)))
    assert -0.35 < work / (np.ptp(last_u) * np.ptp(last)) < -0.01


@pytest.mark.parametrize("kind", KINDS)
def test_hysteresis_does_not_depend_on_the_rate(kind: str) -> None:
    """Ten times faster, and with half as many samples at the same voltages: the same loop."""
    fine = KINDS[kind](_loops(1000), 1e-3)
    assert np.array_equal(KINDS[kind](_loops(1000), 1e-4), fine)
    assert np.abs(KINDS[kind](_loops(500), 1e-3) - fine[::2]).max() < 0.01 * np.ptp(fine)


@pytest.mark.parametrize("kind", RATED)
def test_what_should_depend_on_the_rate_does(kind: str) -> None:
    slow, fast = (RATED[kind](_loops(1000), step) for step in (1e-2, 1e-4))
    assert np.abs(slow - fast).max() > 0.005 * np.ptp(slow)


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
        assert len(record.accepted) == of_group[record.group]
    assert {c for r in RECORDS for c in r.hidden} == set(CAUSES)
    assert {r.test.voltage for r in RECORDS} == set(VOLTAGES)


@pytest.mark.parametrize(("name", "colour"), [("c04", 0.0), ("c10", 0.4), ("k12", 0.0)])
def test_a_record_has_the_noise_that_it_states(name: str, colour: float, tmp_path: Path) -> None:
    """A reader of the package finds the samples, the columns and the voltage as they were made."""
    record = BY_NAME[name]
    played = play(record)
    write(record, tmp_path / "r.csv")
    read = read_record(tmp_path / "r.csv")
    assert read.n == record.test.samples
    assert np.allclose(read.voltage, played.voltage, atol=1e-4)
    assert (read.monitor_voltage is not None) == record.test.monitor
    assert read.displacement is not None
    noise = 1e6 * read.displacement - played.clean
    assert np.std(noise) == pytest.approx(0.01 * record.test.noise * np.ptp(played.clean), rel=0.05)
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(colour, abs=0.05)


def _said(verdict: str, *causes: tuple[str, float, tuple[str, ...]]) -> m.Answer:
    return m.Answer(verdict, tuple(m.Named(*cause) for cause in causes))


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
    assert m.mark(BY_NAME[name], answer) == mark
