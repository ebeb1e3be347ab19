"""How large an effect is, against plain NumPy; what now, for every effect and verdict."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.diagnosis.remedy import Size, example, sizes
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.model.effects.mechanics import MODAL_SERIES
from psa_casadi.model.evidence import Covariance, Evidence, SeenRange
from psa_casadi.model.variables import Interval
from psa_casadi.report.words.phrases import handy_scale
from psa_casadi.report.words.remedy_words import DO, RECORDS, size_text, what_now
from psa_casadi.report.words.text import effect_page
from tests.report.html_page import Page
from tests.report.report_cases import ADDED, VERDICTS, diagnosis

#: A stack without hysteresis that moves 100 nm per volt and follows its voltage in microseconds.
VALUES = {"A": 0.0, "delta": 0.0, "k_L": 5.0, "k_P": 1e8, "k_B": 1e8, "R_s": 0.1, "tau": 1e-6}
PER_VOLT = 1e-7
LOW, HIGH, RATE = -10.0, 90.0, 2000.0


def stack(effect: str, covariance: Covariance | None = None, **values: float) -> psa.Model:
    """Return a linear stack with an effect, as if identified from 30 s between -10 and 90 V."""
    model = psa.compose((*psa.BASE, psa.EFFECTS[effect]), {**VALUES, **values})
    observed = SeenRange(Interval(LOW, HIGH), RATE, 30.0)
    return replace(
        model, evidence=Evidence("test", 0.0, observed, covariance or Covariance((), ()))
    )


def of(effect: str, model: psa.Model) -> dict[tuple[str, float], Size]:
    return {(s.test, s.at): s for s in sizes(psa.EFFECTS[effect], model)}


def test_creep_goes_on_by_the_sum_of_its_relaxations() -> None:
    model = stack("slow_creep", creep_gain=0.02, creep_time=0.5)
    result = of("slow_creep", model)
    step = 0.02  # a raised cosine of 20 ms: the mean of it is half of that late
    moved = PER_VOLT * (HIGH - LOW)
    for at in (10.0, 600.0):
        after = [
            np.exp(-step / 2 / tau) - np.exp(-(at + step / 2) / tau) for tau in (0.5, 5.0, 50.0)
        ]
        assert result["hold", at].value == pytest.approx(0.02 * moved * sum(after), rel=1e-3)
    assert [result["hold", at].beyond_records for at in (10.0, 600.0)] == [False, True]


def test_play_sets_the_ways_apart_by_the_gap_and_a_delay_moves_by_rate_times_time() -> None:
    stroke = PER_VOLT * psa.compose(psa.BASE, VALUES).values["u_rated"]
    play = of("backlash", stack("backlash", backlash_gain=1.0, backlash_width=0.01))
    assert play["reversal", HIGH].value == pytest.approx(2 * 0.01 * stroke, rel=5e-3)
    late = of("sensor_delay", stack("sensor_delay", sensor_delay=2e-4))  # Pade overshoots at turns
    assert late["slew", RATE].value == pytest.approx(2e-4 * RATE * PER_VOLT, rel=5e-3)
    late = of("sensor_lag", stack("sensor_lag", sensor_lag_time=2e-4))
    assert late["slew", RATE].value == pytest.approx(2e-4 * RATE * PER_VOLT, rel=1e-3)


def test_a_curve_bends_next_to_zero_and_sensitivity() -> None:
    gain, rated = 0.1, psa.compose(psa.BASE, VALUES).values["u_rated"]
    result = of("field_dependent_gain", stack("field_dependent_gain", field_gain=gain))
    u = np.linspace(LOW, HIGH, 2001)
    added = PER_VOLT * gain * u * np.abs(u) / rated
    bent = added - np.polyval(np.polyfit(u, added, 1), u)
    assert result["range", HIGH].value == pytest.approx(np.max(np.abs(bent)), rel=0.01)
    assert result["top", HIGH].value == pytest.approx(added[-1], rel=1e-3)


def test_a_mode_is_heard_at_its_frequency() -> None:
    frequency, damping, gain = 300.0, 0.02, 0.05
    model = stack("structural_mode", mode_gain=gain, mode_frequency=frequency, mode_damping=damping)
    (first, *_) = sizes(psa.EFFECTS["structural_mode"], model)
    f = np.linspace(250.0, 350.0, 20001) / frequency
    ratio = np.abs(1.0 + gain / (1.0 - f**2 + 2j * damping * f))
    assert first.value == pytest.approx(np.max(ratio), rel=1e-3)
    assert first.at == pytest.approx(frequency * f[np.argmax(ratio)], rel=2e-3)


def test_a_model_without_records_to_play_has_no_size_of_them() -> None:
    model = stack("offset_drift", drift_rate=1e-8)
    assert sizes(psa.EFFECTS["offset_drift"], model) == ()
    t = np.linspace(0.0, 5.0, 501)
    record = psa.Record(name="r", time=t, voltage=10.0 * np.sin(t), displacement=0.0 * t)
    largest, rms = sizes(psa.EFFECTS["offset_drift"], model, [record])
    assert largest.value == pytest.approx(5e-8, rel=1e-3)
    assert rms.value == pytest.approx(np.std(1e-8 * t), rel=1e-3)


def test_a_size_is_as_certain_as_the_parameters_of_the_effect() -> None:
    gain, error = 0.02, 0.001
    known = Covariance(("creep_gain", "k_L"), ((error**2, 0.0), (0.0, 1.0)))
    model = stack("slow_creep", known, creep_gain=gain, creep_time=0.5)
    for size in sizes(psa.EFFECTS["slow_creep"], model):
        low, high = size.interval or (0.0, 0.0)
        share = 1.959964 * error / gain
        assert low == pytest.approx(size.value * (1 - share), rel=1e-3)
        assert high == pytest.approx(size.value * (1 + share), rel=1e-3)


@pytest.mark.parametrize("effect", [*psa.EFFECTS.values(), MODAL_SERIES[2]], ids=lambda e: e.name)
def test_every_effect_has_a_size_and_a_remedy_in_words(effect: psa.Component) -> None:
    assert effect.remedy is not None
    model, result = example(effect)
    assert result
    assert any(s.value for s in result) or effect.linear
    page = " ".join(effect_page(effect, 400, (model, result)).split())
    assert f"on P-885.51 with {effect.gain} = " in page
    assert size_text(result, handy_scale) in page
    assert DO[effect.remedy.code] in page
    assert RECORDS[effect.remedy.test] in page


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_is_followed_by_the_next_step(tmp_path: Path, verdict: Verdict) -> None:
    d = diagnosis(verdict)
    advice = what_now(d, "my models/e.json")
    psa.write_report(d, tmp_path / "r.html", still=True, model_file="my models/e.json")
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    top = " ".join(Page(text[: text.index("<h2")]).text.replace("\u00a0", " ").split())
    assert top.index("What now") < top.index("Remains:")
    for part in (*advice.causes, *advice.remarks, *advice.commands):
        assert part in top
    export = "psa export fmu --model 'my models/e.json' -o 'my models/e.fmu'"
    assert advice.commands[:1] == ((export,) if verdict != "not_driven" else ())
    if verdict in ADDED:
        assert "goes on by 40.0 nm (37.0 to 43.0) in 10 s and 90.0 nm in 10 min" in top
        assert "10 min lies beyond these records" in top
        assert "Against it: wait until it has died out" in top


def test_an_undecided_cause_comes_with_its_rivals_remedy_and_the_design_of_a_record() -> None:
    advice = what_now(diagnosis("ambiguous"))
    (rival,) = [t for t in advice.remarks if "does not decide" in t]
    assert "offset drift: let the sensor warm up" in rival
    assert f"{RECORDS['hold']} and {RECORDS['record']}" in rival
    assert advice.commands[-1].startswith(
        "psa design experiment --model extended.json --record RECORD.csv --separate slow_creep "
    )
    assert "psa.save_model" in advice.remarks[-1]


def test_a_cause_of_the_sensor_stays_out_of_the_exported_plant() -> None:
    d = diagnosis("cause_named")
    cause = replace(d.causes[0], effect="offset_drift", belongs_to="sensor", remedy="zero_again")
    advice = what_now(replace(d, causes=(cause,)), "e.json")
    assert advice.remarks == (
        "An exported plant leaves out offset drift: correct the reading instead.",
    )
    assert len(advice.commands) == 1
