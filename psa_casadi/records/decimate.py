"""Block averages of a record, taken only as far as they lose nothing that a fit could use."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.records.noise import fast_noise
from psa_casadi.records.record import Record

#: As many samples are left at least.
FEWEST = 2000
#: An error of this share of the noise is none.
SHARE = 0.1
#: The largest of a million samples of white noise, in standard deviations.
LARGEST = 6.0
#: Blocks over which a bend of the displacement is averaged before it is held against the noise.
ACROSS = 5
#: Lines over which a hump is looked for, and frequencies over which the local mean is taken.
_HUMP, _AROUND = 64, 2048


def decimated(record: Record, noise: float, slope: float) -> tuple[Record, int]:
    """Return a record of block averages over q samples, and q, which is 1 where nothing may go.

    `noise` is the standard deviation of the displacement's white noise, `slope` the displacement
    per volt. q doubles as long as, with blocks of length h:

    * the voltage is uniform in time, and straight lines between its averages meet every sample
      to within 0.1 noise/slope, apart from the voltage's white noise; so do those of a load force
      to within a thousandth of its range;
    * averaging moves the displacement, y'' h^2 / 24 in a block, by less than 0.1 noise/sqrt(q);
    * what averaging takes out of the displacement is white: no line and no hump in the spectrum;
    * 2000 samples or more are left.

    A block's displacement is the mean of its valid samples, brought to the block's middle along the
    line to its neighbour; a block of which more than half is missing is masked, and where samples
    are missing, q means the valid ones of the emptiest block. Fewer than q samples at the end
    are dropped. Name, source and `sha256` are kept.

    Raises:
        InputError: the noise or the slope is not positive.
    """
    for name, value in (("noise", noise), ("slope", abs(slope))):
        if not 0.0 < value < np.inf:
            raise InputError(
                f"record '{record.name}': the {name} is {value:g}, expected a positive number; give"
                f" what was measured."
            )
    best, factor, intervals = record, 1, np.diff(record.time)
    usual = float(np.median(intervals))
    if np.any(np.abs(intervals - usual) >= 1e-3 * usual):
        return best, factor
    while record.n // (2 * factor) >= FEWEST:
        q = 2 * factor
        columns: dict[str, Any]
        columns = {n: _blocks(v, q).mean(axis=1) for n, v in record.columns.items()}
        time = _blocks(record.time, q).mean(axis=1)
        if record.displacement is not None:
            columns["displacement"] = _valid_means(record, time, q)
        wider = replace(record, time=time, **columns)
        if not _is_lossless(record, wider, q, noise, SHARE * noise / abs(slope)):
            break
        best, factor = wider, q
    return best, factor


def _blocks(values: NDArray[Any], q: int) -> NDArray[Any]:
    """Return values (n,) in blocks of q, (n // q, q)."""
    return values[: values.size // q * q].reshape(-1, q)


def _valid_means(record: Record, time: FloatArray, q: int) -> FloatArray:
    """Return the displacement at the middle of each block, nan where more than half is missing."""
    there = _blocks(record.mask, q)
    count = there.sum(axis=1)
    known, whole = 2 * count >= q, count == q
    y = np.nan_to_num(np.asarray(record.displacement, dtype=float), nan=0.0)
    sums = _blocks(y, q).sum(axis=1)
    t = np.where(there, _blocks(record.time, q), 0.0).sum(axis=1)
    means = np.full(count.size, np.nan)
    if known.any():
        centres = np.where(whole, time, t / np.maximum(count, 1))
        means[known] = np.interp(time[known], centres[known], sums[known] / count[known])
    return means


def _is_lossless(record: Record, wider: Record, q: int, noise: float, allowed: float) -> bool:
    """Whether block averages over q samples keep voltage, load and displacement."""
    if not _is_followed(record, wider, record.voltage, wider.voltage, q, allowed):
        return False
    if record.load_force is not None and wider.load_force is not None:
        least = 1e-3 * float(np.ptp(record.load_force)) + 1e-300
        if not _is_followed(record, wider, record.load_force, wider.load_force, q, least):
            return False
    y, means = record.displacement, wider.displacement
    if y is None or means is None:
        return True
    if wider.mask.sum() < 0.98 * record.mask.sum() / q:
        return False
    valid = _blocks(record.mask, q).sum(axis=1)
    least = int(np.min(valid[2 * valid >= q], initial=q))
    known = wider.mask
    taken = np.nan_to_num(y) - _lines(record.time, wider.time[known], means[known])
    white = np.where(record.mask, taken, 0.0)
    return _is_straight(means, noise / np.sqrt(least)) and _is_white(white, q)


def _is_followed(
    record: Record, wider: Record, signal: FloatArray, means: FloatArray, q: int, allowed: float
) -> bool:
    """Whether straight lines between the means meet the signal, but for its white noise."""
    error = signal - _lines(record.time, wider.time, means)
    noise = fast_noise(signal)
    smooth = np.convolve(error, np.ones(q) / q, mode="valid")
    return bool(
        np.max(np.abs(error)) <= allowed + LARGEST * noise * np.sqrt(1.0 + 1.0 / q)
        and np.max(np.abs(smooth)) <= allowed + LARGEST * noise / np.sqrt(q)
    )


def _lines(time: FloatArray, centres: FloatArray, means: FloatArray) -> FloatArray:
    """Return straight lines between the means, continued before the first and after the last."""
    values = np.interp(time, centres, means)
    for end, inner, outside in ((0, 1, time < centres[0]), (-1, -2, time > centres[-1])):
        rate = (means[end] - means[inner]) / (centres[end] - centres[inner])
        values[outside] = means[end] + rate * (time[outside] - centres[end])
    return values


def _is_straight(means: FloatArray, noise: float) -> bool:
    """Whether averaging moved no mean by more than a tenth of its noise.

    A bend of the means, y'' h^2, is 24 times that. Over five means the noise of a bend is 0.4 of
    theirs; one alone is compared with its noise, 2.45 times theirs.
    """
    bends = np.diff(means, 2)
    bends = bends[np.isfinite(bends)]
    if bends.size < ACROSS:
        return False
    across = np.convolve(bends, np.ones(ACROSS) / ACROSS, mode="valid")
    return bool(
        np.max(np.abs(across)) <= 24.0 * SHARE * noise
        and np.max(np.abs(bends)) <= (24.0 * SHARE + LARGEST * np.sqrt(6.0)) * noise
    )


def _is_white(taken: FloatArray, q: int) -> bool:
    """Whether what averaging took out of the displacement (n,) has no line and no hump.

    Above the new Nyquist frequency the power of white noise at neighbouring frequencies is
    independent and exponentially distributed: no line beyond ln(n) + 10 times the local mean, no
    mean of 64 lines beyond twice it.
    """
    power = np.abs(np.fft.rfft(taken)) ** 2
    upper = power[int(np.ceil(taken.size / (2 * q))) : -1]
    parts = np.array_split(upper, max(1, upper.size // _AROUND))
    middle = np.cumsum([p.size for p in parts]) - np.array([p.size for p in parts]) / 2.0
    medians = np.array([float(np.median(p)) for p in parts])  # which lines do not move
    local = np.interp(np.arange(upper.size), middle, medians / np.log(2.0))
    ratio = upper / np.maximum(local, 1e-300)
    hump = np.convolve(ratio, np.ones(_HUMP) / _HUMP, mode="valid")
    no_line = np.max(ratio) < np.log(upper.size) + 10.0
    return bool(no_line and np.max(hump) < 1.0 + 8.0 / np.sqrt(_HUMP))
