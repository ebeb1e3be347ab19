"""A saturated sensor: readings that stay at the largest or smallest value while the stack moves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psa_casadi.records.noise import high_frequency_noise, last_place_of, runs_of
from psa_casadi.records.quality.stuck import LIMIT
from psa_casadi.units import FloatArray

BoolArray = NDArray[np.bool_]

#: Readings at an end of the range that are few enough for a turn, and samples of a run that counts.
FEWEST, LONGEST = 8, 3
#: The motion that a run hides must exceed this share of the range, and so often the noise.
HIDDEN = 0.02
#: How many times what the voltage does a reading may move to an end and be no jump there.
REACHED = 4.0


@dataclass(frozen=True, eq=False)
class FlatEnd:
    """An end of a sensor's range that readings stay at: its `value`, and where they do, (n,)."""

    value: float
    where: BoolArray
    upper: bool


def flat_ends(y: FloatArray, voltage: FloatArray) -> tuple[FlatEnd, ...]:
    """Return the ends of a signal's range (n,) where the sensor was saturated.

    There the signal has one value, to the last digit, while the voltage moves the stack by what
    other readings show: more than a turn does within the noise. It comes there as the stack moves;
    what jumps there is a drop-out. Of a signal whose digits hide its noise no end is told, because
    a drive that is saturated looks the same there.
    """
    span = float(np.ptp(y))
    at = {upper: np.abs(y - (y.max() if upper else y.min())) <= 1e-12 * span for upper in (0, 1)}
    inside = ~(at[0] | at[1])
    slope = _slope(y, voltage, inside)
    noise = high_frequency_noise(y[inside]) if inside.sum() >= FEWEST else 0.0
    if noise <= last_place_of(y):  # digits that are as coarse make a drive's flat top as flat
        return ()
    least = max(HIDDEN * span, LIMIT * noise)
    found = []
    for upper, where in at.items():
        if where.sum() < FEWEST:
            continue
        runs = [(a, b) for a, b in zip(*(e.tolist() for e in runs_of(where)), strict=True)]
        moved = slope * np.array(
            [float(np.ptp(voltage[a:b])) * (b - a >= LONGEST) for a, b in runs]
        )
        into = np.array([_jump(y, a) - REACHED * slope * _jump(voltage, a) for a, _ in runs])
        jumped = sum(b - a for (a, b), j in zip(runs, into, strict=True) if j > LIMIT * noise)
        if np.max(moved) > least and 2 * jumped < where.sum():
            found.append(FlatEnd(float(y[where][0]), where, bool(upper)))
    return tuple(found)


def _jump(signal: FloatArray, at: int) -> float:
    """Return the size of the step to a sample, 0 to the first one."""
    return abs(float(signal[at] - signal[at - 1])) if at > 0 else 0.0


def _slope(y: FloatArray, voltage: FloatArray, inside: BoolArray) -> float:
    """Return the size of the regression slope of the readings that are at neither end.

    Every run of them has its own centre: between two of them the stack was at its end and has come
    back on another branch.
    """
    if inside.sum() < FEWEST:
        inside = np.ones(y.size, dtype=np.bool_)
    power = product = 0.0
    for start, stop in zip(*(e.tolist() for e in runs_of(inside)), strict=True):
        v, x = (s[start:stop] - np.mean(s[start:stop]) for s in (voltage, y))
        power += float(v @ v)
        product += float(v @ x)
    return abs(product) / power if power > 0.0 else 0.0
