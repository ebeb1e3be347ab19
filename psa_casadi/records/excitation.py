"""Test voltages for planned experiments, as samples on a time grid.

Every function takes instants `time` [s], shape (n,), that begin at the start of its part, and
the lowest and highest voltage `low`, `high` [V] that the stack may see, and returns voltages [V],
shape (n,), which never leave that range and begin at `low`, but for the multisine. Between samples
the voltage is meant to be linear.
"""

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray


def time_grid(duration: float, sample_time: float) -> FloatArray:
    """Return the instants `k sample_time` [s], k = 0, 1, ..., that lie before `duration` [s].

    Raises:
        InputError: the sample time is not positive, or the duration holds no two samples.
    """
    if not sample_time > 0 or not duration >= 1.5 * sample_time:
        raise InputError(
            f"a duration of {duration} s at a sample time of {sample_time} s holds no two samples; "
            f"give a positive sample time and a longer duration."
        )
    return np.arange(round(duration / sample_time), dtype=np.float64) * sample_time


def sine(time: FloatArray, low: float, high: float, frequency: float) -> FloatArray:
    """Return `low + (high - low) (1 - cos(2 pi f t))/2`. Use: a loop at one rate.

    Raises:
        InputError: `low` is not below `high`, or `frequency` [Hz] is not resolved by the grid.
    """
    _check(time, low, high, frequency)
    share = 0.5 * (1.0 - np.cos(2.0 * np.pi * frequency * time))
    return np.clip(low + (high - low) * share, low, high)


def triangle(time: FloatArray, low: float, high: float, frequency: float) -> FloatArray:
    """Return a triangle of equal rising and falling rate, `2 f (high - low)` [V/s].

    Use: loops at a constant rate, where terms in the rate of the voltage show by themselves.

    Raises:
        InputError: `low` is not below `high`, or `frequency` [Hz] is not resolved by the grid.
    """
    _check(time, low, high, frequency)
    phase = frequency * time
    share = 1.0 - np.abs(2.0 * (phase - np.floor(phase)) - 1.0)
    return np.clip(low + (high - low) * share, low, high)


def decaying_triangle(
    time: FloatArray, low: float, high: float, periods: int, *, centre: float | None = None
) -> FloatArray:
    """Return a triangle between `low` and `high` whose turning points close in on `centre` [V].

    `v(t_j) = centre + (1 - j/(2 N)) (e_j - centre)`, `t_j = j T/(2 N)`, j = 0 .. 2 N, linear in
    between; `e_j` is `low` for even and `high` for odd j, T the length of the grid, N = `periods`.
    `centre` is the middle by default; `low` keeps all the loops on one foot.
    Use: nested minor loops, that is the memory of hysteresis; also to depolarise before a record.

    Raises:
        InputError: `low` is not below `high`, `centre` lies outside, or the grid is too coarse.
    """
    length = _length(time)
    _check(time, low, high, periods / length)
    middle = 0.5 * (low + high) if centre is None else centre
    if not low <= middle <= high:
        raise InputError(
            f"the centre {middle} V lies outside of {low} V to {high} V; choose one inside."
        )
    turns = np.arange(2 * periods + 1)
    ends = np.where(turns % 2 == 0, low, high)
    levels = middle + (1.0 - turns / (2 * periods)) * (ends - middle)
    return np.clip(np.interp(time, turns * length / (2 * periods), levels), low, high)


def multisine(
    time: FloatArray, low: float, high: float, band: tuple[float, float], *, seed: int
) -> FloatArray:
    """Return a random-phase multisine with equal amplitude at every line in `band` [Hz].

    The lines are the multiples of 1/T, T the length of the grid, so one period fills the grid and
    repeats without a jump. Phases are drawn from `seed`; the sum is scaled to touch `low` and
    `high`. Use: frequency response; with odd and even distortion, nonlinearity.
    Source: Pintelon and Schoukens, System Identification, 2nd ed., section 4.2.

    Raises:
        InputError: `low` is not below `high`, no line lies in the band, or the grid is too coarse.
    """
    _check(time, low, high, band[1])
    length = _length(time)
    first, last = int(np.ceil(band[0] * length - 1e-9)), int(np.floor(band[1] * length + 1e-9))
    first = max(first, 1)
    if first > last:
        raise InputError(
            f"no multiple of {1.0 / length:.6g} Hz lies in {band[0]} Hz to {band[1]} Hz; widen the "
            f"band or lengthen the record."
        )
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, last - first + 1)
    spectrum = np.zeros(time.size // 2 + 1, dtype=np.complex128)
    spectrum[first : last + 1] = np.exp(1j * phases)
    signal = np.fft.irfft(spectrum, time.size)
    bottom, top = signal.min(), signal.max()
    voltage: FloatArray = low + (high - low) * (signal - bottom) / (top - bottom)
    return np.clip(voltage, low, high)


def _length(time: FloatArray) -> float:
    """Return the period of a signal that fills the grid: one sample more than its last instant."""
    return float(time[-1] - time[0]) * time.size / (time.size - 1)


def _check(time: FloatArray, low: float, high: float, frequency: float) -> None:
    if not low < high:
        raise InputError(f"the range {low} V to {high} V is empty; give low below high.")
    highest = 0.5 * (time.size - 1) / float(time[-1] - time[0])
    if not 0 < frequency < highest:
        raise InputError(
            f"{frequency:.6g} Hz cannot be resolved on this time grid, which reaches up to "
            f"{highest:.6g} Hz; choose a lower frequency or a finer grid."
        )
