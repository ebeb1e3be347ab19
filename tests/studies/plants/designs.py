"""Test voltages of other designs than the rich one: other rates, lengths, polarities and shapes.

All start at 0 V and are linear between samples; `bipolar` ones reach below zero.

Resonances lie within the band of `fast` and `sweep`: effects that are solved statically here are no
physics there.
"""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from tests.studies.plants.excitation import draw_block
from tests.studies.plants.stack import FloatArray

DesignKind = Literal[
    "fast", "bipolar", "short", "long", "sines", "sweep", "staircase", "small"
]  # fmt: skip
STAIRCASE_SAMPLES = 12_000
"""Most samples of a staircase."""

Wave = tuple[float, FloatArray]
"""Sampling rate [Hz] and voltage over the span (N,)."""


def draw_design(rng: np.random.Generator, kind: DesignKind) -> Wave:
    """Draw a record's sampling rate [Hz] and its voltage over the span (N,)."""
    return _SHAPES[kind](rng)


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


_SHAPES: dict[DesignKind, Callable[[np.random.Generator], Wave]] = {
    "fast": _fast,
    "bipolar": _bipolar,
    "short": _short,
    "long": _long,
    "sines": _sines,
    "sweep": _sweep,
    "staircase": _staircase,
    "small": _small,
}
