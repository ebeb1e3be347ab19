"""The noise floor of a measured displacement, and how a residual compares with it."""

import numpy as np

from psa_casadi.records.quality.filtering import without_line
from psa_casadi.units import FloatArray

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
#: A correlation counts from here on, and from so many times 1/sqrt(n): three standard errors.
_LEAST, _SURE = 0.1, 6.0


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
    power = float(np.median(powers)) / (1.0 - 2.0 / (9.0 * _freedom(length))) ** 3
    return min(float(np.sqrt(power)), float(np.std(signal))) if power > 0 else float(np.std(signal))


def _freedom(length: int) -> float:
    """Degrees of freedom of the mean square of so many third differences of white noise."""
    alike = sum((1.0 - k / length) * r for k, r in enumerate(_SQUARES, 1) if k < length)
    return length / (1.0 + 2.0 * alike)


def first_order_noise(signal: FloatArray) -> tuple[float, float]:
    """Return rms and correlation of neighbours of the noise in a signal, from its fast part.

    Noise e_k = r e_(k-1) + w_k has the density S(f) = S_w/(1 - 2 r cos(2 pi f) + r^2), f in cycles
    per sample, and the variance S_w/(1 - r^2). Both are fitted to the medians of short periodograms
    at the fast frequencies, where what is smooth has no power; least absolute deviations of their
    logarithms leave lines and moments of a misfit aside. Where no r can be told from 0 the white
    part of `high_frequency_noise` is the noise. The rms is at most that of the signal.
    """
    n, white = len(signal), high_frequency_noise(signal)
    if n < _FEWEST_SEGMENTS * _SEGMENT:
        return white, 0.0
    density = _median_density(signal)
    index = np.arange(len(density))
    fast = (index >= _FAST * _SEGMENT) & (index < _SEGMENT / 2)
    if not np.all(density[fast] > 0):
        return white, 0.0
    turn = np.cos(2 * np.pi * index[fast] / _SEGMENT)
    shape = np.log(1 - 2 * _CORRELATIONS[:, None] * turn + _CORRELATIONS[:, None] ** 2)
    flat = np.log(density[fast]) + shape
    levels = np.median(flat, axis=1)
    best = int(np.argmin(np.sum(np.abs(flat - levels[:, None]), axis=1)))
    r = float(_CORRELATIONS[best])
    if r < max(_LEAST, _SURE / np.sqrt(n)):
        return white, 0.0
    rms = float(np.sqrt(np.exp(levels[best]) / (1 - r**2)))
    return min(rms, float(np.std(signal))), r


def _median_density(signal: FloatArray) -> FloatArray:
    """Return the median periodogram of half-overlapping segments, that of white noise its variance.

    A periodogram's values have an exponential distribution, whose median is ln 2 means.
    """
    parts = np.lib.stride_tricks.sliding_window_view(signal, _SEGMENT)[:: _SEGMENT // 2]
    window = np.hanning(_SEGMENT)
    power = np.abs(np.fft.rfft(without_line(parts) * window, axis=1)) ** 2
    return np.asarray(np.median(power, axis=0) / np.sum(window**2) / np.log(2.0))


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
    size = 2 ** int(np.ceil(np.log2(2 * n)))
    spectrum = np.abs(np.fft.rfft(centred, size)) ** 2
    lags = int(np.clip(reach, 1.0, n / 10.0))
    fade = 1.0 - np.arange(lags) / max(reach, lags)
    covariance: FloatArray = np.fft.irfft(spectrum, size)[:lags] / n * fade
    return covariance
