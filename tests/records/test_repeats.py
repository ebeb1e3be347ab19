"""Noise that is measured without a model: from a voltage played again, and from a held one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.noise import noise_floor
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records import Record, excitation
from psa_casadi.records.repeats import MeasuredNoise, held, holds, repeats, repetitions

LEVEL = 1e-8
STEP = 1e-3


def noise(samples: int, correlation: float, seed: int = 0) -> FloatArray:
    white = np.random.default_rng(seed).standard_normal(samples + 500)
    coloured: FloatArray = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], white)
    return LEVEL * coloured[500:]


def grid(samples: int) -> FloatArray:
    return STEP * np.arange(samples, dtype=np.float64)


def record(voltage: FloatArray, displacement: FloatArray) -> Record:
    return Record(name="r", time=grid(voltage.size), voltage=voltage, displacement=displacement)


def sine(samples: int, period: float = 500.0) -> FloatArray:
    return np.asarray(50.0 * (1.0 - np.cos(2 * np.pi * np.arange(samples) / period)))


def loop_error(voltage: FloatArray) -> FloatArray:
    """Return an error thirty times the noise that every period repeats, branches apart."""
    return np.asarray(3e-7 * np.sin(voltage / 9.0) + 2e-7 * np.tanh(10.0 * np.gradient(voltage)))


@pytest.mark.parametrize("correlation", [0.0, 0.7])
@pytest.mark.parametrize("seed", range(4))
def test_periods_show_level_and_colour_beside_a_large_repeated_error(
    correlation: float, seed: int
) -> None:
    v = sine(20_000)
    n = np.arange(v.size)
    drift = 5e-7 * (n / n.size) ** 2
    first = np.where(n < 500, 4e-7 * np.exp(-n / 200.0), 0.0)  # the virgin curve
    y = 1e-7 * v + loop_error(v) + drift + first + noise(v.size, correlation, seed)
    result = repeats(record(v, y))
    assert result is not None
    assert result.level == pytest.approx(LEVEL, rel=0.05)
    ratio = result.autocovariance[:6] / result.autocovariance[0]
    assert ratio == pytest.approx(correlation ** np.arange(6), abs=0.06)
    assert result.distances[0] == pytest.approx(0.5)
    assert 10_000 < result.samples <= v.size
    if correlation:
        assert result.autoregression[0] == pytest.approx(correlation, abs=0.05)
    else:
        assert np.all(np.abs(result.autoregression) < 0.05)


def assert_noise(result: MeasuredNoise | None, correlation: float) -> None:
    """Demand the level of the noise, and the correlation of its neighbours."""
    assert result is not None
    assert result.level == pytest.approx(LEVEL, rel=0.05)
    ratio = result.autocovariance[1] / result.autocovariance[0]
    assert ratio == pytest.approx(correlation, abs=0.05)


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_missing_samples_change_nothing(correlation: float) -> None:
    v = sine(20_000)
    y = 1e-7 * v + loop_error(v) + noise(v.size, correlation)
    y[np.random.default_rng(1).random(v.size) < 0.2] = np.nan
    y[7_000:8_000] = np.nan
    assert_noise(repeats(record(v, y)), correlation)


def segment() -> FloatArray:
    t = np.arange(6_000) / 6_000
    return np.asarray(50.0 + 40.0 * np.sin(2 * np.pi * 7 * t) * np.cos(2 * np.pi * 1.5 * t))


def test_a_segment_played_twice_counts_from_where_its_history_is_the_same() -> None:
    part = segment()
    v = np.concatenate([np.linspace(0, 50, 400), part, np.linspace(50, 5, 900), part, part[:1]])
    y = 1e-7 * v + loop_error(v) + noise(v.size, 0.0)
    (result,) = repetitions(record(v, y))
    assert result.lag == 6_900
    assert abs(result.stop - 6_400) < 6
    both = max(int(np.argmax(part)), int(np.argmin(part)))
    assert result.settled >= 400 + min(both, 1_500)
    assert_noise(repeats(record(v, y)), 0.0)


def test_what_is_not_repeated_shows_nothing() -> None:
    time = grid(8_000)
    once = excitation.multisine(time, 0.0, 100.0, (0.125, 20.0), seed=1)
    ramp = np.linspace(0.0, 100.0, 8_000)
    decay = excitation.decaying_triangle(time, 0.0, 100.0, 6)
    for v in (once, ramp, decay, np.full(8_000, 30.0)):
        assert repeats(record(v, 1e-7 * v + noise(v.size, 0.0))) is None
    assert repeats(replace(record(ramp, ramp), displacement=None)) is None


def held_levels() -> tuple[FloatArray, FloatArray]:
    levels = np.array([0.0, 50.0, 20.0, 80.0])
    v = np.repeat(levels, 5_000)
    since = np.tile(np.arange(5_000), 4)
    change = np.repeat(np.diff(levels, prepend=0.0), 5_000)
    creep: FloatArray = 1e-7 * v + 2e-9 * change * np.log10(1.0 + since / 30.0)
    return v, creep


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_holds_show_the_noise_around_a_creep(correlation: float) -> None:
    v, creep = held_levels()
    result = holds(record(v, creep + noise(v.size, correlation)))
    assert_noise(result, correlation)
    assert result is not None
    assert result.holds == 4


def test_ringing_after_a_step_is_no_noise_of_a_hold() -> None:
    """A mode of 30 Hz with damping 0.02 rings for most of a hold, thirty times above the noise."""
    n, step, omega = 6000, 1500, 2 * np.pi * 30.0
    since = STEP * (np.arange(n) % step)
    ringing = 30 * LEVEL * np.exp(-0.02 * omega * since) * np.cos(omega * since)
    levels = np.where(np.arange(n) // step % 2, 10.0, 0.0)
    result = holds(record(levels, np.asarray(ringing + noise(n, 0.0), np.float64)))
    assert result is not None
    assert result.level == pytest.approx(LEVEL, rel=0.25)


def test_held_spans_are_no_ramps() -> None:
    v, _ = held_levels()
    assert held(record(v, v)) == [(k, k + 5_000) for k in range(0, 20_000, 5_000)]
    slow = np.linspace(0.0, 100.0, 100_000)
    assert held(record(slow, slow)) == []
    assert held(record(sine(20_000), sine(20_000))) == []


def test_the_noise_floor_takes_the_best_source() -> None:
    rng = np.random.default_rng(3)
    v, creep = held_levels()
    time = grid(v.size)
    once = excitation.multisine(time, 0.0, 100.0, (0.05, 20.0), seed=1)
    rows = [(sine(v.size), 1e-7 * sine(v.size)), (v, creep), (once, 1e-7 * once)]
    records = [record(u, y + LEVEL * rng.standard_normal(u.size)) for u, y in rows]
    residuals = [measured(r) - y for r, (_, y) in zip(records, rows, strict=True)]
    floors = noise_floor(records, residuals)
    assert [f.source for f in floors] == ["repeats", "holds", "fast part"]
    for floor in floors:
        assert floor.level == pytest.approx(LEVEL, rel=0.05)
        assert floor.autocovariance[0] == pytest.approx(floor.level**2)
        assert "nm rms" in floor.sentence
        assert floor.quantum is None


def test_a_coarse_sensor_has_at_least_the_noise_of_rounding() -> None:
    time = grid(6_000)
    v = excitation.multisine(time, 0.0, 100.0, (0.2, 2.0), seed=1)
    step = 1e-7
    y = step * np.round((1e-7 * v + 1e-9 * np.random.default_rng(0).standard_normal(6_000)) / step)
    (floor,) = noise_floor([record(v, y)], [y - 1e-7 * v])
    assert floor.quantum == pytest.approx(step, rel=1e-3)
    assert floor.level >= step / np.sqrt(12.0) * 0.999
    assert floor.autocovariance[0] == pytest.approx(floor.level**2)
    assert "steps of 0.1 µm" in floor.sentence
