"""What a search found, and what of it is named."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psa_casadi.diagnosis.corrections import KINDS, Correction
from psa_casadi.diagnosis.held_out import Share
from psa_casadi.diagnosis.judgement import (
    Weighed,
    too_small,
    vague_note,
    verdict_of,
    withdrawn_names,
)
from psa_casadi.diagnosis.screening import probabilities
from psa_casadi.diagnosis.search.hypothesis import View
from psa_casadi.diagnosis.search.steps import Step


def _share(what: str, share: float) -> Share:
    return Share(what, share, (share - 0.03, share + 0.03))


def test_little_is_not_named_beside_much() -> None:
    memory, heating = _share("hysteresis_memory", 0.75), _share("self_heating", 0.022)
    assert too_small([memory, heating]) == (heating,)
    assert too_small([memory, _share("slow_creep", 0.06)]) == ()


def test_the_largest_cause_is_always_named() -> None:
    assert too_small([_share("slow_creep", 0.04)]) == ()
    assert too_small([_share("slow_creep", 0.04), _share("drift", 0.02)])[0].what == "drift"
    assert too_small([_share("slow_creep", 0.04), _share("drift", 0.035)]) == ()  # as good
    assert len(too_small([_share("slow_creep", -0.01), _share("drift", -0.03)])) == 1
    assert too_small([]) == ()


def test_a_probability_is_tempered_by_what_the_whole_model_explains() -> None:
    evidence = {"drive_lag": 222.0, "sensor_delay": 192.0}
    assert probabilities(evidence)["drive_lag"] > 0.999
    # the base has gained 5,700 nats from resonances whose form is approximate too
    told = probabilities(evidence, 5919.0)
    assert told["drive_lag"] == pytest.approx(1.0 / (1.0 + np.exp(-30.0 / (0.004 * 5919.0))))


def _steps(*names: str, alarm: bool = False) -> list[Step]:
    """Steps that name effects, each sure of its cause."""

    def step(name: str | None) -> Step:
        test = SimpleNamespace(alarm=alarm)
        chosen = None if name is None else SimpleNamespace(causes=(SimpleNamespace(name=name),))
        chances = {} if name is None else {name: 1.0}
        view = SimpleNamespace(test=test)
        return Step(cast(View, view), chosen=cast(Any, chosen), probability=chances)

    return [step(name) for name in (*names, None)]


def test_a_cause_without_a_name_is_a_part_that_is_not_explained() -> None:
    both = _steps("hysteresis_memory", "preload_loss")

    def verdict(steps: list[Step], *unnamed: str) -> str:
        return verdict_of(steps, missing=True, withdrawn=False, share=0.9, unnamed=unnamed)

    assert verdict(both) == "cause_named"
    assert verdict(both, "preload_loss") == "partly_explained"
    assert verdict(both, "hysteresis_memory", "preload_loss") == "unexplained"
    assert verdict(_steps("hysteresis_memory", alarm=True)) == "partly_explained"


@pytest.mark.parametrize(("share", "told"), [(0.75, "partly_explained"), (0.65, "unexplained")])
def test_where_structure_remains_names_must_remove_enough(share: float, told: str) -> None:
    open_, closed = _steps("hysteresis_memory", alarm=True), _steps("hysteresis_memory")
    assert verdict_of(open_, missing=True, withdrawn=False, share=share) == told
    assert verdict_of(closed, missing=True, withdrawn=False, share=share) == "cause_named"


def test_what_removes_too_little_for_a_name_stays_in_the_model() -> None:
    for share, words in ((0.4, "in the extended model, where it removes 40 %"),
                         (0.04, "would remove 4 %")):  # fmt: skip
        weighed = Weighed(566.0, 1, share, (), ())
        (said,) = withdrawn_names(_steps("drive_lag"), weighed, None, {}, None)
        assert words in str(said)


def test_notes_say_what_is_not_named_and_why() -> None:
    curve = next(k for k in KINDS if k.name == "curve")
    nothing = np.zeros(1)
    better = Correction(curve, 203.0, 0.0, nothing, (), (), nothing)
    assert vague_note({}) == ()
    (note,) = vague_note({"rate_dependent_hysteresis": better})
    assert "(a bent curve of the drive voltage, instead of rate_dependent_hysteresis)" in str(note)
    weighed = Weighed(566.0, 1, 0.75, (), ())
    (why,) = withdrawn_names(_steps("preload_loss"), weighed, None, {"preload_loss": better}, None)
    assert "75 %" in str(why)
    assert "a bent curve of the drive voltage, instead of preload_loss" in str(why)
