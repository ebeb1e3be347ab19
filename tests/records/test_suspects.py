"""Samples that a sensor has made are distinguished from motions, which have kinks and jumps."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi.common.notes import texts
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.records import Record, multisine, sine, time_grid, triangle
from psa_casadi.records.noise import quantum_of
from psa_casadi.records.suspects import cleaned, spikes_in, suspects
from tests.tiers import slow_but
from tests.voltages import steps

RANGE = 20e-6
T = time_grid(1.0, 1e-4)


def stack(u: FloatArray, f: float = 200.0, damping: float = 0.05) -> FloatArray:
    """Return the displacement of a light resonance with play hysteresis, sampled as T is."""
    held, play = np.empty(u.size), u[0]
    for k, v in enumerate(u):
        play = min(max(play, v - 8.0), v + 8.0)
        held[k] = play
    x, w, dt = (0.7 * u + 0.3 * held) * RANGE / 100.0, 2 * np.pi * f, T[1]
    a = 1.0 + 2 * damping * w * dt + (w * dt) ** 2
    filtered = lfilter([(w * dt) ** 2 / a], [1.0, -(2.0 + 2 * damping * w * dt) / a, 1.0 / a], x)
    return np.asarray(filtered, dtype=float)


def ringing(n: int, period: float) -> FloatArray:
    k = np.arange(n)
    return np.asarray(np.exp(-k / (3.0 * period)) * np.cos(2 * np.pi * k / period))


VOLTAGES: dict[str, FloatArray] = {
    "sine": sine(T, 0.0, 100.0, 5.0),
    "fast sine": sine(T, -50.0, 50.0, 500.0),
    "triangle": triangle(T, 0.0, 100.0, 10.0),
    "steps": steps(T, [0.0, 100.0, 30.0, 80.0, 0.0]),
    "small steps": steps(T, [50.0, 51.0, 50.5, 0.0, 50.0]),
    "multisine": multisine(T, 0.0, 100.0, (5.0, 2000.0), seed=3),
}
NOISES: dict[str, Callable[[np.random.Generator], FloatArray]] = {
    "none": lambda g: np.zeros(T.size),
    "white": lambda g: 1e-3 * g.standard_normal(T.size),
    "loud": lambda g: 2e-2 * g.standard_normal(T.size),
    "coloured": lambda g: lfilter([0.71e-3], [1, -0.7], g.standard_normal(T.size)),
    "fine steps": lambda g: 1e-3 * g.standard_normal(T.size),
    "coarse steps": lambda g: 5e-3 * g.standard_normal(T.size),
}
STEP = {"fine steps": 1e-3 * RANGE, "coarse steps": 2e-2 * RANGE}


def record(voltage: str, noise: str, seed: int = 0, f: float = 200.0) -> Record:
    u = VOLTAGES[voltage]
    y = stack(u, f) + RANGE * NOISES[noise](np.random.default_rng(seed))
    if noise in STEP:
        y = np.round(y / STEP[noise]) * STEP[noise]
    return Record(name=f"{voltage}, {noise}", time=T, voltage=u, displacement=y)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("voltage", VOLTAGES)
@pytest.mark.parametrize("f", slow_but([200.0], [20.0, 200.0, 1500.0]))
def test_what_a_stack_does_is_not_suspect(voltage: str, noise: str, f: float) -> None:
    flagged = [int(suspects(record(voltage, noise, seed, f)).mask.sum()) for seed in range(2)]
    assert sum(flagged) <= 1


@pytest.mark.parametrize("period", [3.0, 4.5, 6.0, 9.0, 15.0])
@pytest.mark.parametrize("delay", [0, 3, 12])
def test_ringing_after_a_jump_is_not_suspect(period: float, delay: int) -> None:
    u = np.where(T < 0.5, 0.0, 100.0)
    at = 5000 + delay
    y = np.where(np.arange(T.size) < at, 0.0, RANGE)
    y[at:] -= RANGE * ringing(T.size - at, period)
    y += 2e-4 * RANGE * np.random.default_rng(1).standard_normal(T.size)
    assert not suspects(Record(name="ringing", time=T, voltage=u, displacement=y)).mask.any()


def test_a_kick_of_the_load_is_not_suspect() -> None:
    load = np.zeros(T.size)
    load[6000:6002] = 50.0
    base = record("sine", "white")
    y = np.array(base.displacement)
    y[6001:6004] += 0.2 * RANGE
    assert not suspects(replace(base, displacement=y, load_force=load)).mask.any()
    assert list(np.flatnonzero(suspects(replace(base, displacement=y)).mask)) == [6001, 6002, 6003]


@pytest.mark.parametrize("width", [1, 2, 3])
@pytest.mark.parametrize("noise", ["white", "coloured", "fine steps"])
@pytest.mark.parametrize("voltage", ["sine", "triangle", "steps"])
def test_spikes_are_detected_and_nothing_else(voltage: str, noise: str, width: int) -> None:
    base = record(voltage, noise)
    y, draw = np.array(base.displacement), np.random.default_rng(4)
    spikes = np.zeros(T.size, dtype=bool)
    for start in range(60, T.size - 60, 97):
        spikes[start : start + width] = True
        y[start : start + width] += draw.choice([-1, 1]) * draw.uniform(0.03, 0.6) * RANGE
    result = suspects(replace(base, displacement=y))
    assert (result.mask & spikes).sum() > 0.9 * spikes.sum()
    assert (result.mask & ~spikes).sum() <= 1
    assert result.counts["outlier"] == result.mask.sum()


@pytest.mark.parametrize("value", [0.0, 1.4 * RANGE, -0.3 * RANGE])
@pytest.mark.parametrize("length", [5, 40, 300])
def test_drop_outs_are_detected(value: float, length: int) -> None:
    base = record("sine", "white")
    y = np.array(base.displacement)
    starts = [k for k in range(400, 9000, 1300) if abs(y[k] - value) > 0.2 * RANGE]
    lost = np.zeros(T.size, dtype=bool)
    for start in starts:
        lost[start : start + length] = True
    y[lost] = value
    result = suspects(replace(base, displacement=y))
    assert len(starts) >= 4
    np.testing.assert_array_equal(result.mask, lost)
    assert result.counts == {"outlier": 0, "drop-out": lost.sum(), "stuck": 0, "saturated": 0}
    (sentence,) = texts(result.notes("a.csv"))
    assert sentence.startswith(f"a.csv: {lost.sum()} samples belong to drop-outs")


@pytest.mark.parametrize("noise", ["white", "fine steps", "none"])
def test_a_stuck_sensor_is_detected(noise: str) -> None:
    base = record("sine", noise)
    y = np.array(base.displacement)
    y[3300:3700] = y[3299]
    result = suspects(replace(base, displacement=y))
    assert result.counts["stuck"] >= 399
    assert set(np.flatnonzero(result.mask)) <= set(range(3295, 3702))


def test_cleaned_masks_and_makes_nothing_up() -> None:
    base = record("sine", "white")
    y = np.array(base.displacement)
    y[[100, 4000]] += RANGE
    y[2000:2050] = np.nan
    spoilt = replace(base, displacement=y)
    result = cleaned(spoilt)
    assert list(np.flatnonzero(spoilt.mask & ~result.mask)) == [100, 4000]
    np.testing.assert_array_equal(np.asarray(result.displacement)[result.mask], y[result.mask])
    assert (result.name, result.sha256) == (spoilt.name, spoilt.sha256)
    assert cleaned(base) is base
    planned = Record(name="planned", time=T, voltage=VOLTAGES["sine"])
    assert cleaned(planned) is planned
    assert str(suspects(spoilt).notes("r")[0]).startswith("r: 2 samples stand out as spikes")


def test_the_quantum_is_the_step_of_the_sensor() -> None:
    draw = np.random.default_rng(2)
    motion = 1e-5 * np.sin(30 * T)
    for step in (3.0517e-8, 2e-7, 1e-6):
        for noise in (0.0, 0.3, 2.0):
            y = np.round((motion + noise * step * draw.standard_normal(T.size)) / step) * step
            assert quantum_of(y) == pytest.approx(step, rel=1e-6)
            assert quantum_of(np.round(y, 10)) == pytest.approx(step, rel=5e-3)
    assert quantum_of(motion + 1e-8 * draw.standard_normal(T.size)) is None
    assert quantum_of(np.round(motion, 10)) is None
    assert quantum_of(np.repeat(draw.standard_normal(50), 100)) is None
    assert quantum_of(np.where(T < 0.5, 0.0, 1.0)) is None
    result = suspects(record("sine", "coarse steps"))
    assert result.quantum == pytest.approx(STEP["coarse steps"])
    assert texts(result.notes("r")) == ("r: the displacement is quantised in steps of 400 nm.",)
    counts = np.round(np.asarray(record("sine", "white").displacement) / 1e-7)
    in_counts = replace(record("sine", "white"), displacement=counts, displacement_unit="counts")
    result = suspects(in_counts)
    assert texts(result.notes("c")) == ("c: the displacement is quantised in steps of 1 counts.",)


def test_a_reading_repeated_shortly_while_the_stack_moves_is_masked() -> None:
    """The next reading makes up for the motion meanwhile; a stack that is always late is none."""
    inputs = record("triangle", "white")
    y = np.array(inputs.displacement)
    per_sample = 0.01 * RANGE * float(np.max(np.abs(np.diff(inputs.voltage))))
    repeats = int(np.ceil(1e-2 * RANGE / per_sample))
    expected = set[int]()
    for k in (300, 460, 777):
        y[k : k + repeats] = y[k - 1]
        expected |= set(range(k, k + repeats))
    result = suspects(replace(inputs, displacement=y))
    assert set(np.flatnonzero(result.mask).tolist()) == expected
    assert result.counts["stuck"] == len(expected)
    slow = np.repeat(y[::4], 4)[: y.size]  # a sensor that is read every fourth sample only
    assert suspects(replace(inputs, displacement=slow)).counts["stuck"] == 0


@pytest.mark.parametrize("noise", ["white", "loud"])
@pytest.mark.parametrize("digit", [0.0, 1e-6])
def test_readings_repeated_to_the_last_digit_are_masked_where_noise_makes_none(
    noise: str, digit: float
) -> None:
    """However slowly the stack moves; what the file's digits repeat by chance is left alone."""
    inputs = record("sine", noise)
    y = np.array(inputs.displacement)
    y = np.round(y / (digit * RANGE)) * (digit * RANGE) if digit else y
    assert not suspects(replace(inputs, displacement=y)).mask.any()
    places = np.random.default_rng(2).choice(y.size - 9, 60, replace=False) + 5
    for k in np.sort(places):
        y[k] = y[k - 1]
    result = suspects(replace(inputs, displacement=y))
    assert set(places.tolist()) <= set(np.flatnonzero(result.mask).tolist())
    assert result.counts["stuck"] == int(result.mask.sum()) < 1.1 * places.size + 10
    coarse = np.round(y / (1e-3 * RANGE)) * (1e-3 * RANGE)
    assert suspects(replace(inputs, displacement=coarse)).counts["stuck"] == 0


