"""The coordinates that a residual is viewed along: time, voltage, rate, history, drive."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.diagnosis.residual.views import COARSE, FINE, Axis
from psa_casadi.records.quality.fast_noise import fast_noise
from psa_casadi.records.quality.repetitions import held
from psa_casadi.records.record import Record
from psa_casadi.records.turns import reversals

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.int64]

#: The voltage turns where it returns by this share of its range, or by so much of its noise.
_TURN, _NOISES = 1e-4, 8.0
#: The noise of a rate is brought below this share of the mean rate.
_QUIET = 0.05
#: Frequencies are told apart from this step of their decimal logarithm on.
_STEP = 0.02


@dataclass(frozen=True, eq=False)
class Drive:
    """A voltage's turning samples `turns` (k,) and its smoothed rate (n,) [V/s]."""

    turns: IndexArray
    rate: FloatArray


def axes(record: Record, predicted: FloatArray, drive: Drive) -> tuple[Axis, ...]:
    """Return the axes of a record; `predicted` (n,) [m] stands for the displacement, without noise.

    Against the measured displacement a residual would follow its own noise. Errors of gain and lag
    change sign twice a period: they show if they count along the voltage's deviation or motion.
    """
    t, v = record.time - record.time[0], record.voltage
    h = _history(t, v, drive.turns)
    length = record.displacement_unit
    rows = (
        ("voltage", "V", v, None),
        ("displacement", length, predicted, None),
        ("rate", "V/s", drive.rate, None),
        ("since_reversal", "s", h.since, None),
        ("since_reversal_lag", "s", h.since, h.motion),
        ("from_reversal", "V", h.distance, None),
        ("amplitude", "V", h.swing, None),
        ("amplitude_gain", "V", h.swing, h.side),
        ("amplitude_lag", "V", h.swing, h.motion),
        ("frequency", "Hz", h.frequency, None),
        ("frequency_gain", "Hz", h.frequency, h.side),
        ("frequency_lag", "Hz", h.frequency, h.motion),
    )
    return tuple(
        Axis(name, unit, x, log=x is h.since,
             blocks=FINE if name.startswith(("ampl", "freq")) else COARSE, sign=sign)
        for name, unit, x, sign in rows
    )  # fmt: skip


def time_axis(record: Record) -> Axis:
    """Return the time since the record began."""
    t = record.time - record.time[0]
    return Axis("time", "s", t, blocks=FINE)


def hold_axis(record: Record) -> tuple[Axis, int]:
    """Return lg of the time since a hold began, the residual signed by the change before it.

    With it comes the number of holds; holds without a change before them do not count unless there
    are no others.
    """
    since, sign = np.full(record.n, np.nan), np.zeros(record.n)
    spans, step = held(record), record.sample_time
    for start, stop in spans:
        before = record.voltage[max(0, start - 8)]
        change = float(np.sign(np.mean(record.voltage[start:stop]) - before)) if start else 0.0
        since[start:stop] = record.time[start:stop] - record.time[start] + step
        sign[start:stop] = change
    count = len({a for a, _ in spans if sign[a] != 0})
    if not count:
        sign, count = np.isfinite(since).astype(np.float64), len(spans)
    return Axis("holds", "s", since, log=True, blocks=FINE, sign=sign), count


def drive_of(record: Record) -> Drive:
    """Return turning samples and rate of the voltage, both blind to the voltage's own noise.

    The rate is the slope of a running mean, as long as it takes to bring the rate's noise below
    5 % of its mean size.
    """
    v, n = record.voltage, record.n
    span, noise = float(np.ptp(v)), fast_noise(v)
    turns = reversals(v, max(_TURN * span, _NOISES * noise))
    stops = np.r_[0, turns, n - 1]
    mean_rate = float(np.sum(np.abs(np.diff(v[stops])))) / max(record.duration, 1e-300)
    wanted = _QUIET * mean_rate * record.sample_time
    ratio = 1.4142 * noise / wanted if wanted > 0 else 0.0
    width = int(np.clip(np.ceil(ratio ** (2.0 / 3.0)), 1, max(1, n // 100)))
    smooth = scipy.ndimage.uniform_filter1d(v, width, mode="nearest") if width > 1 else v
    half = max(1, width // 2)
    k = np.arange(n)
    low, high = np.maximum(k - half, 0), np.minimum(k + half, n - 1)
    return Drive(turns, (smooth[high] - smooth[low]) / (record.time[high] - record.time[low]))


@dataclass(frozen=True, eq=False)
class _History:
    """What the voltage did, arrays (n,).

    Since the last reversal: time [s] and voltage [V]. Of the half-wave: peak to peak [V], frequency
    [Hz], the sign of its motion and of the voltage above its middle.
    """

    since: FloatArray
    distance: FloatArray
    swing: FloatArray
    frequency: FloatArray
    motion: FloatArray
    side: FloatArray


def _history(t: FloatArray, v: FloatArray, turns: IndexArray) -> _History:
    """Return what the voltage did since its last reversal, nan or sign 0 where it had none."""
    since, distance, swing, frequency = (np.full(t.size, np.nan) for _ in range(4))
    motion, side = np.zeros(t.size), np.zeros(t.size)
    if turns.size:
        after = slice(turns[0], t.size)
        lengths = np.diff(np.r_[turns, t.size])
        last = np.repeat(turns, lengths)
        since[after] = np.maximum(t[after] - t[last], 0.5 * float(np.median(np.diff(t))))
        distance[after] = v[after] - v[last]
        between = slice(turns[0], turns[-1])
        change = np.diff(v[turns])
        swing[between] = np.repeat(np.abs(change), lengths[:-1])
        # steps of 5 %, so that one frequency is one whatever the sampling makes of its turns
        half = np.round(np.log10(0.5 / np.diff(t[turns])) / _STEP) * _STEP
        frequency[between] = np.repeat(10.0**half, lengths[:-1])
        motion[between] = np.repeat(np.sign(change), lengths[:-1])
        middle = np.repeat(v[turns[:-1]] + 0.5 * change, lengths[:-1])
        side[between] = np.sign(v[between] - middle)
    return _History(since, distance, swing, frequency, motion, side)
