"""Readings that are repeated although the stack moves: a stuck sensor, a drop-out."""

import numpy as np
import scipy
from numpy.typing import NDArray

from psa_casadi.records.noise import high_frequency_noise, runs_of
from psa_casadi.units import FloatArray

BoolArray = NDArray[np.bool_]

#: Samples that no spike exceeds, and standard deviations of its surroundings that make an outlier.
SPIKE, LIMIT = 3, 8.0
#: Samples before a sudden change of voltage or load in which the stack may move fast, and by which
#: share of what it may do at once it may still move so many samples after it.
BEFORE, AFTER = 4, ((1.0, 24), (0.25, 48), (0.03, 96))
#: Equal samples in a row that may be a sensor at rest, and the share of the range it missed.
EQUAL, MISSED = 8, 0.05
#: Share of fast changes of the voltage without a new reading from which on the stack is late.
LATE = 0.3
#: Runs of equal readings that chance may make where the voltage is fast, and that are none then.
CHANCE = 0.05
#: Share of readings that noise may repeat by chance, that a failing sensor repeats at most, and the
#: probability below which more of them are no chance.
BY_NOISE, RARELY, NO_CHANCE = 2e-3, 0.05, 1e-4
#: Least noise over the record's range, and least ratio of the fourth to the third differences: that
#: of white noise is 1.87, that of a motion below a fifth of the sampling rate at most 1.2.
NOISY, ROUGH = 1e-5, 1.3
#: Parts of a record's values, by size, in each of which its digits are told.
BANDS = 4


def equal_runs(
    y: FloatArray, voltage: FloatArray, quantum: float | None
) -> tuple[BoolArray, BoolArray]:
    """Return where one value is repeated as by a stuck sensor, and where as in a drop-out."""
    span, reach = float(np.ptp(y)), float(np.ptp(voltage))
    stuck, dropped = (np.zeros(y.size, dtype=np.bool_) for _ in range(2))
    edges = np.flatnonzero(~_repeated(y)) + 1
    starts, stops = np.r_[0, edges], np.r_[edges, y.size]
    lengths = stops - starts
    usual = float(np.percentile(lengths, 95))
    slope = span / reach if reach > 0 else 0.0
    swing = slope * np.abs(np.diff(voltage, prepend=voltage[0]))
    floor = max(20.0 * (quantum or 0.0), MISSED * span)
    for start, stop in zip(starts, stops, strict=True):
        if stop - start <= SPIKE:
            continue
        jumps = _jumps(y, start, stop)
        expected = slope * float(np.ptp(voltage[start:stop]))
        near = swing[max(0, start - AFTER[0][1]) : stop + BEFORE]
        off = min(jumps) > max(floor, 3.0 * float(np.max(near)))
        if off and _returns(y, start, stop, expected):
            dropped[start:stop] = True
        elif stop - start >= max(EQUAL, 4.0 * usual) and expected > floor:
            sudden = np.abs(jumps) > 0.5 * MISSED * span
            if sudden[0]:
                dropped[start:stop] = True
            elif sudden[1] or (usual <= 1.0 and quantum is None):
                stuck[start + 1 : stop] = True
    return stuck, dropped


def missed_a_move(y: FloatArray, voltage: FloatArray, quantum: float | None) -> BoolArray:
    """Return where a reading is repeated, however shortly, while the voltage moves the stack.

    The motion that the voltage's change makes must stand out from the noise, and at the end of the
    run the reading must make up for at least half of it at once; and runs of that length, from the
    share of readings that are repeated, must not be expected where the voltage is fast. Where that
    is how the record answers fast changes in general, the stack is late and no sensor stuck.
    """
    found = np.zeros(y.size, dtype=np.bool_)
    centred = voltage - np.mean(voltage)
    power = float(centred @ centred)
    slope = float(centred @ y) / power if power > 0 else 0.0
    least = LIMIT * max(high_frequency_noise(y), 0.5 * (quantum or 0.0))
    same = _repeated(y)
    fast = np.abs(slope * np.diff(voltage)) > least
    by_chance = float(np.mean(same)) ** np.arange(same.size + 1) * float(np.count_nonzero(fast))
    for start, stop in zip(*(ends.tolist() for ends in runs_of(same)), strict=True):
        # y[start] ... y[stop] are equal, y[stop + 1] is the first new one
        if stop + 1 >= y.size or by_chance[stop - start] > CHANCE:
            continue
        missed = slope * (voltage[stop] - voltage[start])
        made_up = (y[stop + 1] - y[stop]) * np.sign(missed)
        expected = abs(slope * (voltage[stop + 1] - voltage[start]))
        if abs(missed) > least and made_up > max(least, 0.5 * expected):
            found[start + 1 : stop + 1] = True
    late = fast.any() and float(np.mean(same[fast])) > LATE
    return np.zeros_like(found) if late else found


def repeated_in_noise(y: FloatArray, voltage: FloatArray, quantum: float | None) -> BoolArray:
    """Return where a reading is the last one to the last digit, which noise hardly ever makes.

    Two readings with noise of standard deviation s are alike to a digit d with a chance of
    d / (2 sqrt(pi) s). However slow or late the stack is, a sensor that repeats clearly more than
    that while the voltage changes does not measure; one that repeats often is read more slowly than
    it is sampled.
    """
    found = np.zeros(y.size, dtype=np.bool_)
    span, noise, same = float(np.ptp(y)), high_frequency_noise(y), _repeated(y)
    same &= np.diff(voltage) != 0.0
    chance = max(quantum or 0.0, _digit(y)) / (2.0 * np.sqrt(np.pi) * max(noise, 1e-300))
    if noise <= NOISY * span or not _rough(y) or not same.any():
        return found
    unlikely = scipy.special.pdtrc(int(same.sum()) - 1, chance * same.size) < NO_CHANCE
    if chance < BY_NOISE and unlikely and np.mean(same) < RARELY:
        found[1:] = same
    return found


def _digit(y: FloatArray) -> float:
    """Return the last digit of readings: the largest of what parts of them, by size, show."""
    parts = np.array_split(np.unique(np.abs(y)), BANDS)
    return max((float(np.min(np.diff(p))) for p in parts if p.size > 1), default=0.0)


def _rough(y: FloatArray) -> bool:
    """Whether the fast part of a signal is noise, not the bends of a smooth motion."""
    third, fourth = (float(np.median(np.abs(np.diff(y, k)))) for k in (3, 4))
    return fourth > ROUGH * third > 0.0


def _repeated(y: FloatArray) -> BoolArray:
    """Return which samples but the first repeat the one before, (n - 1,)."""
    return np.asarray(np.abs(np.diff(y)) <= 1e-12 * float(np.ptp(y)), dtype=np.bool_)


def _jumps(y: FloatArray, start: int, stop: int) -> tuple[float, float]:
    """Return the jumps into and out of a run, both positive where it is off to one side."""
    before = y[start] - y[start - 1] if start > 0 else 0.0
    after = y[stop - 1] - y[stop] if stop < y.size else 0.0
    sign = np.sign(before) or 1.0
    return float(sign * before), float(sign * after)


def _returns(y: FloatArray, start: int, stop: int, expected: float) -> bool:
    """Whether the values before and after a run agree, but for what the voltage explains."""
    into, out = _jumps(y, start, stop)
    return abs(into - out) < 0.5 * min(into, out) + 1.5 * expected
