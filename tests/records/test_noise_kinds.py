"""Noises in plain NumPy: each by its kind, and measured without a model where voltages repeat."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.noise import noise_floor
from psa_casadi.records import Record, excitation
from psa_casadi.records.noise_kinds import NoiseFound, NoiseKind, noise_kinds, notes_of
from psa_casadi.records.repeats import MeasuredNoise, held, holds, repeats, repetitions
from psa_casadi.report.words.notes import note_text

Rng = np.random.Generator

#: Samples, the interval between them [s], and the size of the noise [m].
N, STEP, SIZE = 6000, 1e-4, 3e-9
TIME: FloatArray = STEP * np.arange(N, dtype=np.float64)
SEEDS = range(20)


def triangle(rng: Rng) -> FloatArray:
    """Return a triangle of 0 to 100 V."""
    phase = rng.uniform(8.0, 20.0) * TIME % 1.0
    return np.asarray(100.0 * (1.0 - np.abs(2.0 * phase - 1.0)))


def fading(rng: Rng) -> FloatArray:
    """Return a sine about 50 V that fades, so that no loop is like another."""
    t = np.linspace(0.0, 1.0, N)
    return 50.0 + 50.0 * np.sin(2.0 * np.pi * rng.uniform(5.0, 12.0) * t) * np.exp(-3.0 * t)


def sweep(rng: Rng) -> FloatArray:
    """Return a sine whose frequency rises."""
    t = np.linspace(0.0, 1.0, N)
    return 50.0 + 40.0 * np.sin(2.0 * np.pi * (3.0 * t + rng.uniform(6.0, 12.0) * t**2))


DRIVES = (triangle, fading, sweep)


def play(u: FloatArray, width: float) -> FloatArray:
    """Return a play operator of the voltage."""
    values, at = np.empty_like(u), u[0]
    for k, v in enumerate(u.tolist()):
        at = min(max(at, v - width), v + width)
        values[k] = at
    return values


def motion(u: FloatArray) -> FloatArray:
    """Return the motion of the plant [m]."""
    return 1e-7 * (0.8 * u + 0.2 * play(u, 10.0))


def power_law(slope: float, rng: Rng) -> FloatArray:
    """Return noise with the spectrum f^-slope."""
    f = np.arange(N // 2 + 1) / N
    f[0] = f[1]
    values: FloatArray = np.fft.irfft(np.fft.rfft(rng.standard_normal(N)) * f ** (-0.5 * slope), N)
    return np.asarray(values / values.std())


def first_order(r: float, rng: Rng) -> FloatArray:
    """Return a first-order autoregression."""
    e = rng.standard_normal(N).tolist()
    for k in range(1, N):
        e[k] += r * e[k - 1]
    return np.array(e)


def white(rng: Rng, y: FloatArray) -> FloatArray:
    return rng.standard_normal(N)


def autoregressive(rng: Rng, y: FloatArray) -> FloatArray:
    return first_order(float(rng.choice([0.3, 0.7, 0.95])), rng)


def one_over_f(rng: Rng, y: FloatArray) -> FloatArray:
    return 2.0 * power_law(1.0, rng) + rng.standard_normal(N)


def telegraph(rng: Rng, y: FloatArray) -> FloatArray:
    upper = np.cumsum(rng.random(N) < 1.0 / rng.choice([20.0, 100.0])) % 2
    return np.asarray(rng.choice([2.0, 4.0]) * upper + rng.standard_normal(N))


def steps(rng: Rng, y: FloatArray) -> FloatArray:
    places = np.cumsum(rng.integers(800, 1800, 3))
    return 5.0 * np.searchsorted(places, np.arange(N), side="right") + rng.standard_normal(N)


def heavy_tails(rng: Rng, y: FloatArray) -> FloatArray:
    return rng.standard_t(rng.choice([2.5, 4.0]), N)


def outliers(rng: Rng, y: FloatArray) -> FloatArray:
    e = rng.standard_normal(N)
    e[rng.choice(N, 12, replace=False)] += rng.choice([-1.0, 1.0], 12) * rng.uniform(9.0, 40.0, 12)
    return e


def jitter(rng: Rng, y: FloatArray) -> FloatArray:
    late = 6.0 * SIZE / float(np.std(np.gradient(y, STEP)))
    return rng.standard_normal(N) + late * rng.standard_normal(N) * np.gradient(y, STEP) / SIZE


def lines(rng: Rng, y: FloatArray) -> FloatArray:
    t = TIME
    return rng.standard_normal(N) + 0.5 * np.sin(2.0 * np.pi * 1234.0 * t + rng.uniform(0.0, 6.0))


def outliers_and_lines(rng: Rng, y: FloatArray) -> FloatArray:
    return lines(rng, y) - rng.standard_normal(N) + outliers(rng, y)


def short_step(rng: Rng, y: FloatArray) -> FloatArray:
    """Three readings in a row that are far off, as of a sensor that hangs."""
    place = int(rng.integers(500, N - 500))
    return rng.standard_normal(N) + 40.0 * ((place <= np.arange(N)) & (np.arange(N) < place + 3))


Noise = Callable[[Rng, FloatArray], FloatArray]
NOISES = (autoregressive, one_over_f, telegraph, steps, heavy_tails, outliers, jitter, lines)
KINDS: dict[str, Noise] = {noise.__name__: noise for noise in NOISES}


def kinds_in(noise: Noise, drive: Callable[[Rng], FloatArray], seed: int) -> tuple[NoiseKind, ...]:
    """Return the kinds in a noise on the plant's motion."""
    rng = np.random.default_rng(seed)
    u = drive(rng)
    y = motion(u)
    return noise_kinds(TIME, y + SIZE * noise(rng, y), y, [u])


