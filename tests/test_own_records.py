"""Records of models that are no stacks: their own noise, held inputs, what is refused."""

import re
from dataclasses import replace

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.any_model.fit import fit_ode
from psa_casadi.any_model.identify import first_levels, with_noise
from psa_casadi.any_model.runs import runs_of
from psa_casadi.records.signals import Signals, stairs
from tests import own_plants as plants
from tests.own_models import cylinder, motor, oven

#: Tests that share compiled models run in one process.
hydraulic = pytest.mark.xdist_group("own cylinder")


def test_every_record_has_the_noise_of_its_own() -> None:
    quiet = plants.motor(2, friction=0.0)
    rng = np.random.default_rng(5)
    louder = {n: 5.0 * e for n, e in (("w", 0.3), ("i", 0.005))}
    columns = {
        n: y + louder.get(n, 0.0) * rng.standard_normal(quiet.n) for n, y in quiet.columns.items()
    }
    loud = Signals(name="loud", time=quiet.time, columns=columns)
    runs = runs_of(motor(), [quiet, loud], judged=False)
    fit = fit_ode(motor(), runs, ["R", "k", "J", "b"], levels=first_levels(runs), evaluations=30)
    told = with_noise(fit, runs)
    for j in (0, 1):
        ratio = told[1].noise[j] / told[0].noise[j]
        assert ratio == pytest.approx(np.sqrt(26.0), rel=0.1)
        assert told[0].noise[j] * told[1].noise[j] == pytest.approx(1.0, rel=1e-9)
    alike = runs_of(motor(), [quiet, plants.motor(3, friction=0.0)], judged=False)
    fit = fit_ode(motor(), alike, ["R", "k", "J", "b"], levels=first_levels(alike), evaluations=30)
    assert all(np.all(r.noise == 1.0) for r in with_noise(fit, alike))


@pytest.mark.slow
@hydraulic
def test_the_dead_zone_of_a_valve_is_found_in_volts_and_nothing_else_is_left() -> None:
    *fitted, last = plants.cylinder(20)
    memories = ["hysteresis", "stop", "curve", "zero", "drift"]  # half of what there is to compile
    d = psa.diagnose(cylinder(), fitted, holdout=[last], leave_out=memories)
    assert d.verdict == "cause_named"
    assert [c.effect for c in d.causes] == ["dead_zone_of_u"]
    level = d.causes[0].parameters["dead_zone_of_u_level"]
    assert level.value == pytest.approx(0.6, abs=0.003)
    assert level.unit == "V"
    true = {"Kq": 4.2e-5, "C": 2.1e-13, "leak": 3e-12, "b": 880.0, "ks": 4.1e4}
    for name, value in true.items():
        assert d.model.values[name] == pytest.approx(value, rel=0.01)
    for e in d.errors:
        noise = 2e-3 * np.ptp(last.columns[e.output])
        assert e.base > 5.0 * noise
        assert e.extended == pytest.approx(noise, rel=0.06)
        assert e.noise == pytest.approx(noise, rel=0.1)
    (moved,) = (line for line in d.moved if line.startswith("Kq = "))
    assert re.fullmatch(
        r"Kq = 4\.\d+e-05 \(4.\d+e-05 to 4.\d+e-05\) m3/\(s\.V\), without .*", moved
    )
    assert f"\n  {moved}\n" in repr(d)


@pytest.mark.slow
@hydraulic
def test_a_held_out_record_with_more_noise_is_no_misfit() -> None:
    *fitted, last = plants.cylinder(20)
    d = psa.diagnose(cylinder(dead_zone=0.6), fitted, holdout=[last], leave_out=_ALL_BUT_LAGS)
    assert d.verdict == "adequate", d
    for e in d.errors:
        assert e.noise == pytest.approx(2e-3 * np.ptp(last.columns[e.output]), rel=0.1)


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
    told = psa.identify(oven(), lines, known_start=True)
    assert any("'heater' stands still between jumps in oven, and" in w for w in told.warnings)
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


def test_an_edge_of_two_samples_and_a_smooth_input_are_no_staircase() -> None:
    t = np.arange(40.0)
    steps = np.repeat([0.0, 1.0, -1.0, 2.0], 10)
    one = Signals(name="a", time=t, columns={"u": steps, "v": np.sin(t), "w": np.minimum(t, 20.0)})
    assert stairs(one, ("u", "v", "w")) == ("u",)
    edges = np.sort(np.concatenate([t, [9.999, 19.999, 29.999]]))
    drawn = np.interp(edges, *_edges(t, steps))
    assert stairs(Signals(name="b", time=edges, columns={"u": drawn}), ("u",)) == ()


def _edges(t: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    before = np.flatnonzero(np.diff(steps))
    times = np.concatenate([t, t[before + 1] - 1e-3])
    order = np.argsort(times)
    return times[order], np.concatenate([steps, steps[before]])[order]


def test_words_and_records_that_cannot_be_meant_are_refused() -> None:
    record = plants.motor(2, friction=0.0)
    with pytest.raises(psa.InputError, match=r"`holdout` are those of 'drive', which is fitted"):
        psa.diagnose(motor(), record, holdout=record)
    with pytest.raises(psa.InputError, match=r"'known_stat' is not among the words for a model of"):
        psa.identify(motor(), record, known_stat=True)  # type: ignore[call-overload]
    with pytest.raises(psa.InputError, match=r"'known_start' is not among the words for a stack"):
        psa.identify("record.csv", known_start=True)  # type: ignore[call-overload]
    with pytest.raises(psa.InputError, match=r"no effect; of the \d+ there are.* are lag"):
        psa.diagnose(motor(), record, leave_out=["lagg"], starts=1)


def test_columns_in_another_unit_are_told() -> None:
    record = plants.motor(2, friction=0.0)
    columns = {"voltage": record.columns["voltage"], "w": 9.55e3 * record.columns["w"]}
    found = psa.identify(motor(), {"time": record.time, **columns}, starts=1)
    assert any("of its own movement: see that its column" in w for w in found.warnings)
    assert "No record has a column 'i'; that output is not compared." in found.warnings
