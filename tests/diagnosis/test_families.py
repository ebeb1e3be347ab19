"""Place and kind of a cause before its name, and how far it is none of the listed effects."""

from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.diagnosis.corrections import KINDS, CauseEvidence, Patch, families, place_and_kind
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.model.effects import EFFECTS
from psa_casadi.report.words.verdict_words import family_sentence
from tests.studies.plants.make import make_record
from tests.tiers import slow

CREEP, DRIFT = ("plant", "relaxation"), ("sensor", "time")
PLACES = {"slow_creep": CREEP, "charge_leakage": ("drive", "relaxation"), "offset_drift": DRIFT}
#: So few that hardly anything else can look like a cause with the evidence of these tests.
FEW = 1


def _patch(kind: str, port: str, evidence: float) -> Patch:
    none = np.zeros(0)
    return Patch(
        port=port, kind=kind, evidence=evidence, held=(0.0,), predicted=(), weights=none, added=(),
        moved=none,
    )  # fmt: skip


def test_every_effect_and_every_unnamed_correction_has_a_family() -> None:
    assert all(e.kind for e in EFFECTS.values())
    known = {e.kind for e in EFFECTS.values()}
    assert all(place_and_kind(_patch(k.name, k.port, 0.0))[1] in known for k in KINDS)


def test_effects_of_one_place_and_kind_are_one_family() -> None:
    chances = {"slow_creep": 0.6, "charge_leakage": 0.3, "offset_drift": 0.1}
    creep, leak, drift = families(chances, PLACES, CauseEvidence(1e15, FEW), [], LIMITS)
    assert (creep.place, creep.kind) == CREEP
    assert [f.probability for f in (creep, leak, drift)] == pytest.approx([0.6, 0.3, 0.1])
    assert not any(f.not_listed for f in (creep, leak, drift))


def test_a_correction_of_another_kind_takes_its_share_and_one_of_the_same_kind_none() -> None:
    """With 2 % of 1000 nats as the form, 20 nats less are odds of 1/e.

    Less than the best of the cause's kind, that is, whether listed or not.
    """
    same = _patch("relaxation", "force", 1100.0)
    other = _patch("curve", "drive voltage", 1080.0)
    weak = _patch("time", "reading", 5.0)
    displayed = CauseEvidence(1000.0, FEW)
    result = families({"slow_creep": 1.0}, PLACES, displayed, [same, other, weak], LIMITS)
    shares = {(f.place, f.kind): (f.probability, f.not_listed) for f in result}
    odds = float(np.exp(-1.0))
    tried = displayed.listed_probability(LIMITS)
    assert shares[CREEP] == pytest.approx((tried / (1.0 + odds), 0.0), abs=1e-4)
    assert shares["drive", "curve"] == pytest.approx((tried * odds / (1.0 + odds),) * 2, rel=1e-4)
    assert len(shares) == 2


def test_one_of_its_kind_that_explains_much_more_leaves_the_form_open() -> None:
    """It has more freedom: with 1000 nats it is as likely as a listed effect with 700."""
    free = _patch("relaxation", "force", 1000.0)
    (creep,) = families({"slow_creep": 1.0}, PLACES, CauseEvidence(700.0, FEW), [free], LIMITS)
    assert creep.not_listed == pytest.approx(creep.effects["slow_creep"])
    (creep,) = families({"slow_creep": 1.0}, PLACES, CauseEvidence(300.0, FEW), [free], LIMITS)
    assert creep.not_listed > 0.99 * creep.probability


def test_what_has_no_name_is_shared_by_corrections_alone() -> None:
    """Three quarters of the evidence give odds of exp(1/2), much less than exp(100)."""
    rows = [_patch("memory", "force", 400.0), _patch("curve", "reading", 300.0)]
    displayed = CauseEvidence(400.0, FEW)
    first, second = families({}, {}, displayed, rows, LIMITS)
    assert (first.place, first.kind) == ("plant", "hysteresis")
    assert (second.place, second.kind) == ("sensor", "curve")
    assert first.not_listed / second.not_listed == pytest.approx(np.exp(0.5))
    assert first.not_listed + second.not_listed == pytest.approx(
        displayed.listed_probability(LIMITS)
    )


def test_the_smaller_a_cause_the_likelier_it_is_something_that_nobody_has_thought_of() -> None:
    """At four times the evidence of the same samples the odds of that are half; of two, twice."""
    small, large, two = (
        1.0 / CauseEvidence(e, 4000, k).listed_probability(LIMITS) - 1.0
        for e, k in ((100.0, 1), (400.0, 1), (400.0, 2))
    )
    assert small / large == pytest.approx(2.0)
    assert two / large == pytest.approx(2.0)


def test_the_sentence_names_what_no_effect_is_and_what_was_not_tried() -> None:
    chances, weak = {"slow_creep": 1.0}, CauseEvidence(100.0, 4000)
    rival = _patch("curve", "reading", 98.0)
    text = family_sentence(families(chances, PLACES, weak, [rival], LIMITS))
    assert "a relaxation in the stack" in text
    assert "none of the listed effects" in text
    assert text.endswith("or something that was not tried (20 %)")
    assert not family_sentence(())


@slow
def test_a_foreign_effect_has_a_place_and_a_kind_or_no_name(tmp_path: Path) -> None:
    """The gauge changes its range at one displacement: no effect of the table does that alone."""
    make_record("range_switch", 990030, tmp_path / "r.csv", visible=(0.3, 3.0))
    result = psa.diagnose(tmp_path / "r.csv")
    assert all(c.confidence < 0.9 or c.families[0].kind == "curve" for c in result.causes)
    if not result.causes:
        assert result.families[0].place == "sensor"
