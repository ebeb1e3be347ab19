"""A residual under a periodic voltage, split into linear, even and odd parts and noise."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.records.quality.repetitions import Repetition, repetitions
from psa_casadi.records.record import Record

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

#: Fewest periods that are split.
PERIODS = 3
#: The excited lines hold this share of the voltage's power.
_EXCITED = 0.995
_SIGNIFICANT = 1e-5


@dataclass(frozen=True, eq=False)
class HarmonicSplit:
    """Power of a residual [m^2] by its place among the harmonics of the drive.

    `linear` lies at the excited lines, coherent with the voltage; `even` and `odd` at harmonics
    that are not excited; `noise` between the harmonics, what lies under them included.
    `fundamental` [Hz] is the drive's, `excited` the number of its lines.
    """

    fundamental: float
    periods: int
    excited: int
    linear: float
    even: float
    odd: float
    noise: float

    @property
    def repeats(self) -> float:
        """Power of all that repeats."""
        return self.linear + self.even + self.odd


def harmonic_split(record: Record, residual: FloatArray) -> HarmonicSplit | None:
    """Split a residual (n,) under a voltage of three periods or more, None under any other.

    The harmonics of a periodic voltage carry all that repeats: even nonlinearity at even, odd at
    odd harmonics; lines between them are noise. At an excited line the linear misfit and the
    coherent odd one cannot be separated by one record. Source: Pintelon and Schoukens, System
    Identification, 2nd ed., section 4.3.
    """
    run = _period(record)
    if run is None:
        return None
    periods = (run.stop + run.lag - run.start) // run.lag
    # the first period is left to transients where enough others remain
    periods -= periods > PERIODS
    stop = run.stop + run.lag
    part = slice(stop - periods * run.lag, stop)
    e, v = residual[part].reshape(periods, run.lag), record.voltage[part]
    if not np.isfinite(e).any(axis=0).all():
        return None
    amplitude = np.abs(np.fft.rfft(v - np.mean(v)))[::periods]
    excited = _excited(amplitude)
    base = int(np.gcd.reduce(np.flatnonzero(excited)))
    order = np.arange(amplitude.size)
    harmonic = (order % base == 0) & (order > 0)
    classes = {
        "linear": excited,
        "even": harmonic & ~excited & (order // base % 2 == 0),
        "odd": harmonic & ~excited & (order // base % 2 == 1),
    }
    line, between = _powers(_filled(e), periods)
    found = {name: _significant(line[c], between[c], periods) for name, c in classes.items()}
    total = float(np.sum(line[1:])) + float(np.sum(between[1:])) * (periods - 1)
    noise = max(total - sum(found.values()), 0.0)
    first = float(record.time[run.start + run.lag] - record.time[run.start])
    return HarmonicSplit(base / first, periods, int(excited.sum()), **found, noise=noise)


def _period(record: Record) -> Repetition | None:
    """Return the longest run of the shortest distance with three periods of the voltage in it."""
    runs = [r for r in repetitions(record) if r.stop - r.start >= (PERIODS - 1) * r.lag]
    if not runs:
        return None
    shortest = min(r.lag for r in runs)
    return max((r for r in runs if r.lag == shortest), key=lambda r: r.stop - r.start)


def _excited(amplitude: FloatArray) -> BoolArray:
    """Return the fewest lines that hold 99.5 % of the power, and those as strong as the last."""
    power = amplitude**2
    power[0] = 0.0
    order = np.argsort(-power)
    last = int(np.searchsorted(np.cumsum(power[order]), _EXCITED * float(np.sum(power))))
    strong: BoolArray = power >= 0.5 * power[order[min(last, order.size - 1)]]
    return strong


def _filled(e: FloatArray) -> FloatArray:
    """Return periods (periods, lag) without line and mean, missing samples from other periods."""
    there = np.isfinite(e)
    usual = np.nanmean(e, axis=0)
    whole = np.where(there, e, usual).ravel()
    # a line through the means of the periods does not touch what repeats
    middle = np.arange(e.shape[0]) - 0.5 * (e.shape[0] - 1)
    slope = float(middle @ np.mean(np.where(there, e, usual), axis=1) / (middle @ middle))
    place = (np.arange(whole.size) - 0.5 * (whole.size - 1)) / e.shape[1]
    flat: FloatArray = whole - np.mean(whole) - slope * place
    return flat


def _powers(e: FloatArray, periods: int) -> tuple[FloatArray, FloatArray]:
    """Return the power [m^2] of every harmonic, and the mean of the lines around each (lines,)."""
    power = 2.0 * np.abs(np.fft.rfft(e)) ** 2 / e.size**2
    lines = (power.size - 1) // periods + 1
    rows = np.zeros((lines + 1, periods))
    rows.ravel()[: power.size] = power[: rows.size]
    means = np.sum(rows[:, 1:], axis=1) / max(periods - 1, 1)
    before = np.r_[means[0], means[: lines - 1]]
    return rows[:lines, 0], 0.5 * (before + means[:lines])


def _significant(line: FloatArray, between: FloatArray, periods: int) -> float:
    """Return the power of some harmonics above the noise, 0 where noise could have made it."""
    noise = float(np.sum(between))
    if not line.size or not np.sum(line) > 0:
        return 0.0
    above = float(np.sum(line)) - noise
    if noise > 0:
        freedom = 4 * (periods - 1) * max(1, line.size // 2)
        p = float(scipy.special.fdtrc(2 * line.size, freedom, float(np.sum(line)) / noise))
        above = above if p < _SIGNIFICANT else 0.0
    return max(above, 0.0)
