"""Spikes in motions that no line follows, and motions that have kinks and jumps themselves."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter

from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.records.suspects import spikes_in

N, DT = 3000, 1e-3
T = DT * np.arange(N, dtype=np.float64)
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
    u = np.cos(2.0 * np.pi * np.outer(T, f) + rng.uniform(0.0, 6.28, f.size)).sum(axis=1)
    return u, driven(u, 60.0, 0.05)


def held_steps(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """What jumps with its input, and decays: a current after steps of the voltage."""
    u = np.repeat(rng.choice([0.0, 1.0, 2.0], N // 100), 100)
    return u, u - np.asarray(lfilter([0.2], [1.0, -0.8], u))


def slow(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    u = np.sin(2.0 * np.pi * 2.0 * T) + 0.3 * np.sin(2.0 * np.pi * 7.3 * T)
    return u, driven(u, 3.0, 0.7)


def bounces(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Impacts that no input shows."""
    y = np.abs(np.sin(2.0 * np.pi * 1.7 * T)) * np.exp(-0.3 * T)
    return np.zeros(N), y


MOTIONS = (resonance, tones, held_steps, slow, bounces)


def spikes_of(u: FloatArray, y: FloatArray) -> BoolArray:
    return spikes_in(y, u[:, None], 8.0, 1e-3 * float(np.ptp(y)), 3)


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("motion", MOTIONS)
def test_spikes_are_found_and_nothing_else(motion: Motion, noise: float) -> None:
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
def test_a_spike_of_two_or_three_samples_is_found_and_a_step_is_none(width: int) -> None:
    rng = np.random.default_rng(1)
    u, y = slow(rng)
    y = y + 1e-3 * np.ptp(y) * rng.standard_normal(N)
    y[500 : 500 + width] += 0.2 * np.ptp(y)
    assert np.flatnonzero(spikes_of(u, y)).tolist() == [*range(500, 500 + width)]
    y[500:] += 0.2 * np.ptp(y)
    y[500 : 500 + width] -= 0.2 * np.ptp(y)
    assert not spikes_of(u, y)[505:].any()


def test_missing_samples_few_samples_and_what_stands_still_have_no_spikes() -> None:
    rng = np.random.default_rng(1)
    u, y = tones(rng)
    y[rng.choice(N, 100, replace=False)] = np.nan
    assert not spikes_of(u, y).any()
    assert not spikes_in(y[:50], u[:50, None], 8.0, 0.0, 3).any()
    assert not spikes_in(np.full(N, np.nan), u[:, None], 8.0, 0.0, 3).any()
    assert not spikes_in(np.ones(N), np.zeros((N, 0)), 8.0, 0.0, 3).any()
