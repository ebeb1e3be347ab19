"""Which records are steps and which are loops, told by their voltage."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

#: How far the voltage may stray from its two levels, and how long the rise may take of the hold.
_LEVEL, _RISE = 0.05, 0.05
#: A turning point stands out by this share of the voltage's range; turns come at even intervals.
_PROMINENCE, _EVEN = 0.05, 1.2
#: The mean over this last share of a step response stands for its steady state.
STEADY_SHARE = 0.05
#: At the start of a loop the voltage counts as its first value within this share of its range.
_AT_REST = 1e-3


@dataclass(frozen=True, eq=False)
class Step:
    """The normalised response to one jump of the voltage that is then held.

    `time` (n,) [s] begins at 0 in the middle of the jump, `g` (n,) is (x - x_0)/(x_s - x_0),
    `volts` the height of the jump [V], `rise` its duration [s], `k` = (x_s - x_0)/volts [m/V].
    """

    name: str
    time: FloatArray
    g: FloatArray
    volts: float
    rise: float
    k: float


@dataclass(frozen=True, eq=False)
class Loop:
    """A periodic voltage and its displacement on a uniform grid, both 0 at their first sample.

    `voltage` (n,) [V] and `displacement` (n,) [m] are counted from the first sample; `turns` are
    the samples at which the voltage turns, `frequency` [Hz] follows from them; `first_volts` [V]
    is the voltage at the first sample as recorded, `missing` counts samples that were bridged.
    """

    name: str
    sample_time: float
    voltage: FloatArray
    displacement: FloatArray
    turns: npt.NDArray[np.int64]
    frequency: float
    first_volts: float
    missing: int


def find_steps(records: Sequence[Record]) -> list[Step]:
    """Return the step responses among the records, the smallest jump first.

    A step has two levels of voltage and a rise between them that takes less than 5 % of the hold.
    """
    found = [s for r in records if (s := _step(r)) is not None]
    return sorted(found, key=lambda s: abs(s.volts))


def find_loops(records: Sequence[Record]) -> list[Loop]:
    """Return the records whose voltage goes up and down at even intervals, the slowest first."""
    found = [loop for r in records if (loop := _loop(r)) is not None]
    return sorted(found, key=lambda loop: loop.frequency)


def _step(record: Record) -> Step | None:
    t, v, x = record.time, record.voltage, measured(record)
    volts = float(np.median(v[record.n // 2 :]) - v[0])
    if abs(volts) < 0.5 * float(np.ptp(v)) or volts == 0.0:
        return None
    share = (v - v[0]) / volts
    high = np.flatnonzero(share > 1.0 - _LEVEL)
    last_low, first_high = int(np.flatnonzero(share < _LEVEL)[-1]), int(high[0])
    rise, hold = float(t[first_high] - t[last_low]), float(t[-1] - t[first_high])
    levels = np.concatenate([share[: last_low + 1], share[first_high:] - 1.0])
    if first_high < last_low or rise > _RISE * hold or np.max(np.abs(levels)) > _LEVEL:
        return None
    between = slice(last_low, first_high + 1)
    middle = t[last_low] + float(np.trapezoid(1.0 - share[between], t[between]))
    valid = record.mask
    before, after = valid & (t <= t[last_low]), valid & (t > middle)
    late = valid & (t > t[-1] - STEADY_SHARE * hold)
    if not before.any() or after.sum() < 20 or not late.any():
        return None
    x_0, x_s = float(np.mean(x[before])), float(np.mean(x[late]))
    if x_s == x_0:
        return None
    g = np.concatenate([[0.0], (x[after] - x_0) / (x_s - x_0)])
    time = np.concatenate([[0.0], t[after] - middle])
    return Step(record.name, time, g, volts, rise, (x_s - x_0) / volts)


def _loop(record: Record) -> Loop | None:
    valid, step = record.mask, record.sample_time
    if valid.sum() < 20:
        return None
    t = np.arange(record.time[0], record.time[-1] + 0.5 * step, step)
    v = np.interp(t, record.time, record.voltage)
    x = np.interp(t, record.time[valid], measured(record)[valid])
    turns = _turns(v)
    half = _half_period(turns, len(v))
    if half is None:
        return None
    moved = np.abs(v - v[0]) > _AT_REST * float(np.ptp(v))
    resting = max(1, int(np.argmax(moved)))
    return Loop(
        name=record.name,
        sample_time=step,
        voltage=v - v[0],
        displacement=x - float(np.mean(x[:resting])),
        turns=turns,
        frequency=1.0 / (2.0 * half * step),
        first_volts=float(v[0]),
        missing=int(record.n - valid.sum()),
    )


def _turns(voltage: FloatArray) -> npt.NDArray[np.int64]:
    """Return the samples at which the voltage turns, those at its ends excepted."""
    prominence = _PROMINENCE * float(np.ptp(voltage))
    peaks = [
        scipy.signal.find_peaks(sign * voltage, prominence=prominence)[0] for sign in (1.0, -1.0)
    ]
    return np.sort(np.concatenate(peaks)).astype(np.int64)


def _half_period(turns: npt.NDArray[np.int64], samples: int) -> float | None:
    """Return the samples between turns, None where the turns are not even or there are none."""
    if turns.size == 0:
        return None
    spacing = np.diff(turns)
    ends = np.array([turns[0], samples - 1 - turns[-1]])
    if spacing.size == 0:
        spacing = ends
    half = float(np.median(spacing))
    even = spacing.max() <= _EVEN * spacing.min() and ends.max() <= _EVEN * half
    return half if even else None
