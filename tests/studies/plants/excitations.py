"""Test voltages, random from a seed; all start at rest at 0 V and are linear between samples.

Rich: a short rest and four blocks. Each block holds, in random order, a random-phase multisine,
steps of different sizes with holds, a decaying triangle, and loops at three rates and three
amplitudes. The second and the fourth block also hold one level for more than a second (first thing
in the fourth, so that a held-out last quarter sees it). Poor: what users have, one shape. Both lie
between 0 and the span. Designs: other rates, lengths, polarities and shapes; `bipolar` ones reach
below zero, and resonances lie within the band of `fast` and `sweep`: effects that are solved
statically here are no physics there.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Literal, get_args

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


DesignKind = Literal[
    "fast", "bipolar", "short", "long", "sines", "sweep", "staircase", "small"
]  # fmt: skip
STAIRCASE_SAMPLES = 12_000
"""Most samples of a staircase."""

Wave = tuple[float, FloatArray]
"""Sampling rate [Hz] and voltage over the span (N,)."""
Shape = Callable[[np.random.Generator, int], FloatArray]
"""A voltage over the span with a number of samples."""


def _blocks(
    rng: np.random.Generator, rates: tuple[float, ...], samples: tuple[int, int],
    blocks: int, rest: int,
) -> Wave:  # fmt: skip
    """A rest at 0 V, then the rich record's blocks without its long holds."""
    rate = float(rng.choice(rates))
    count = (int(rng.integers(*samples)) - rest) // blocks
    parts = [part for _ in range(blocks) for part in draw_block(rng, count, rate)]
    return rate, np.concatenate([np.zeros(rest), *parts])


def _fast(rng: np.random.Generator) -> Wave:
    """Tenths of a second at 10 to 50 kHz."""
    return _blocks(rng, (10e3, 20e3, 50e3), (3000, 8000), 3, 100)


def _bipolar(rng: np.random.Generator) -> Wave:
    """Levels from 15 to 100 % of the span below zero up to the span."""
    rate, wave = _blocks(rng, (1e3, 2e3), (3000, 6000), 3, 0)
    low = -float(rng.uniform(0.15, 1.0))
    return rate, np.concatenate([np.zeros(60), low + (1.0 - low) * wave])


def _short(rng: np.random.Generator) -> Wave:
    """About a thousand samples."""
    return _blocks(rng, (500.0, 1000.0, 2000.0), (800, 1500), 2, 30)


def _long(rng: np.random.Generator) -> Wave:
    """About twenty thousand samples."""
    return _blocks(rng, (1e3, 2e3), (15_000, 25_000), 4, 100)


def _sines(rng: np.random.Generator) -> Wave:
    """One amplitude at seven frequencies, two periods of each or a second."""
    frequencies, rate = rng.permutation([0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0]), 1000.0
    amplitude, parts = 0.5 * float(rng.uniform(0.6, 1.0)), [np.zeros(50)]
    for frequency in frequencies.tolist():
        time = np.arange(int(max(1.0, 2.0 / frequency) * rate)) / rate
        parts.append(amplitude * (1.0 - np.cos(2.0 * math.pi * frequency * time)))
    return rate, np.concatenate(parts)


def _sweep(rng: np.random.Generator) -> Wave:
    """One logarithmic sweep from 1 Hz to 1.5 kHz about half the span."""
    rate, low, high = 5000.0, 1.0, 1500.0
    time = np.arange(int(rng.integers(6000, 12_000))) / rate
    growth = math.log(high / low) / (time.size / rate)
    phase = 2.0 * math.pi * low * np.expm1(growth * time) / growth
    amplitude = float(rng.uniform(0.1, 0.45))
    wave = np.minimum(1.0, time / 0.1) * (0.5 + amplitude * np.sin(phase))
    return rate, np.concatenate([np.zeros(20), wave])


def _staircase(rng: np.random.Generator) -> Wave:
    """Levels up and down, held for 5 to 20 s each, at 20 to 100 Hz."""
    rate = float(rng.choice([20.0, 50.0, 100.0]))
    levels = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 0.8, 0.6, 0.4, 0.2, 0.0, 0.5, 1.0, 0.0]
    held = int(float(rng.uniform(5.0, 20.0)) * rate)
    return rate, np.repeat(levels, held)[:STAIRCASE_SAMPLES]