N, DT = 3000, 1e-3
SECONDS = DT * np.arange(N, dtype=np.float64)
#: Input and output of a motion, without noise.
Motion = Callable[[np.random.Generator], tuple[FloatArray, FloatArray]]


def driven(u: FloatArray, frequency: float, damping: float) -> FloatArray:
    """Return what a resonance [Hz] makes of an input; its gain at rest is 1."""
    decay, turn = np.exp(-2.0 * np.pi * frequency * damping * DT), 2.0 * np.pi * frequency * DT
    lower = [1.0, -2.0 * decay * np.cos(turn), decay**2]
    return np.asarray(lfilter([sum(lower)], lower, u))


def resonance(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Five samples a period."""
    u = rng.standard_normal(N)
    return u, driven(u, 200.0, 0.02)


def tones(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    f = np.arange(5.0, 150.0, 0.5)
    u = np.cos(2.0 * np.pi * np.outer(SECONDS, f) + rng.uniform(0.0, 6.28, f.size)).sum(axis=1)
    return u, driven(u, 60.0, 0.05)


def held_steps(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """What jumps with its input, and decays: a current after steps of the voltage."""
    u = np.repeat(rng.choice([0.0, 1.0, 2.0], N // 100), 100)
    return u, u - np.asarray(lfilter([0.2], [1.0, -0.8], u))


def slow(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    u = np.sin(2.0 * np.pi * 2.0 * SECONDS) + 0.3 * np.sin(2.0 * np.pi * 7.3 * SECONDS)
    return u, driven(u, 3.0, 0.7)


def bounces(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Impacts that no input shows."""
    y = np.abs(np.sin(2.0 * np.pi * 1.7 * SECONDS)) * np.exp(-0.3 * SECONDS)
    return np.zeros(N), y


MOTIONS = (resonance, tones, held_steps, slow, bounces)


def spikes_of(u: FloatArray, y: FloatArray) -> BoolArray:
    return spikes_in(y, u[:, None], 8.0, 1e-3 * float(np.ptp(y)), 3)


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("motion", MOTIONS)
def test_spikes_in_any_motion_are_detected(motion: Motion, noise: float) -> None:
    clean, there, hit, wrong = 0, 0, 0, 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u, y = motion(rng)
        span = float(np.ptp(y))
        y = y + noise * span * rng.standard_normal(N)
        clean += int(spikes_of(u, y).sum())
        spikes = np.zeros(N, dtype=np.bool_)
        spikes[rng.choice(np.arange(4, N - 4), N // 100, replace=False)] = True
        sizes = rng.choice([-1.0, 1.0], N) * rng.uniform(10.0 * noise + 0.05, 0.5, N) * span
        mask = spikes_of(u, np.where(spikes, y + sizes, y))
        there += int(spikes.sum())
        hit += int((mask & spikes).sum())
        wrong += int((mask & ~spikes).sum())
    assert clean <= 1
    assert hit > 0.8 * there
    assert wrong <= 5


@pytest.mark.parametrize("width", [2, 3])
def test_a_spike_of_two_or_three_samples_is_detected_and_a_step_is_none(width: int) -> None:
    rng = np.random.default_rng(1)
    u, y = slow(rng)
    y = y + 1e-3 * np.ptp(y) * rng.standard_normal(N)
    y[500 : 500 + width] += 0.2 * np.ptp(y)
    assert np.flatnonzero(spikes_of(u, y)).tolist() == [*range(500, 500 + width)]
    y[500:] += 0.2 * np.ptp(y)
    y[500 : 500 + width] -= 0.2 * np.ptp(y)
    assert not spikes_of(u, y)[505:].any()


def test_missing_samples_few_samples_and_constant_signals_have_no_spikes() -> None:
    rng = np.random.default_rng(1)
    u, y = tones(rng)
    y[rng.choice(N, 100, replace=False)] = np.nan
    assert not spikes_of(u, y).any()
    assert not spikes_in(y[:50], u[:50, None], 8.0, 0.0, 3).any()
    assert not spikes_in(np.full(N, np.nan), u[:, None], 8.0, 0.0, 3).any()
    assert not spikes_in(np.ones(N), np.zeros((N, 0)), 8.0, 0.0, 3).any()
