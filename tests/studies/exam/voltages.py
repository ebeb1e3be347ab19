"""Voltages that laboratories play, over fine times [V]."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests.studies.exam.record import Floats, Run


@dataclass(frozen=True)
class Window:
    """Fine times (M,) [s], lowest and highest voltage [V], frequency [Hz], random numbers."""

    times: Floats
    low: float
    high: float
    frequency: float
    rng: np.random.Generator

    @property
    def middle(self) -> float:
        """Middle voltage [V]."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> float:
        """Half the span [V]."""
        return (self.high - self.low) / 2

    @property
    def span(self) -> float:
        """Highest less lowest voltage [V]."""
        return self.high - self.low

    @property
    def share(self) -> Floats:
        """Times as shares of the length."""
        return np.asarray(self.times / self.times[-1])

    @property
    def sine(self) -> Floats:
        """A sine of the frequency, of amplitude 1."""
        return np.sin(2 * math.pi * self.frequency * self.times)

    def pieces(self, fewest: int) -> tuple[int, np.ndarray[tuple[int, ...], np.dtype[np.intp]]]:
        """Return the number of pieces, one for each period, and the piece of every time."""
        count = max(fewest, int(self.frequency * self.times[-1]))
        return count, np.minimum((self.share * count).astype(np.intp), count - 1)


def draw_voltage(run: Run) -> Floats:
    """Return the voltage of a record over its fine times."""
    test = run.record.test
    window = Window(run.times, *test.limits, test.frequency, run.record.draws(1))
    return np.asarray(VOLTAGES[test.voltage](window), dtype=np.float64)


def triangle(phase: Floats) -> Floats:
    """Return a triangle of amplitude 1, 0 and rising at phase 0."""
    return np.asarray(2 / math.pi * np.arcsin(np.sin(2 * math.pi * phase)))


def _triangles(w: Window) -> Floats:
    """Eight amplitudes in turn, from the lowest voltage."""
    cycle = np.floor(w.frequency * w.times).astype(np.intp) % 8
    sizes = np.take([1, 0.6, 0.8, 0.35, 1, 0.5, 0.9, 0.7], cycle)
    return w.low + w.span * sizes * (triangle(w.frequency * w.times - 0.25) + 1) / 2


def _stair(w: Window) -> Floats:
    """Levels held after short ramps: at random from the middle, or up and down from the lowest."""
    count, piece = w.pieces(4)
    if w.rng.random() < 0.5:
        levels = np.concatenate(([w.middle], w.rng.uniform(w.low, w.high, count)))
    else:
        up, down = np.linspace(0.2, 1, count // 2), np.linspace(0.85, 0.1, count - count // 2)
        levels = np.concatenate(([w.low], w.low + w.span * np.concatenate((up, down))))
    return _ramps(levels, w.share * count - piece, piece, 0.06)


def _ramps(
    levels: Floats,
    within: Floats,
    piece: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
    part: float,
) -> Floats:
    """Move from level to level in the first part of every piece."""
    return np.asarray(levels[piece] + np.diff(levels)[piece] * np.minimum(1, within / part))


def _multisine(w: Window) -> Floats:
    """25 harmonics of random phase; of falling amplitude where the voltage is slow."""
    orders = np.arange(1, 26)
    phases = w.rng.uniform(0, 2 * math.pi, orders.size)
    sizes = 1 / np.sqrt(orders) if w.frequency < 20 else np.ones(orders.size)
    angles = 2 * math.pi * np.outer(w.times, w.frequency * orders) + phases
    wave = (sizes * np.sin(angles)).sum(axis=1)
    wave -= wave[0]
    size = np.minimum(1, w.share / 0.02) / np.abs(wave).max()
    return np.asarray(w.middle + w.half * size * wave)


def _reversals(w: Window) -> Floats:
    """First-order reversal curves: from the top down to ever lower voltages and back."""
    count = max(4, int(w.frequency * w.times[-1]))
    started = w.share < 0.06
    share = (w.share - 0.06) / 0.94
    piece = np.clip((share * count).astype(np.intp), 0, count - 1)
    within = share * count - piece
    lowest = w.low + w.span * (0.9 - 0.85 * piece / count)
    curves = w.high + (lowest - w.high) * np.minimum(2 * within, 2 - 2 * within)
    return np.where(started, w.low + w.span * w.share / 0.06, curves)


def _swept_phase(w: Window, ratio: float) -> Floats:
    """Phase [rad] of a sine whose frequency rises exponentially by a ratio."""
    cycles = w.frequency * w.times[-1] / math.log(ratio) * (np.exp(w.share * math.log(ratio)) - 1)
    return np.asarray(2 * math.pi * cycles)


def _random_reversals(w: Window) -> Floats:
    """Straight lines between random voltages at random times."""
    count = max(8, int(w.frequency * w.times[-1]))
    turns = np.concatenate(([0], np.cumsum(w.rng.uniform(0.5, 1.5, count))))
    levels = w.rng.uniform(w.low, w.high, count + 1)
    levels[0] = w.middle
    return np.interp(w.share, turns / turns[-1], levels)


def _rates(w: Window) -> Floats:
    """The same triangle at 1, 6 and 36 times the frequency."""
    out, length = np.empty_like(w.times), w.times[-1]
    for begin, end, factor in ((0.0, 0.4, 1), (0.4, 0.7, 6), (0.7, 1.0001, 36)):
        part = (w.share >= begin) & (w.share < end)
        took = (end - begin) * length
        cycles = max(1, round(w.frequency * factor * took))
        phase = (w.share[part] - begin) * length * cycles / took - 0.25
        out[part] = w.middle + w.half * triangle(phase)
    return out


def _bursts(w: Window) -> Floats:
    """Four times a burst of the frequency, a rest and one slow period."""
    out, within = np.full_like(w.times, w.low), (w.share * 4) % 1.0
    fast, slow = within < 0.55, (within > 0.75) & (within < 0.95)
    took = 0.55 * w.times[-1] / 4
    cycles = round(w.frequency * took)
    place = within[fast] * w.times[-1] / 4
    out[fast] = w.middle - w.half * np.cos(2 * math.pi * cycles / took * place)
    out[slow] = w.low + w.span * (1 - np.cos(2 * math.pi * (within[slow] - 0.75) / 0.2)) / 2
    return out


def _steps(w: Window) -> Floats:
    """Six levels in turn, reached in 1.5 % of the time that they are held."""
    count, piece = w.pieces(4)
    heights = [w.high, w.low, w.middle, w.low + 0.2 * w.span, 0.3 * w.low + 0.7 * w.high, w.low]
    levels = np.concatenate(([w.low], np.tile(heights, 20)))[: count + 1]
    return _ramps(levels, w.share * count - piece, piece, 0.015)


VOLTAGES: dict[str, Callable[[Window], Floats]] = {
    "decaying sine": lambda w: w.middle + w.half * np.exp(-2.2 * w.share) * w.sine,
    "growing sine": lambda w: (
        w.middle + w.half * (0.15 + 0.85 * np.minimum(1, w.share * 1.1)) * w.sine
    ),
    "triangle": lambda w: w.middle + w.half * triangle(w.frequency * w.times - 0.25),
    "triangles": _triangles,
    "staircase": _stair,
    "multisine": _multisine,
    "reversal curves": _reversals,
    "sweep": lambda w: w.middle + 0.95 * w.half * np.sin(_swept_phase(w, 60)),
    "sweep from lowest": lambda w: w.middle - w.half * np.cos(_swept_phase(w, 40)),
    "random reversals": _random_reversals,
    "rates": _rates,
    "bursts": _bursts,
    "steps": _steps,
}