def named(kinds: tuple[NoiseKind, ...]) -> set[str]:
    return {str(k.kind) for k in kinds} - {"white"}


def named_in_records(noise: Noise) -> list[set[str]]:
    """Return the kinds that are named in each of twenty records."""
    return [named(kinds_in(noise, DRIVES[seed % 3], seed)) for seed in SEEDS]


@pytest.mark.parametrize("kind", KINDS)
def test_each_noise_is_named_alone(kind: str) -> None:
    assert named_in_records(KINDS[kind]).count({kind}) >= 19


def test_white_noise_is_white_in_a_hundred_records() -> None:
    for seed in range(100):
        kinds = kinds_in(white, DRIVES[seed % 3], seed)
        assert [k.kind for k in kinds] == ["white"], (seed, kinds)
        assert kinds[0].figures["rms"] == pytest.approx(SIZE, rel=0.05)


def test_two_at_once_are_both_named() -> None:
    assert named_in_records(outliers_and_lines).count({"outliers", "lines"}) >= 19


def on_a_wander(noise: Noise) -> Noise:
    """Return a noise on a slow wander, such as a fit that the noise has bent leaves."""

    def both(rng: Rng, y: FloatArray) -> FloatArray:
        return noise(rng, y) + power_law(3.0, rng)

    return both


def clear_telegraph(rng: Rng, y: FloatArray) -> FloatArray:
    return 4.0 * (np.cumsum(rng.random(N) < 0.01) % 2) + rng.standard_normal(N)


@pytest.mark.parametrize("noise", [clear_telegraph, steps])
def test_jumps_are_detected_on_a_wander(noise: Noise) -> None:
    kind = noise.__name__.removeprefix("clear_")
    assert sum(kind in kinds for kinds in named_in_records(on_a_wander(noise))) >= 18


@pytest.mark.parametrize("seed", range(4))
def test_what_returns_at_once_is_no_step(seed: int) -> None:
    assert "steps" not in {k.kind for k in kinds_in(short_step, fading, seed)}


@pytest.mark.parametrize("places", [(3000,), (1500, 3000, 4500)])
def test_jumps_at_steps_of_the_voltage_are_no_noise(places: tuple[int, ...]) -> None:
    """A model that misses what follows a step leaves a residual that jumps there."""
    rng = np.random.default_rng(3)
    levels = [np.searchsorted(np.add(places, k), np.arange(N), side="right") for k in (0, 300)]
    u = fading(rng) + 20.0 * levels[0]
    y = motion(u)
    readings = [y + SIZE * (5.0 * jumps + rng.standard_normal(N)) for jumps in levels]
    assert ["steps" in named(noise_kinds(TIME, r, y, [u])) for r in readings] == [False, True]


def test_figures_are_those_of_the_noise() -> None:
    def figures(kind: str, seed: int) -> NoiseKind:
        kinds = kinds_in(KINDS[kind], fading, seed)
        return next(k for k in kinds if k.kind == kind)

    rng = np.random.default_rng(5)
    late = 6.0 * SIZE / float(np.std(np.gradient(motion(fading(rng)), STEP)))
    assert figures("jitter", 5).figures["rms"] == pytest.approx(late, rel=0.1)
    assert [figures("outliers", s).figures["count"] for s in range(3)] == [12.0, 12.0, 12.0]
    assert [figures("steps", s).figures["count"] for s in range(3)] == [3.0, 3.0, 3.0]
    assert figures("steps", 1).figures["size"] == pytest.approx(5.0 * SIZE, rel=0.1)
    assert figures("lines", 2).at[0] == pytest.approx(1234.0, rel=1e-3)
    assert figures("lines", 2).figures["amplitude"] == pytest.approx(0.5 * SIZE, rel=0.2)
    assert figures("one_over_f", 3).figures["slope"] == pytest.approx(1.0, abs=0.2)


