"""Records whose displacement does not follow the voltage, with another sign or unit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import psa_casadi as psa
from psa_casadi.cli.diagnosis_files import cases, write_patch
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.diagnose import filtered
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.records.split import split
from psa_casadi.report.words.verdict_words import verdict_sentence
from tests.contract.helpers import done
from tests.report.report_cases import diagnosis
from tests.tiers import slow, slow_but

TIME: FloatArray = np.arange(2000, dtype=float) * 1e-3
VOLTAGE = 50.0 - 50.0 * np.cos(2 * np.pi * TIME)
TABLE = [psa.EFFECTS["slow_creep"], psa.EFFECTS["offset_drift"]]


@pytest.fixture(scope="module")
def displacement() -> FloatArray:
    """What a stack does, with a little noise."""
    result = psa.simulate(psa.stack_model("P-885.51"), TIME, VOLTAGE).displacement
    return result + 5e-9 * np.random.default_rng(2).standard_normal(TIME.size)


def _diagnosed(y: FloatArray, voltage: FloatArray = VOLTAGE) -> psa.StackDiagnosis:
    record = psa.Record(name="r", time=TIME, voltage=voltage, displacement=y)
    return psa.diagnose([record], effects=TABLE)


@pytest.mark.parametrize("kind", slow_but(["noise"], ["noise", "drift", "another device"]))
def test_a_displacement_without_the_voltage_is_not_diagnosed(kind: str) -> None:
    rng = np.random.default_rng(1)
    y: FloatArray = {
        "noise": 1e-7 * rng.standard_normal(TIME.size),
        "drift": 1e-6 * TIME + 1e-8 * rng.standard_normal(TIME.size),
        "another device": 1e-6 * np.sin(2 * np.pi * 3.7 * TIME),
    }[kind]
    result = _diagnosed(y)
    assert result.verdict == "not_driven"
    assert not result.causes
    assert "same device" in result.notes[-1]
    assert "does not follow the voltage" in psa.story(result)


def test_a_flipped_sign_is_reported_with_figures(displacement: FloatArray) -> None:
    result = _diagnosed(-displacement)
    assert result.verdict == "not_driven"
    assert (
        "the sign of the displacement flipped the base model explains 100.00 %" in result.notes[-1]
    )
    assert "falls while the voltage rises" in verdict_sentence(result)


@pytest.mark.parametrize("factor", slow_but([1e3], [1e-6, 1e3]))
def test_another_unit_of_displacement_is_reported(factor: float, displacement: FloatArray) -> None:
    result = _diagnosed(factor * displacement)
    assert result.verdict == "adequate"
    assert "its unit, or that of the voltage, is probably another" in result.notes[-1]
    assert "its unit, or that of the voltage" in cases(result, ("adequate",), None)[0].failure


def _modes() -> psa.Record:
    """Five light modes of either sign behind a delay, sampled too slowly for a stack's modes."""
    time: FloatArray = np.arange(2000) / 500.0
    voltage = 50.0 + 20.0 * np.sin(2 * np.pi * (2.0 * time + 18.5 * time**2))
    y = np.zeros(time.size)
    for frequency, size in ((9.0, 1.0), (24.0, -1.0), (43.0, 1.0), (70.0, -1.0), (110.0, 1.0)):
        pole = np.exp(2 * np.pi * frequency / 500.0 * (-0.03 + 1j))
        late = np.concatenate([np.zeros(5), voltage[:-5] - 50.0])
        y += lfilter([size * (1.0 - abs(pole))], [1.0, -2 * pole.real, abs(pole) ** 2], late)
    y *= 1e-5 / np.std(y)
    y += 1e-7 * np.random.default_rng(3).standard_normal(time.size)
    return psa.Record(name="r", time=time, voltage=voltage, displacement=y)


def test_a_linear_filter_of_the_voltage_is_distinguished_from_what_is_unrelated() -> None:
    modes = _modes()
    noise = np.random.default_rng(4).standard_normal(modes.n)
    shares = [filtered([split(r)]) for r in (modes, replace(modes, displacement=noise))]
    assert shares[0] > LIMITS.follows
    assert abs(shares[1]) < 0.1


