"""The noise floor of a signal, the quantum of its sensor, and small filters."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy

from psa_casadi.common.units import BoolArray, FloatArray, IndexArray

_WHITE = -0.6


def fast_noise(signal: FloatArray) -> float:
    """Return the standard deviation of a signal's white noise, 0 where its fast part is none.

    Third differences of white noise of variance s^2 have variance 20 s^2 and a correlation of
    -15/20 with their neighbours, while those of anything smooth over four samples are almost none
    or follow their neighbours. A correlation above -0.6 is therefore taken for motion.
    """
    if signal.size < 8:
        return 0.0
    third = np.diff(signal, 3)
    level = 1.482602218505602 * float(np.median(np.abs(third))) / float(np.sqrt(20.0))
    usual = np.clip(third, -6 * np.sqrt(20.0) * level, 6 * np.sqrt(20.0) * level)
    power = float(usual @ usual)
    if power <= 0 or float(usual[1:] @ usual[:-1]) / power > _WHITE:
        return 0.0
    return level


def filtered(
    upper: Sequence[float] | FloatArray, lower: Sequence[float] | FloatArray, x: FloatArray
) -> FloatArray:
    """Return the response of upper(z)/lower(z), from rest, to x (n,) or its columns (n, k).

    Both hold the coefficients of z^0, z^-1 ...; the first one of `lower` is 1.
    """
    values = upper[0] * x
    for k, weight in enumerate(upper[1 : len(x)], 1):
        values[k:] += weight * x[:-k]
    if len(lower) == 1 or not x.size:
        return values
    bands = np.repeat(np.asarray(lower, dtype=float)[: len(x), None], len(x), axis=1)
    solved = scipy.linalg.lapack.dtbtrs(bands, values.reshape(len(x), -1), uplo="L")[0]
    return np.asarray(solved.reshape(x.shape))


def convolved(x: FloatArray, kernel: FloatArray) -> FloatArray:
    """Return the columns x (n, k) convolved with a symmetric kernel (2 m + 1,), centred."""
    n, reach = len(x), len(kernel) // 2
    size = scipy.fft.next_fast_len(n + len(kernel) - 1, real=True)
    spectrum = scipy.fft.rfft(x, size, axis=0) * scipy.fft.rfft(kernel, size)[:, None]
    return np.asarray(scipy.fft.irfft(spectrum, size, axis=0)[reach : reach + n])


def peaks(values: FloatArray, apart: int, most: int) -> IndexArray:
    """Return the places of the highest local maxima, at least `apart` samples apart, in order."""
    inner = values[1:-1]
    places = np.flatnonzero((inner > values[:-2]) & (inner >= values[2:])) + 1
    chosen: list[int] = []
    for k in places[np.argsort(-values[places], kind="stable")].tolist():
        if len(chosen) == most:
            break
        if all(abs(k - other) >= apart for other in chosen):
            chosen.append(k)
    return np.array(chosen, dtype=np.int64)


#: Probability that white noise has a line in a record; number of lines at most.
_CHANCE, _LINES = 1e-4, 24
#: The lowest frequency [1/duration] of a line (below it is drift); widest surroundings.
_LOWEST, _WIDEST = 8, 64


def lines_in(power: FloatArray) -> tuple[IndexArray, FloatArray]:
    """Return the lines that exceed their surroundings, and the mean power of the latter (n,).

    `power` (n,) is a periodogram under Hann's window; the strongest line is the first one. Powers
    of noise are exponentially distributed, their median ln 2 times their mean.
    """
    edges = [_LOWEST]
    while edges[-1] < power.size:
        edges.append(edges[-1] + int(np.clip(edges[-1], _LOWEST, _WIDEST)))
    if len(edges) < 3:
        return np.zeros(0, dtype=np.int64), np.zeros_like(power)
    edges = [*edges[:-2], power.size]
    level = np.array([np.median(power[a:b]) for a, b in pairwise(edges)])
    centres = 0.5 * (np.array(edges[:-1]) + np.array(edges[1:]))
    around = np.interp(np.arange(power.size), centres, level / np.log(2.0))
    # neighbouring powers of a window share noise, and a median of few is uncertain
    limit = 1.4 * around * (np.log(power.size) - np.log(_CHANCE))
    inner = np.arange(max(_LOWEST, 3), power.size - 3)
    highest = np.max([power[inner + d] for d in (-3, -2, -1, 1, 2, 3)], axis=0)
    lines = inner[(power[inner] > limit[inner]) & (power[inner] > highest)]
    return lines[np.argsort(-power[lines])[:_LINES]], around


def growth(squares: FloatArray, sizes: FloatArray) -> tuple[float, float]:
    """Return the ratio c of a variance s^2 (1 + c x), and by how many nats it is likelier than s^2.

    `squares` (n,) are those of the noise, `sizes` (n,) the x; c is 0 where none gains.
    """
    mean = float(np.log(max(float(np.mean(squares)), 1e-300)))
    best = (0.0, 0.0)
    for c in _RATIOS:
        grown = 1.0 + c * sizes
        level = float(np.log(max(float(np.mean(squares / grown)), 1e-300)))
        gain = 0.5 * squares.size * (mean - level) - 0.5 * float(np.sum(np.log(grown)))
        best = max(best, (gain, float(c)))
    return best[1], best[0]


#: Ratios of variances that are tried.
_RATIOS = np.geomspace(0.02, 2e3, 51)


#: Fewer samples of each level than this, on average, show no levels.
_VISITS = 4
#: A signal with fewer levels than this is no measurement of a motion.
_LEVELS = 3
#: Decimal places that a file may have, in SI units; how near to them every value must be, over the
#: last place; and least values over the last place: nearer to 0 any number has few places.
_PLACES, _NEAR, _LEAST = range(3, 16), 1e-3, 10.0


def quantum_of(signal: FloatArray) -> float | None:
    """Return the step between the levels of a quantised signal, or None where it has no levels.

    The signal (n,), without nan, is quantised where it takes few distinct values, a quarter of its
    samples at most, and every distance between neighbouring ones is a whole multiple of one step
    (to a tenth of it, because files hold rounded numbers).
    """
    levels = np.unique(signal)
    if levels.size < _LEVELS or levels.size * _VISITS > signal.size:
        return None
    gaps = np.diff(levels)
    apart = gaps[gaps > 1e-6 * (levels[-1] - levels[0])]
    if not apart.size:
        return None
    single = apart[apart < 1.5 * np.min(apart)]
    step = float(np.mean(single))
    multiples = apart / step
    if np.any(np.abs(multiples - np.round(multiples)) > 0.1 * np.maximum(1.0, multiples / 10.0)):
        return None
    return step


def last_place_of(signal: FloatArray) -> float:
    """Return the last decimal place 10^-k to which all values of a signal are rounded, 0 if none.

    The signal (n,) is without nan. Rounding to it leaves an error of 10^-k/sqrt(12) rms.
    """
    largest = float(np.max(np.abs(signal), initial=0.0))
    for k in _PLACES:
        step = 10.0**-k
        if largest < _LEAST * step:
            continue
        if largest > step / (_NEAR * np.finfo(float).eps):  # beyond the precision of a double
            break
        places = signal / step
        if np.all(np.abs(places - np.round(places)) < _NEAR):
            return step
    return 0.0


#: Samples of a block in which the standard deviation around a sample is taken.
BLOCK = 32


def local_scale(away: FloatArray) -> FloatArray:
    """Return the robust standard deviation around every sample: the largest of three blocks'."""
    count = max(1, away.size // BLOCK)
    size, longer = divmod(away.size, count)  # the first ones have one sample more
    parts = np.split(np.abs(away), [longer * (size + 1)])
    blocks = [p.reshape(-1, b) for p, b in zip(parts, (size + 1, size), strict=True) if p.size]
    each = 1.4826 * np.concatenate([np.median(b, axis=1) for b in blocks])
    each = np.maximum(scipy.ndimage.maximum_filter1d(each, 3, mode="nearest"), np.median(each))
    return np.repeat(each, [size + (k < longer) for k in range(count)])


def runs_of(mask: BoolArray) -> list[tuple[int, int]]:
    """Return the first sample of every run of True in (n,), and the one behind its last."""
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False].astype(np.int8))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


