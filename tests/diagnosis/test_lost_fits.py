"""Fits that lose themselves: an effect far from its ordinary size, a cause chosen too early."""

from pathlib import Path

import numpy as np

import psa_casadi as psa
from psa_casadi.identification.fitting.prediction import measured
from tests.studies.plants.make import make_record, play_again
from tests.tiers import slow


@slow
def test_the_order_of_the_records_tells_nothing(tmp_path: Path) -> None:
    ends = (1000, 1000)  # their lengths hold no information either
    truth = make_record("offset_drift", 3, tmp_path / "a.csv", excitation="triangle")
    play_again(truth, 4, tmp_path / "b.csv")
    pairs = zip(("a", "b"), ends, strict=True)
    records = [psa.read_record(tmp_path / f"{n}.csv").slice(0, end) for n, end in pairs]
    effects = [psa.EFFECTS["offset_drift"]]
    one, other = (psa.diagnose(r, effects=effects) for r in (records, records[::-1]))
    for mine, yours in zip(one.experiments, other.experiments, strict=True):
        np.testing.assert_array_equal(measured(mine.record), measured(yours.record))
    assert one.extended_errors == other.extended_errors
    assert one.causes == other.causes


@slow
def test_an_effect_that_the_bent_base_hides_is_found(tmp_path: Path) -> None:
    """Four effects lead the screening, none explains the data: an amplifier of 0.9 ms does."""
    path = tmp_path / "record.csv"
    make_record("drive_lag", 52001, path, gain=9.171e-4)
    record = psa.read_record(path)
    names = ("rate_dependent_hysteresis", "voltage_saturation", "preload_loss", "load_stiffness")
    result = psa.diagnose([record], effects=[psa.EFFECTS[n] for n in (*names, "drive_lag")])
    assert result.verdict == "cause_named"
    assert [c.effect for c in result.causes] == ["drive_lag"]


@slow
def test_stuck_readings_that_the_misfit_hid_are_masked_once_the_cause_is_known(
    tmp_path: Path,
) -> None:
    """Seven standard deviations of the noise off, two of what a hum leaves of the base fit."""
    truth = make_record("mains_hum", 3, tmp_path / "a.csv", excitation="triangle", visible=3.0)
    inputs = psa.read_record(tmp_path / "a.csv").slice(0, 1200)
    counts = 0.7 * truth.sigma
    y = counts * np.round(measured(inputs) / counts)
    moves = np.abs(np.diff(truth.displacement[:1200], prepend=0.0))
    stuck = []
    for k in range(100, 1100, 50):
        length = max(1, round(7.0 * truth.sigma / max(moves[k], 1e-12)))
        if length < 8:
            y[k : k + length] = y[k - 1]
            stuck.append(k + length - 1)
    assert len(stuck) > 10
    record = psa.Record(name="a", time=inputs.time, voltage=inputs.voltage, displacement=y)
    result = psa.diagnose([record], effects=[psa.EFFECTS["mains_hum"]])
    used = result.experiments[0].record.mask
    assert [c.effect for c in result.causes] == ["mains_hum"]
    assert np.mean(used[stuck]) < 0.4
    assert np.mean(used) > 0.95
    assert any("repeat the last one far from the model" in n for n in result.notes)