@slow
def test_modes_that_no_base_has_are_not_taken_for_another_device() -> None:
    result = psa.diagnose([_modes()], effects=TABLE)
    assert result.verdict == "unexplained"
    assert any("A linear filter of the voltage explains" in n for n in result.notes)
    assert not any("of the same device" in n for n in result.notes)


def test_what_no_fit_can_start_from_is_refused_in_words(displacement: FloatArray) -> None:
    rest = np.ones(TIME.size)
    with pytest.raises(psa.InputError, match="m, more than a stack with any sensor: its unit"):
        _diagnosed(1e6 * displacement)
    with pytest.raises(psa.InputError, match="The voltage is 40 V throughout"):
        _diagnosed(displacement, 40.0 * rest)
    with pytest.raises(psa.InputError, match="The displacement is 1e-06 m throughout: the sensor"):
        _diagnosed(1e-6 * rest)
    with pytest.raises(psa.InputError, match="two values only, 0 and 1e-05 m: that is a switch"):
        _diagnosed(np.where(displacement > np.mean(displacement), 1e-5, 0.0))


@slow
def test_a_record_at_rest_next_to_others_counts_over_their_range(displacement: FloatArray) -> None:
    moves = psa.Record(name="r", time=TIME, voltage=VOLTAGE, displacement=displacement)
    rest = np.ones(TIME.size)
    hold = replace(
        moves, name="hold", voltage=VOLTAGE[0] * rest, displacement=displacement[0] * rest
    )
    result = psa.diagnose([moves, hold], effects=TABLE)
    assert np.isfinite(result.base_errors.holdout_nrmse_percent)


#: The effects that come nearest to the curve, and one that does not.
NEAR = ("sensor_nonlinearity", "load_stiffness", "preload_loss", "hysteresis_memory", "slow_creep")


def _curved(displacement: FloatArray) -> FloatArray:
    """A reading with a ripple that narrows over the travel, which no effect of the table forms."""
    return displacement + 1e-7 * np.sin(0.25 * (displacement / 1e-6) ** 2)


@slow
def test_what_has_no_name_is_offered_with_its_place_and_written(tmp_path: Path) -> None:
    time = np.arange(2500) * 1e-3
    voltage = 50.0 + 30.0 * np.sin(2 * np.pi * time) + 15.0 * np.sin(2 * np.pi * 0.31 * time)
    clean = psa.simulate(psa.stack_model("P-885.51"), time, voltage).displacement
    noise = 5e-9 * np.random.default_rng(2).standard_normal(time.size)
    psa.write_record(
        tmp_path / "r.csv",
        {"time [s]": time, "voltage [V]": voltage, "displacement [m]": _curved(clean) + noise},
    )
    paths = {n: tmp_path / n for n in ("ext.json", "patched.json", "d.json", "r.html")}
    left_out = (word for n in psa.EFFECTS if n not in NEAR for word in ("--leave-out", n))
    statement = done(
        "diagnose", tmp_path / "r.csv", "-o", paths["ext.json"], "--patch", paths["patched.json"],
        "--json", paths["d.json"], "--report", paths["r.html"], "--still", *left_out,
    ).out  # fmt: skip
    content = json.loads(paths["d.json"].read_text(encoding="utf-8"))
    assert content["verdict"] == "unexplained"
    assert (content["patch"]["kind"], content["patch"]["port"]) == ("curve", "reading")
    assert content["budget"]["unnamed"]["share"] > 0.9
    assert "unnamed correction would remove" in " ".join(statement.split())
    page = paths["r.html"].read_text(encoding="utf-8")
    assert "Where the error goes" in page
    assert "Unnamed correction: curve at the reading" in page
    patched = psa.load_model(paths["patched.json"])
    assert [c.name for c in patched.effects] == ["patch_curve_reading"]
    assert [c.name for c in psa.load_model(paths["ext.json"]).effects] == []
    moved = psa.simulate(patched, time, voltage)
    error = moved.outputs["measured_displacement"] - _curved(clean)
    assert np.std(error) < 0.3 * np.std(_curved(clean) - clean)


def test_without_a_correction_nothing_is_written_and_that_is_reported(tmp_path: Path) -> None:
    text = write_patch(diagnosis("adequate"), tmp_path / "p.json", lambda _: None)
    assert "No unnamed correction" in text
    assert not (tmp_path / "p.json").exists()
