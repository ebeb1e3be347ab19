"""Records of models that are no stacks: their noise, held inputs, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import psa_casadi as psa
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor, oven

#: Effects that need no search where nothing is missing: their models would only be compiled.
_ALL_BUT_LAGS = (
    "bend", "saturation", "dead_zone", "constant", "loss", "friction", "drag", "curve", "stop",
    "hysteresis", "zero", "drift",
)  # fmt: skip


@pytest.mark.slow
def test_an_input_that_is_held_is_read_so_and_a_staircase_read_as_lines_is_told() -> None:
    held = plants.oven(40)
    few = [n for n in _ALL_BUT_LAGS if n != "zero"]
    d = psa.diagnose(oven(), held, known_start=True, leave_out=few)
    assert d.verdict == "cause_named"
    assert [c.effect for c in d.causes] == ["lag_of_air"]
    assert d.causes[0].parameters["lag_of_air_time"].value == pytest.approx(25.0, abs=0.5)
    assert not any("stands still" in n for n in d.notes)
    other = plants.oven(41)
    heater = np.where(other.time > 600.0, 1.005, 1.0) * other.columns["heater"]
    unlike = replace(other, columns={**other.columns, "heater": heater}, hold="linear", sha256="")
    d = psa.diagnose(oven(), held, holdout=unlike, hold="zero", known_start=True, leave_out=few)
    assert d.verdict == "partly_explained"
    assert not d.remaining.white
    assert "but the held-out ones of" in d.remaining.where
    lines = replace(held, hold="linear")
    output = psa.identify(oven(), lines, known_start=True)
    assert any("'heater' stands still between jumps in oven, and" in w for w in output.warnings)
    again = psa.identify(oven(), lines, known_start=True, hold="zero")
    assert not any("stands still" in w for w in again.warnings)
    assert again.model.values == psa.identify(oven(), held, known_start=True).model.values


@pytest.mark.slow
def test_a_record_without_noise_hides_nothing_and_shows_what_is_hidden() -> None:
    """A simulation errs by its tolerance, which is no cause; what is rounded is no cause either."""
    leave_out = ["hysteresis", "stop", "curve", "delay"]
    clean = plants.motor(2, friction=0.0, noise=0.0)
    rounded = {n: np.round(y, 3) for n, y in clean.columns.items()}
    for columns in (clean.columns, {**rounded, "voltage": clean.columns["voltage"]}):
        d = psa.diagnose(motor(), {"time": clean.time, **columns}, leave_out=leave_out)
        assert d.verdict == "adequate", d
    d = psa.diagnose(motor(), plants.motor(1, noise=0.0), leave_out=leave_out)
    assert d.causes[0].effect == "friction_in_speed"
    assert d.model.values["friction_in_speed_size"] == pytest.approx(0.012 / 3e-5, rel=0.02)


def test_words_and_records_that_cannot_be_meant_are_refused() -> None:
    record = plants.motor(2, friction=0.0)
    with pytest.raises(psa.InputError, match=r"`holdout` are those of 'drive', which is fitted"):
        psa.diagnose(motor(), record, holdout=record)
    with pytest.raises(psa.InputError, match=r"'known_stat' is not among the arguments for your"):
        psa.identify(motor(), record, known_stat=True)  # type: ignore[call-overload]
    with pytest.raises(psa.InputError, match=r"'known_start' is not among the arguments for a st"):
        psa.identify("record.csv", known_start=True)  # type: ignore[call-overload]
    with pytest.raises(psa.InputError, match=r"`leave_out` has 'slow_crep', which is no effect"):
        psa.diagnose("record.csv", leave_out=["slow_crep"])
    with pytest.raises(psa.InputError, match=r"no effect; of the \d+ there are.* are lag"):
        psa.diagnose(motor(), record, leave_out=["lagg"], starts=1)


def test_columns_in_another_unit_are_told() -> None:
    record = plants.motor(2, friction=0.0)
    columns = {"voltage": record.columns["voltage"], "w": 9.55e3 * record.columns["w"]}
    result = psa.identify(motor(), {"time": record.time, **columns}, starts=1)
    assert any("of its own movement: see that its column" in w for w in result.warnings)
    assert "No record has a column 'i'; that output is not compared." in result.warnings


def test_what_an_input_did_in_a_gap_is_not_guessed() -> None:
    whole = plants.motor(2, friction=0.0)
    kept = np.r_[0:1200, 1500:3000]
    columns = {n: values[kept] for n, values in whole.columns.items()}
    record = replace(whole, time=whole.time[kept], columns=columns, sha256="")
    result = psa.identify(motor(), record, starts=1)
    assert [e.record.name for e in result.experiments] == ["drive[0:1200]", "drive[1200:2700]"]
    assert any(
        "no sample for 0.301 s from 1.199 s on, while the voltage" in w for w in result.warnings
    )
    for name, value in {"R": 1.2, "k": 0.05, "J": 3e-5, "b": 2e-5}.items():
        assert abs(result.model.values[name] - value) < 4.0 * result.errors[name]
    held = psa.identify(motor(), replace(record, hold="zero"), starts=1)
    assert len(held.experiments) == 1
