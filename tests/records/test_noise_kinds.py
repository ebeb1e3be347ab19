"""Noises made in plain NumPy on a plant with hysteresis: each is called what it is, and white so.

A misfit of the hysteresis' form is no noise: it is never called 1/f, telegraph noise or steps.
"""

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from psa_casadi.common.units import FloatArray
from psa_casadi.records.noise_kinds import NoiseFound, NoiseKind, noise_kinds, notes_of
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
def test_jumps_are_seen_on_a_wander(noise: Noise) -> None:
    kind = noise.__name__.removeprefix("clear_")
    assert sum(kind in kinds for kinds in named_in_records(on_a_wander(noise))) >= 18


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


def test_readings_that_are_held_rounded_or_missing_are_told() -> None:
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
