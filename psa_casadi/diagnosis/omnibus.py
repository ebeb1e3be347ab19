"""Tests of a residual for what is not noise: correlation, a line, the drive, a changing size."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import Colour

#: Neighbours correlate, the spectrum has a line, the residual or its size follows the drive, or
#: the residual what some effect would add.
Structure = Literal["correlation", "line", "drive", "size", "effect"]

_LAGS = 25
#: Factor on the p-value of the correlation where the colour is that of the residual.
_LEFT = 100.0
#: Squares of the residual over their mean that count at most.
_MOST = 9.0


@dataclass(frozen=True)
class Omnibus:
    """Probability of the residual under noise alone, and the deciding test.

    `structure` is what that test finds, `output` the one of several whose residual it is. `excess`
    is the share of the residual's power above the noise; `size` [m] the rms of what the test finds,
    `detection_limit` [m] the rms below which nothing of a stack counts, `alarms_below` the
    probability from which on the test does not alarm.
    """

    p_value: float
    excess: float
    structure: Structure
    size: float
    detection_limit: float
    alarms_below: float
    output: str = ""

    @property
    def alarm(self) -> bool:
        """Whether something besides noise is in the residual, above the detection limit."""
        return self.p_value < self.alarms_below and self.size > self.detection_limit

    @property
    def finding(self) -> Note:
        """What is in the residual besides noise, where the test alarms."""
        return note("structure", seen=self.structure, output=self.output, excess=self.excess)


def omnibus(
    residual: FloatArray,
    voltage: FloatArray,
    time: FloatArray,
    colour: Colour,
    floor: float,
    *,
    lengths: Sequence[int],
    detection_limit: float,
    own: bool,
    alarms_below: float,
) -> Omnibus:
    """Test a residual (samples,) [m] for structure that noise of this colour does not have.

    Four tests with Bonferroni's correction: are neighbours of the whitened residual correlated;
    Fisher's g for a line in its spectrum; an F test on general features of the voltage and time;
    and is its size the same everywhere? A sensor's noise is, what a colour may have swallowed of a
    misfit is not. With `own` the colour is the residual's: its jitter covers the size, and its
    order leaves some correlation that Schwarz's criterion does not pay for. `excess` is the share
    of the residual's power above the noise `floor` [m]; structure must be larger than
    `detection_limit` [m] to count; `lengths` are the records' numbers of samples.
    """
    white = colour.whiten(residual)
    p, share = whiteness(white)
    tests: dict[Structure, tuple[float, float]] = {
        "correlation": (min(1.0, _LEFT * p) if own else p, share),
        "line": _fisher_line(white),
        "drive": _features(white, voltage, time, colour),
    }
    if not own:
        tests["size"] = _sizes(white, voltage, time, lengths)
    structure, (p, share) = min(tests.items(), key=lambda item: item[1][0])
    power = float(np.mean(residual**2))
    size = float(np.sqrt(share * power))
    excess = max(0.0, 1.0 - floor**2 / power) if power > 0 else 0.0
    p = min(1.0, len(tests) * p)
    return Omnibus(p, excess, structure, size, detection_limit, alarms_below)


def whiteness(white: FloatArray) -> tuple[float, float]:
    """Return the p-value that neighbours are not correlated, and the largest correlation.

    What is correlated has that share. Box and Pierce's test with the variance that each product
    has by itself: noise whose size changes is not correlated (Lobato, Nankervis and Savin,
    International Economic Review 42 (2001) 187).
    """
    n = len(white)
    centred = white - np.mean(white)
    power = float(centred @ centred)
    if power <= 0 or n <= 2 * _LAGS:
        return 1.0, 0.0
    pairs = [(centred[k:], centred[:-k]) for k in range(1, _LAGS + 1)]
    sums = np.array([a @ b for a, b in pairs])
    spread = np.array([a**2 @ b**2 for a, b in pairs])
    statistic = float(np.sum(sums**2 / np.maximum(spread, 1e-300)))
    share = float(np.max(np.abs(sums))) / power
    return float(scipy.special.chdtrc(_LAGS, statistic)), share


def _fisher_line(white: FloatArray) -> tuple[float, float]:
    """Return the p-value of the strongest line, and its share of the power."""
    power = np.abs(np.fft.rfft(white - np.mean(white))[1:-1]) ** 2
    count = len(power)
    if count < 8 or not np.sum(power) > 0:
        return 1.0, 0.0
    share = float(np.max(power) / np.sum(power))
    return float(min(1.0, count * (1.0 - share) ** (count - 1))), share


def _features(
    white: FloatArray, voltage: FloatArray, time: FloatArray, colour: Colour
) -> tuple[float, float]:
    """F test of the residual on u, u^2, u^3, sgn(u'), |u'|, u sgn(u'), a trend and slow waves."""
    u, rate, turn, t = _drive(voltage, time)
    columns = [np.ones_like(u), u, u**2, u**3, turn, np.abs(rate), u * turn, u**2 * turn, t, t**2]
    columns += [f(np.pi * k * t) for k in (1, 2, 3) for f in (np.sin, np.cos)]
    x = colour.whiten(np.column_stack(columns))
    return _f_test(x, white)


def _sizes(
    white: FloatArray, voltage: FloatArray, time: FloatArray, records: Sequence[int]
) -> tuple[float, float]:
    """F test of the squares on voltage, rate, time and way since the last reversal.

    Breusch and Pagan, Econometrica 47 (1979) 1287, with Koenker's correction; squares are over
    their mean in each record, and those above `_MOST` count as that.
    """
    lengths = [n for n in records if n]
    parts = np.split(white, np.cumsum(lengths)[:-1])
    powers = np.array([np.mean(part**2) for part in parts])
    if not np.all(powers > 0):
        return 1.0, 0.0
    u, rate, turn, t = _drive(voltage, time)
    speed = np.abs(rate) / (float(np.max(np.abs(rate))) or 1.0)
    way, age = _since_reversal(u, turn)
    columns = [u, u**2, speed, np.sqrt(speed), way, np.exp(-20.0 * way), np.exp(-0.1 * age), t]
    x = np.column_stack([*columns, t**2])
    squares = np.minimum(white**2 / np.repeat(powers, lengths), _MOST)
    return _f_test(x - np.mean(x, axis=0), squares - np.mean(squares))


def _drive(
    voltage: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return voltage about its mean over its range, its rate, direction, and the time in 0 to 1."""
    u = (voltage - np.mean(voltage)) / (np.ptp(voltage) or 1.0)
    rate = np.gradient(u)
    turn = np.sign(rate) * (np.abs(rate) > 1e-3 * np.max(np.abs(rate)))
    return u, rate, turn, (time - time[0]) / ((time[-1] - time[0]) or 1.0)


def _since_reversal(u: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance |u - u_r| from the last reversal and the samples since it."""
    index = np.arange(len(u))
    moving = np.flatnonzero(turn)
    reversed_at = moving[1:][turn[moving[1:]] != turn[moving[:-1]]]
    last = np.zeros(len(u), dtype=np.int64)
    last[reversed_at] = reversed_at
    last = np.maximum.accumulate(last)
    return np.abs(u - u[last]), (index - last).astype(np.float64)


def _f_test(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the p-value that columns x (n, k) explain nothing of y (n,), and their share of it."""
    coefficients, _, rank, _ = np.linalg.lstsq(x, y, rcond=None)
    explained = float(np.sum((x @ coefficients) ** 2))
    rest = float(y @ y) - explained
    freedom = len(y) - rank
    if rest <= 0 or freedom <= 0:
        return 1.0, 0.0
    p = float(scipy.special.fdtrc(rank, freedom, explained / rank / (rest / freedom)))
    return p, explained / (explained + rest)
