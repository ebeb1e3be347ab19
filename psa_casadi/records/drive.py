"""The periodicity of a drive voltage, its turns, and where it comes back by a threshold."""

import numpy as np

from psa_casadi.common.units import FloatArray, IndexArray
from psa_casadi.records.record import Record

_DOMINANT = 0.5
_SIDE_LINES = 5
_ORDERS = 12
#: Mains frequencies [Hz] and their harmonics; how far a grid is off them; and how many of a
#: record's resolutions a line lies off the drive's harmonics to be no harmonic.
_MAINS, _MULTIPLES, _OFF, _APART = (50.0, 60.0), 3, 0.004, 2.0


def drive_frequency(record: Record) -> float | None:
    """Return the frequency [Hz] of the line that holds most of the voltage's alternating power.

    None where no line, with five neighbours on each side for modulation, holds half of it.
    """
    even = np.linspace(record.time[0], record.time[-1], record.n)
    v = np.interp(even, record.time, record.voltage)
    power = np.abs(np.fft.rfft((v - np.mean(v)) * np.hanning(record.n))) ** 2
    peak = dominant_line(power)
    return None if peak is None or peak <= _SIDE_LINES else peak / record.duration


def dominant_line(power: FloatArray) -> int | None:
    """Return the line that holds half of a periodogram's power but the mean's, None without any.

    Five neighbours on each side count with it, for modulation.
    """
    total = float(np.sum(power[1:]))
    peak = 1 + int(np.argmax(power[1:]))
    held = float(np.sum(power[max(1, peak - _SIDE_LINES) : peak + _SIDE_LINES + 1]))
    return peak if held > _DOMINANT * total else None


def is_mains(frequency: float) -> bool:
    """Whether a frequency [Hz] is that of a mains, or a harmonic of it."""
    orders = [(round(frequency / mains), mains) for mains in _MAINS]
    return any(k and abs(frequency - k * mains) < _OFF * frequency for k, mains in orders)


def is_tone_separable(frequency: float, record: Record, *, hum: bool) -> bool:
    """Whether a tone [Hz] is distinguishable from the drive; with `hum` lines of the mains count.

    A resonance answers a periodic drive at the drive's harmonics only, and so does distortion: in
    the range of its first twelve the two are indistinguishable, except for a line of the
    mains or its harmonics that is none of the drive's.
    """
    drive = drive_frequency(record)
    if drive is None or frequency >= (_ORDERS + 0.5) * drive:
        return True
    lines = [m * mains for mains in _MAINS for m in range(1, _MULTIPLES + 1)]
    near = any(abs(frequency - line) < _OFF * line for line in lines)
    is_harmonic = abs(frequency - round(frequency / drive) * drive) <= _APART / record.duration
    return hum and near and not is_harmonic


def turns(voltage: FloatArray, share: float = 0.1) -> bool:
    """Whether a voltage moves both ways, by this share of its range or more in all."""
    moves = np.diff(voltage)
    return bool(min(moves[moves > 0].sum(), -moves[moves < 0].sum()) > share * np.ptp(voltage))


def reversals(voltage: FloatArray, threshold: float | None = None) -> IndexArray:
    """Return the samples at which the voltage turns and comes back by more than `threshold` [V].

    Without a threshold it is 1e-4 of the range, which is taken for noise.
    """
    threshold = 1e-4 * float(np.ptp(voltage)) if threshold is None else threshold
    step = np.diff(voltage)
    moving = np.flatnonzero(step)
    up = step[moving] > 0
    places = np.r_[0, moving[np.flatnonzero(up[1:] != up[:-1])] + 1, voltage.size - 1]
    turns: list[int] = []
    direction, extreme, level = 0, 0, float(voltage[0])
    for k, v in zip(places.tolist(), voltage[places].tolist(), strict=True):
        change = v - level
        if direction == 0:
            if abs(change) > threshold:
                direction, extreme, level = (1 if change > 0 else -1), k, v
        elif change * direction > 0:
            extreme, level = k, v
        elif -change * direction > threshold:
            turns.append(extreme)
            direction, extreme, level = -direction, k, v
    return np.array(turns, dtype=np.int64)