def _small(rng: np.random.Generator) -> Wave:
    """The rich record's blocks within 10 to 40 % of the span."""
    rate, wave = _blocks(rng, (1000.0,), (4000, 6000), 4, 60)
    return rate, float(rng.uniform(0.1, 0.4)) * wave


_DESIGNED: dict[DesignKind, Callable[[np.random.Generator], Wave]] = {
    "fast": _fast,
    "bipolar": _bipolar,
    "short": _short,
    "long": _long,
    "sines": _sines,
    "sweep": _sweep,
    "staircase": _staircase,
    "small": _small,
}


PoorKind = Literal["sine", "triangle", "steps", "slow", "loops"]
ExcitationKind = Literal["rich"] | PoorKind | DesignKind
DESIGNS: tuple[DesignKind, ...] = get_args(DesignKind)
EXCITATIONS: tuple[ExcitationKind, ...] = ("rich", *get_args(PoorKind), *DESIGNS)
SLOW_RATE = 10.0
"""Sampling rate of the slow record [Hz], which lasts 5 to 8 minutes."""


def draw_excitation(
    rng: np.random.Generator, kind: ExcitationKind, span: float
) -> tuple[FloatArray, FloatArray]:
    """Draw a record's times (N,) [s] and commands (N,) [V], rounded to 1 mV."""
    if kind == "rich":
        return draw_voltage(rng, span)
    if kind in DESIGNS:
        rate, wave = _DESIGNED[kind](rng)
        return np.arange(wave.size) / rate, _played(span, wave)
    rate, least = RATES_AND_SAMPLES[int(rng.integers(len(RATES_AND_SAMPLES)))]
    count = int(rng.integers(least, 6001))
    if kind == "slow":
        rate, count = SLOW_RATE, int(rng.integers(3000, 4801))
    rest = max(2, round(REST * rate))
    wave = _SHAPES[kind](rng, count - rest)
    return np.arange(count) / rate, _played(span, np.concatenate((np.zeros(rest), wave)))


def _played(span: float, wave: FloatArray) -> FloatArray:
    """The command of a wave over the span, rounded to 1 mV but not beyond the span."""
    highest = math.floor(span * 10**VOLTAGE_DECIMALS) / 10**VOLTAGE_DECIMALS
    return np.asarray(np.minimum(np.round(span * wave, VOLTAGE_DECIMALS), highest))


def _sine(rng: np.random.Generator, count: int) -> FloatArray:
    """One amplitude and one frequency, 6 to 120 periods in the record."""
    phase = _periods(rng, 6.0, 120.0) * np.arange(count) / count
    return float(rng.uniform(0.6, 1.0)) * 0.5 * (1.0 - np.cos(2.0 * math.pi * phase))


def _triangle(rng: np.random.Generator, count: int) -> FloatArray:
    """One amplitude and one frequency, 6 to 60 periods in the record."""
    phase = _periods(rng, 6.0, 60.0) * np.arange(count) / count
    return float(rng.uniform(0.6, 1.0)) * 0.5 * (1.0 + triangle(phase - 0.25))


def _slow(rng: np.random.Generator, count: int) -> FloatArray:
    """Triangles of three amplitudes, one to two minutes a period, then levels held for half a
    minute.
    """
    held = count // 3
    sizes = rng.permutation([1.0, float(rng.uniform(0.5, 0.8)), float(rng.uniform(0.25, 0.5))])
    parts = np.array_split(np.arange(count - held), 3)
    waves = [
        size * 0.5 * (1.0 + triangle(np.arange(part.size) / part.size - 0.25))
        for size, part in zip(sizes.tolist(), parts, strict=True)
    ]
    return np.concatenate([*waves, steps(rng, held // 2), steps(rng, held - held // 2)])


def _four_times(shape: Shape, rng: np.random.Generator, count: int) -> FloatArray:
    """Twenty levels, or loops at three rates and three amplitudes, four times."""
    parts = np.array_split(np.arange(count), 4)
    return np.concatenate([shape(rng, part.size) for part in parts])


def _periods(rng: np.random.Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


_SHAPES: dict[str, Shape] = {
    "sine": _sine,
    "triangle": _triangle,
    "steps": partial(_four_times, steps),
    "slow": _slow,
    "loops": partial(_four_times, loops),
}
