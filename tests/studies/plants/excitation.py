"""Rich test voltages: every class of signal in every quarter of the record, random from a seed.

A record has a short rest at 0 V and four blocks. Each block holds, in random order, a random-phase
multisine, steps of different sizes with holds, a decaying triangle, and loops at three rates and
three amplitudes. The second and the fourth block also hold one level for more than a second (first
thing in the fourth, so that a held-out last quarter sees it). All voltages lie between 0 and the
span; they are linear between samples, so a step is a ramp of one sample.
"""

import math

import numpy as np

from tests.studies.plants.stack import FloatArray

RATES_AND_SAMPLES = ((500.0, 4000), (625.0, 4600), (800.0, 5200), (1000.0, 6000))
"""Sampling rate [Hz] and the least number of samples at that rate (the most is 6000)."""
REST = 0.04
"""Rest at 0 V before the first block [s]."""
VOLTAGE_DECIMALS = 3


def draw_voltage(rng: np.random.Generator, span: float) -> tuple[FloatArray, FloatArray]:
    """Draw a record's times (N,) [s] and commands (N,) [V], 0 to `span`, rounded to 1 mV."""
    rate, least = RATES_AND_SAMPLES[int(rng.integers(len(RATES_AND_SAMPLES)))]
    count = int(rng.integers(least, 6001))
    rest = round(REST * rate)
    hold = round(float(rng.uniform(1.0, 1.25)) * rate)
    block = (count - rest - 2 * hold) // 4
    pieces = [np.zeros(count - 4 * block - 2 * hold)]
    for number in range(4):
        classes = draw_block(rng, block, rate)
        if number in (1, 3):
            place = 0 if number == 3 else int(rng.integers(len(classes) + 1))
            classes.insert(place, np.full(hold, _level(rng)))
        pieces.extend(classes)
    voltage = np.round(span * np.concatenate(pieces), VOLTAGE_DECIMALS)
    return np.arange(voltage.size) / rate, voltage


def draw_block(rng: np.random.Generator, count: int, rate: float) -> list[FloatArray]:
    """One block: a multisine, a decaying triangle, loops and steps, in random order."""
    lengths = [int(0.27 * count), int(0.2 * count), int(0.33 * count)]
    signals = [
        multisine(rng, lengths[0], rate),
        decaying_triangle(rng, lengths[1]),
        loops(rng, lengths[2]),
        steps(rng, count - sum(lengths)),
    ]
    return [signals[int(index)] for index in rng.permutation(len(signals))]


def multisine(rng: np.random.Generator, count: int, rate: float) -> FloatArray:
    """Random-phase multisine within (0, 1): about 20 frequencies, log-spaced from one period to 0.2
    of the rate.
    """
    highest = 0.2 * count
    harmonics = np.unique(np.round(np.geomspace(1.0, highest, 24)))
    phase = rng.uniform(0.0, 2.0 * math.pi, harmonics.size)
    amplitude = harmonics**-0.6
    angle = 2.0 * math.pi * harmonics[:, None] * np.arange(count)[None, :] / count
    wave = amplitude @ np.sin(angle + phase[:, None])
    low, high = float(rng.uniform(0.0, 0.15)), float(rng.uniform(0.75, 1.0))
    unit = (wave - wave.min()) / (wave.max() - wave.min())
    return np.asarray(low + (high - low) * unit)


def steps(rng: np.random.Generator, count: int) -> FloatArray:
    """Levels within (0, 1), each held for a different time; neighbours differ by at least 0.15."""
    levels = [_level(rng)]
    while len(levels) < 5:
        level = float(rng.uniform(0.0, 1.0))
        if abs(level - levels[-1]) > 0.15:
            levels.append(level)
    share = rng.uniform(0.4, 1.6, len(levels))
    ends = np.round(np.cumsum(share) / share.sum() * count).astype(int)
    lengths = np.diff(np.concatenate(([0], ends)))
    return np.repeat(np.asarray(levels), lengths)


def decaying_triangle(rng: np.random.Generator, count: int) -> FloatArray:
    """Triangle within (0, 1) whose amplitude falls linearly to a tenth: nested loops about one
    centre.
    """
    cycles = int(rng.integers(4, 7))
    centre = float(rng.uniform(0.45, 0.55))
    phase = cycles * np.arange(count) / count
    envelope = np.linspace(float(rng.uniform(0.38, 0.45)), 0.04, count)
    return np.asarray(centre + envelope * triangle(phase))


def loops(rng: np.random.Generator, count: int) -> FloatArray:
    """Loops at three rates and amplitudes: one slow, two medium and three fast cycles."""
    lengths = [count - int(0.3 * count) - int(0.2 * count), int(0.3 * count), int(0.2 * count)]
    amplitudes = rng.permutation(
        [0.45, float(rng.uniform(0.15, 0.3)), float(rng.uniform(0.3, 0.48))]
    )
    pieces: list[FloatArray] = []
    for cycles, length, amplitude in zip((1, 2, 3), lengths, amplitudes, strict=True):
        phase = cycles * np.arange(length) / length
        sine = bool(rng.integers(2))
        wave = -np.cos(2.0 * math.pi * phase) if sine else triangle(phase - 0.25)
        centre = float(rng.uniform(amplitude, 1.0 - amplitude))
        pieces.append(np.asarray(centre + amplitude * wave))
    order = rng.permutation(len(pieces))
    return np.concatenate([pieces[int(index)] for index in order])


def triangle(phase: FloatArray) -> FloatArray:
    """Triangle of amplitude 1 and period 1 in phase, 0 and rising at phase 0."""
    return np.asarray(1.0 - 4.0 * np.abs(np.mod(phase + 0.25, 1.0) - 0.5))


def _level(rng: np.random.Generator) -> float:
    """A level away from the middle, so that coming to it is a large step more often than not."""
    return float(rng.uniform(0.6, 1.0) if rng.integers(2) else rng.uniform(0.05, 0.4))