def other_loop(u: FloatArray) -> FloatArray:
    """Return what another hysteresis leaves: the difference of two play operators."""
    left = play(u, 25.0) - 0.6 * play(u, 4.0)
    return left - np.polyval(np.polyfit(u, left, 1), u)


def other_branches(u: FloatArray) -> FloatArray:
    """Return what exponential branches leave of a straight line (Bouc and Wen)."""
    z, result = 0.0, np.empty_like(u)
    for k, d in enumerate(np.diff(u, prepend=u[0]).tolist()):
        z += (d - abs(d) * z) / 20.0
        result[k] = z
    return result - np.polyval(np.polyfit(u, result, 1), u)


def branches(u: FloatArray) -> FloatArray:
    """Return a backlash: a constant that changes sign with the direction."""
    return np.sign(np.gradient(u))


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("misfit", [other_loop, other_branches, branches])
def test_a_misfit_of_the_hysteresis_is_no_noise(
    misfit: Callable[[FloatArray], FloatArray], drive: Callable[[Rng], FloatArray]
) -> None:
    noises = {"one_over_f", "telegraph", "steps", "jitter", "heavy_tails", "autoregressive"}
    each = Counter[str]()
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        u = drive(rng)
        y, left = motion(u), misfit(u)
        reading = y + SIZE * (8.0 * left / float(left.std()) + rng.standard_normal(N))
        each.update(named(noise_kinds(TIME, reading, y, [u])))
    assert each["telegraph"] == 0, each
    assert sum(each[n] for n in noises) <= 1, each


def test_readings_that_are_held_rounded_or_missing_are_reported() -> None:
    rng = np.random.default_rng(7)
    time, u = TIME, fading(rng)
    y = motion(u)
    reading = y + SIZE * rng.standard_normal(N)
    third = noise_kinds(time, reading[np.arange(N) // 3 * 3], y, [u])
    assert third[0].kind == "held"
    assert third[0].figures == pytest.approx({"share": 2.0 / 3.0, "run": 3.0}, rel=0.01)
    coarse = noise_kinds(time, np.round(reading / (10.0 * SIZE)) * 10.0 * SIZE, y, [u])
    assert [k.kind for k in coarse] == ["quantised"]
    assert coarse[0].figures["step"] == pytest.approx(10.0 * SIZE)
    kept = np.flatnonzero(rng.random(N) > 0.01)
    gaps = noise_kinds(time[kept], reading[kept], y[kept], [u[kept]])
    assert [k.kind for k in gaps] == ["dropped", "white"]
    assert gaps[0].figures["count"] == np.ptp(kept) + 1 - kept.size
    assert noise_kinds(time[:100], reading[:100], y[:100], [u[:100]]) == ()


def test_every_kind_has_a_sentence_with_its_figures() -> None:
    items = []
    for kind in (*KINDS, "outliers"):
        kinds = kinds_in(KINDS[kind], fading, 4)
        items += [note_text(n) for n in notes_of([NoiseFound("loop", "displacement", "m", kinds)])]
    assert any("The clock of loop jitters by " in s and "own time stamps" in s for s in items)
    assert any("loop has 12 outliers" in s for s in items)
    assert all(s.endswith(".") and "loop" in s for s in items)


LEVEL = 1e-8
INTERVAL = 1e-3


def noise(samples: int, correlation: float, seed: int = 0) -> FloatArray:
    white = np.random.default_rng(seed).standard_normal(samples + 500)
    coloured: FloatArray = lfilter([np.sqrt(1 - correlation**2)], [1, -correlation], white)
    return LEVEL * coloured[500:]


def grid(samples: int) -> FloatArray:
    return INTERVAL * np.arange(samples, dtype=np.float64)


def record(voltage: FloatArray, displacement: FloatArray) -> Record:
    return Record(name="r", time=grid(voltage.size), voltage=voltage, displacement=displacement)


def sine(samples: int, period: float = 500.0) -> FloatArray:
    return np.asarray(50.0 * (1.0 - np.cos(2 * np.pi * np.arange(samples) / period)))


def loop_error(voltage: FloatArray) -> FloatArray:
    """Return an error thirty times the noise that every period repeats, branches apart."""
    return np.asarray(3e-7 * np.sin(voltage / 9.0) + 2e-7 * np.tanh(10.0 * np.gradient(voltage)))


@pytest.mark.parametrize("correlation", [0.0, 0.7])
@pytest.mark.parametrize("seed", range(4))
def test_periods_show_level_and_colour_next_to_a_large_repeated_error(
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
    since = INTERVAL * (np.arange(n) % step)
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
    residuals = [r.measured - y for r, (_, y) in zip(records, rows, strict=True)]
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
