"""Poorer test voltages beside the rich one: what users have. All start at rest at 0 V, lie between
0 and the span, and are linear between samples. Then the designs of `designs.py`.
"""

import math
from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from tests.studies.plants.designs import DesignKind, draw_design
from tests.studies.plants.excitation import (
    RATES_AND_SAMPLES,
    REST,
    VOLTAGE_DECIMALS,
    draw_voltage,
    loops,
    steps,
    triangle,
)
from tests.studies.plants.stack import FloatArray

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
        rate, wave = draw_design(rng, kind)
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


def _steps(rng: np.random.Generator, count: int) -> FloatArray:
    """Twenty levels, each held for 1 to 8 % of the record."""
    parts = np.array_split(np.arange(count), 4)
    return np.concatenate([steps(rng, part.size) for part in parts])


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


def _loops(rng: np.random.Generator, count: int) -> FloatArray:
    """Loops at three rates and three amplitudes, four times."""
    parts = np.array_split(np.arange(count), 4)
    return np.concatenate([loops(rng, part.size) for part in parts])


def _periods(rng: np.random.Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


_SHAPES: dict[str, Callable[[np.random.Generator, int], FloatArray]] = {
    "sine": _sine,
    "triangle": _triangle,
    "steps": _steps,
    "slow": _slow,
    "loops": _loops,
}
