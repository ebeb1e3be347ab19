"""What is held out of a record, where its voltage turns, and how much noise it holds."""

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.common.notes import texts
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.diagnosis.held_out import coverage_notes
from psa_casadi.records import Record
from psa_casadi.records.drive import reversals
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.split import divided, split, whole


def record(voltage: FloatArray) -> Record:
    time = np.linspace(0.0, 1e-3 * (len(voltage) - 1), len(voltage))
    return Record(name="r", time=time, voltage=voltage, displacement=1e-7 * voltage)


def triangle(samples: int, period: int) -> FloatArray:
    phase = np.arange(samples) / period % 1.0
    return np.asarray(50.0 * (1.0 - np.abs(2.0 * phase - 1.0)))


def test_reversals_of_a_triangle() -> None:
    np.testing.assert_array_equal(reversals(triangle(1000, 200)), np.arange(100, 1000, 100))


@pytest.mark.parametrize("seed", range(3))
def test_reversals_see_through_noise_of_a_converter(seed: int) -> None:
    clean = triangle(1000, 200)
    noise = 1e-5 * 50.0 * np.random.default_rng(seed).uniform(-1.0, 1.0, 1000)
    turns = np.arange(100, 1000, 100)
    np.testing.assert_allclose(reversals(clean + noise), turns, atol=1)
    plateau = np.repeat(clean + noise, 3)  # every sample held for three
    np.testing.assert_allclose(reversals(plateau), 3 * turns, atol=3)


def borders(held_out: BoolArray) -> NDArray[np.intp]:
    """Return the samples at which fitting turns into holding out or back."""
    return np.flatnonzero(np.diff(held_out.astype(int))) + 1


@pytest.mark.parametrize("period", [34, 60, 170, 230])
def test_every_fourth_block_is_held_out_and_no_segment_is_cut(period: int) -> None:
    """Sixteen blocks of some 125 samples, the ends moved to the nearest reversal."""
    e = split(record(triangle(2000, period)))
    edges = borders(e.held_out)
    turns = reversals(e.record.voltage)
    assert len(edges) == 7
    assert set(edges) <= set(turns)
    wanted = 2000 / 16 * np.array([3, 4, 7, 8, 11, 12, 15])
    for edge, point in zip(edges, wanted, strict=True):
        assert abs(edge - point) == np.abs(turns - point).min()
    assert e.held_out[-1]
    assert e.stop == edges[-1]
    assert abs(np.mean(e.held_out) - 0.25) < period / 2000  # ends move by a quarter period at most
    np.testing.assert_array_equal(e.used, ~e.held_out)


def with_a_hold() -> FloatArray:
    """Loops of 50 samples, but for a hold from 1/4 to 3/8 of the record: blocks 4 and 5."""
    voltage = triangle(1600, 50)
    voltage[400:600] = 0.0
    return voltage


def test_every_kind_of_stretch_is_fitted_and_held_out() -> None:
    e = split(record(with_a_hold()))
    hold = slice(400, 600)
    assert e.used[hold].any()
    assert e.held_out[hold].any()
    assert coverage_notes([e]) == ()


def test_what_is_not_held_out_is_reported() -> None:
    voltage = with_a_hold()
    voltage[500:600] = triangle(100, 50)  # the hold fills one block, which is fitted
    (note,) = coverage_notes([split(record(voltage))])
    assert str(note).startswith("8 % of the fitted samples")
    assert "held voltages" in str(note)


def test_what_is_held_out_but_not_fitted_is_reported() -> None:
    """Slow and wide loops are held out; their first tenth, which determines their start, too."""
    small, slow = 0.2 * triangle(1600, 50), triangle(1600, 800)
    result = texts(coverage_notes(divided([record(small)], [record(slow)])))
    assert len(result) == 3
    assert "large falls of 0.25 to 1 s" in result[0]
    assert "extrapolates" in result[0]
    assert "says nothing" in result[1]
    assert "from 0 to 50 V, fitted ones from 0 to 10 V" in result[2]


@pytest.mark.parametrize("seed", range(20))
def test_the_extremes_of_voltage_and_rate_are_fitted(seed: int) -> None:
    """Levels and ramps of any size: one block of every four is held out, none with an extreme."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform(0.0, 80.0, 41)
    voltage = np.interp(np.arange(4000.0), np.cumsum(rng.uniform(60.0, 140.0, 41)), levels)
    e = split(record(voltage))
    rate = np.diff(voltage, prepend=voltage[:1])
    for signal in (voltage, -voltage, rate, -rate):
        beyond = np.max(signal[e.held_out]) - np.max(signal[e.used])
        assert beyond < 2e-3 * np.ptp(signal)  # blocks end on reversals: neighbours share them
    quarters = np.array_split(e.held_out, 4)
    # one block of four in each quarter, either end moved by half a block at most
    assert all(0.05 < np.mean(q) < 0.5 for q in quarters)
    assert e.used[:125].all()  # the first block, at least half of its length


def test_missing_samples_are_neither_fitted_nor_held_out() -> None:
    r = record(triangle(1000, 100))
    y = np.array(r.displacement)
    y[::10] = np.nan
    e = split(Record(name="r", time=r.time, voltage=r.voltage, displacement=y))
    assert not (e.used | e.held_out)[::10].any()
    assert int((e.used | e.held_out).sum()) == 900
    assert not (e.used & e.held_out).any()
    all_of_it = whole(e.record)
    np.testing.assert_array_equal(all_of_it.used, np.isfinite(y))
    assert not all_of_it.held_out.any()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("quantum", [0.0, 0.5, 1.0])
def test_white_noise_on_a_motion_is_detected(seed: int, quantum: float) -> None:
    """Rounding to a count q adds q^2/12 to the variance, which is white too."""
    t = np.arange(6000) * 1e-3
    motion = 200.0 * np.sin(2 * np.pi * 3.0 * t) + 80.0 * np.sin(2 * np.pi * 7.0 * t)
    y = motion + np.random.default_rng(seed).standard_normal(6000)
    if quantum:
        y = quantum * np.round(y / quantum)
    true = np.hypot(1.0, quantum / np.sqrt(12.0))
    assert high_frequency_noise(y) == pytest.approx(true, rel=0.05)