#: Fewer samples than this are noise as a whole; third differences of this many standard deviations
#: are steps, if their share is no larger.
_FEWEST_SAMPLES, _STEP, _STEPS = 8, 5.0, 0.2
#: Blocks of third differences at least, samples in one at most.
_BLOCKS, _BLOCK = 16, 64
#: Squares of the autocorrelations of white noise's third differences: -15, 6 and -1 over 20.
_SQUARES = (0.5625, 0.09, 0.0025)
#: Samples in a segment, the fewest segments, and the fast frequencies [cycles per sample].
_SEGMENT, _FEWEST_SEGMENTS, _FAST = 128, 4, 0.045
_CORRELATIONS = np.arange(0.0, 0.96, 0.01)
#: A correlation counts from here on, and from this many times 1/sqrt(n): three standard errors.
_CORRELATED, _SURE = 0.1, 6.0


def high_frequency_noise(signal: FloatArray) -> float:
    """Standard deviation of the white part of a signal, from its third differences.

    White noise of variance s^2 has third differences of variance 20 s^2, while anything smooth
    over four samples has almost none. Those of steps, few and far beyond their median absolute
    value, are left out; a kink every few dozen samples counts as noise. The mean squares of the
    others over short blocks have nearly a chi-square distribution, whose median (Wilson and
    Hilferty) gives s whatever a few blocks hold, and also where the signal is rounded to coarse
    levels. The figure is at most the root mean square of the signal itself.
    """
    if len(signal) < _FEWEST_SAMPLES:
        return float(np.std(signal))
    squares = np.diff(signal, 3) ** 2 / 20.0
    usual = squares < _STEP**2 * float(np.median(squares)) / 0.455  # that of chi-square with one
    if np.mean(usual) >= 1.0 - _STEPS:
        squares = squares[usual]
    length = int(np.clip(len(squares) // _BLOCKS, 1, _BLOCK))
    count = len(squares) // length
    powers = np.mean(squares[: count * length].reshape(count, length), axis=1)
    similar = sum((1.0 - k / length) * r for k, r in enumerate(_SQUARES, 1) if k < length)
    freedom = length / (1.0 + 2.0 * similar)  # of the mean square of `length` third differences
    power = float(np.median(powers)) / (1.0 - 2.0 / (9.0 * freedom)) ** 3
    return min(float(np.sqrt(power)), float(np.std(signal))) if power > 0 else float(np.std(signal))


def first_order_noise(signal: FloatArray) -> tuple[float, float]:
    """Return rms and correlation of neighbours of the noise in a signal, from its fast part.

    Noise e_k = r e_(k-1) + w_k has the density S(f) = S_w/(1 - 2 r cos(2 pi f) + r^2), f in cycles
    per sample, and the variance S_w/(1 - r^2). Both are fitted to the medians of short periodograms
    at the fast frequencies, where what is smooth has no power; least absolute deviations of their
    logarithms are insensitive to lines and moments of a misfit. If no r differs from 0 the white
    part of `high_frequency_noise` is the noise. The rms is at most that of the signal.
    """
    n, white = len(signal), high_frequency_noise(signal)
    if n < _FEWEST_SEGMENTS * _SEGMENT:
        return white, 0.0
    parts = np.lib.stride_tricks.sliding_window_view(signal, _SEGMENT)[:: _SEGMENT // 2]
    window, t = np.hanning(_SEGMENT), np.linspace(-1.0, 1.0, _SEGMENT)
    flat = parts - np.mean(parts, axis=1, keepdims=True)
    flat -= np.outer(flat @ t / (t @ t), t)
    power = np.median(np.abs(np.fft.rfft(flat * window, axis=1)) ** 2, axis=0)
    density = power / np.sum(window**2) / np.log(2.0)  # the median of a periodogram is ln 2 means
    index = np.arange(len(density))
    fast = (index >= _FAST * _SEGMENT) & (index < _SEGMENT / 2)
    if not np.all(density[fast] > 0):
        return white, 0.0
    turn = np.cos(2 * np.pi * index[fast] / _SEGMENT)
    shape = np.log(1 - 2 * _CORRELATIONS[:, None] * turn + _CORRELATIONS[:, None] ** 2)
    white_part = np.log(density[fast]) + shape
    levels = np.median(white_part, axis=1)
    best = int(np.argmin(np.sum(np.abs(white_part - levels[:, None]), axis=1)))
    r = float(_CORRELATIONS[best])
    if r < max(_CORRELATED, _SURE / np.sqrt(n)):
        return white, 0.0
    rms = float(np.sqrt(np.exp(levels[best]) / (1 - r**2)))
    return min(rms, float(np.std(signal))), r


def uncertain(residual: FloatArray) -> float:
    """Return the relative standard error of the noise's power from a residual's fast part.

    About 2/sqrt(n) of white noise. The power of a first-order autoregression hangs on what its fast
    part shows of the correlation r: 1.4 q/sqrt(n) with q = (1 + r)/(1 - r), within a fifth of what
    60 draws each of r = 0.4 to 0.9 and n = 2,000 to 5,000 showed; at most 1.
    """
    r = first_order_noise(residual)[1] if residual.size else 0.0
    factor = max(2.0, 1.4 * (1.0 + r) / (1.0 - r))
    return float(min(1.0, factor / np.sqrt(max(residual.size, 1))))


def correlation_inflation(residual: FloatArray) -> float:
    """Factor by which correlation of neighbours inflates the variance of an estimate (at least 1).

    (1 + r)/(1 - r) with the residual's correlation r at lag one: exact for a first-order
    autoregression.
    """
    centred = residual - np.mean(residual)
    power = float(centred @ centred)
    if power <= 0:
        return 1.0
    r = float(np.clip(centred[1:] @ centred[:-1] / power, 0.0, 0.99))
    return (1 + r) / (1 - r)


def autocovariance(residual: FloatArray) -> FloatArray:
    """Return the autocovariance (lags,) of a residual, faded out where it cannot be estimated.

    Bartlett's weights 1 - k/L keep the spectrum positive; L follows from the correlation at lag one
    as for a first-order autoregression, 1.1447 (4 r^2 n / (1 - r^2)^2)^(1/3) (Andrews 1991). White
    residuals give their variance alone or hardly more; L is at most a tenth of the samples.
    """
    n = len(residual)
    centred = residual - np.mean(residual)
    power = float(centred @ centred) / max(n, 1)
    if n < 20 or power <= 0:
        return np.array([float(residual @ residual) / max(n, 1)])
    r = float(np.clip(centred[1:] @ centred[:-1] / (n * power), -0.99, 0.99))
    reach = 1.1447 * (4.0 * r**2 * n / (1.0 - r**2) ** 2) ** (1.0 / 3.0)
    lags = int(np.clip(reach, 1.0, n / 10.0))
    fade = 1.0 - np.arange(lags) / max(reach, lags)
    return np.asarray(lag_products(centred, lags) / n * fade)


def lag_products(d: FloatArray, lags: int) -> FloatArray:
    """Return sum_i d_i d_(i+k) for k < lags."""
    size = scipy.fft.next_fast_len(d.size + lags, real=True)
    products = np.zeros(lags)
    matches = scipy.fft.irfft(np.abs(scipy.fft.rfft(d, size)) ** 2, size)[: min(lags, d.size)]
    products[: matches.size] = matches
    return products


def forgets(correlation: FloatArray) -> float:
    """Return the lag from which on correlations (n,) stay below 1/e of the first in size."""
    size = np.abs(correlation) / max(float(correlation[0]), 1e-300)
    above = np.flatnonzero(size[:-1] > np.exp(-1.0))
    last = int(above[-1]) if above.size else 0
    high, low = size[last : last + 2]
    return last + float((high - np.exp(-1.0)) / max(high - low, 1e-300))
