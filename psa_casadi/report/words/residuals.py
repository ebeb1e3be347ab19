"""What a residual looks like: spectrum, autocorrelation, distribution, and how large it is."""

from dataclasses import dataclass

import numpy as np

from psa_casadi.report.words.series import Curve, FloatArray, IndexArray, Series, extremes

#: Lags at which an autocorrelation is taken, evenly spread over their logarithm.
_LAGS = 160
#: Half width of the band that holds 95 % of the autocorrelations of white noise, times sqrt(n).
_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Distribution:
    """Shares of a residual's samples [%] in bins of equal width; centres and width in [m]."""

    centres: FloatArray
    shares: FloatArray
    width: float


@dataclass(frozen=True)
class ResidualFigures:
    """Size and character of one record's residual; lengths in [m].

    `neighbours` is the autocorrelation at a lag of one sample, `outside` the share of the lags
    beyond the band of white noise, `lasting` the time [s] after which the autocorrelation has once
    been within the band or changed its sign; `skewness` and `kurtosis` (excess) are 0 for a normal
    distribution, and of that 0.0027 lies `beyond_three` standard deviations.
    """

    rms: float
    mean: float
    largest: float
    range_share: float
    noise: float
    neighbours: float
    outside: float
    lasting: float
    skewness: float
    kurtosis: float
    beyond_three: float


def residual_figures(s: Series, curve: Curve) -> ResidualFigures:
    """Return size and character of the residual that a curve leaves in its record."""
    residual = s.residual(curve)
    valid = residual[np.isfinite(residual)]
    lags, correlations = autocorrelation(residual)
    calm = np.abs(correlations) <= white_band(residual)
    # lags lie apart, so that an autocorrelation may pass through the band unseen
    below = np.flatnonzero(calm | (np.sign(correlations) != np.sign(correlations[0])))
    last = lags[below[0]] if below.size else lags[-1]
    spread = float(np.std(valid))
    z = (valid - np.mean(valid)) / (spread if spread > 0 else 1.0)
    span = float(np.nanmax(s.measured) - np.nanmin(s.measured))
    rms = float(np.sqrt(np.mean(valid**2)))
    return ResidualFigures(
        rms=rms,
        mean=float(np.mean(valid)),
        largest=float(np.max(np.abs(valid))),
        range_share=rms / span if span > 0 else float("nan"),
        noise=s.noise,
        neighbours=float(correlations[0]),
        outside=float(np.mean(~calm)),
        lasting=float(last * np.median(np.diff(s.time))),
        skewness=float(np.mean(z**3)),
        kurtosis=float(np.mean(z**4)) - 3.0,
        beyond_three=float(np.mean(np.abs(z) > 3.0)),
    )


def autocorrelation(residual: FloatArray) -> tuple[IndexArray, FloatArray]:
    """Return lags [samples] from 1 to a quarter of the record, and the autocorrelation there.

    r(k) = mean(e_i e_(i+k)) / mean(e_i^2), each mean over the pairs of which neither sample is
    missing, with e the residual minus its mean. A lag without any pair has correlation 0.
    """
    n = len(residual)
    there = np.isfinite(residual)
    centred = np.where(there, residual - np.mean(residual[there]), 0.0)
    products, pairs = (_correlate(v) for v in (centred, there.astype(np.float64)))
    power = products[0] / max(pairs[0], 1.0)
    lags = np.unique(np.geomspace(1, max(2, n // 4), _LAGS).round().astype(np.int64))
    means = products[lags] / np.maximum(pairs[lags], 1.0)
    return lags, means / power if power > 0 else np.zeros(len(lags))


def _correlate(values: FloatArray) -> FloatArray:
    """Return sum_i v_i v_(i+k) for every lag k, by the fast Fourier transform."""
    n = len(values)
    transformed = np.fft.rfft(values, 2 * n)
    return np.fft.irfft(np.abs(transformed) ** 2, 2 * n)[:n]


def white_band(residual: FloatArray) -> float:
    """Return the autocorrelation that 95 % of the lags of white noise stay below."""
    return _NORMAL_95 / float(np.sqrt(np.count_nonzero(np.isfinite(residual))))


def distribution(residual: FloatArray, low: float, high: float) -> Distribution:
    """Return the distribution of a residual between two values [m], in 15 to 61 bins."""
    valid = residual[np.isfinite(residual)]
    bins = int(np.clip(2.0 * len(valid) ** (1.0 / 3.0), 15, 61)) | 1
    counts, edges = np.histogram(valid, bins=bins, range=(low, high))
    width = float(edges[1] - edges[0])
    return Distribution(edges[:-1] + 0.5 * width, 100.0 * counts / len(valid), width)


def spectrum(time: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return frequencies [Hz] and the amplitude density [m/sqrt(Hz)] of a residual (Welch, Hann).

    Missing samples and uneven sampling are bridged by straight lines, on a grid of at most four
    times as many points as there are samples.
    """
    valid = np.isfinite(residual)
    step = max(float(np.median(np.diff(time))), float(time[-1] - time[0]) / (4 * len(time)))
    grid = np.arange(time[0], time[-1], step)
    even = np.interp(grid, time[valid], residual[valid])
    segment = min(len(even), max(256, len(even) // 6))
    power = _mean_power(even, segment) * step
    frequency = np.asarray(np.fft.rfftfreq(segment, step), dtype=float)
    return frequency[1:], np.asarray(np.sqrt(power[1:]))


def _mean_power(values: FloatArray, segment: int) -> FloatArray:
    """Return the power of one-sided spectra of segments that overlap by half (Welch 1967)."""
    parts = np.lib.stride_tricks.sliding_window_view(values, segment)
    parts = parts[:: segment - segment // 2]
    window = np.hanning(segment + 1)[:-1]
    spectra = np.fft.rfft((parts - np.mean(parts, axis=1, keepdims=True)) * window, axis=1)
    power: FloatArray = np.mean(np.abs(spectra) ** 2, axis=0) / np.sum(window**2)
    power[1 : (segment + 1) // 2] *= 2.0  # what the negative frequencies hold
    return power


def shown_lines(frequency: FloatArray, density: FloatArray, limit: int) -> IndexArray:
    """Return about `limit` indices of a spectrum that keep its peaks, evenly over log frequency."""
    n = len(frequency)
    if n <= limit:
        return np.arange(n)
    steps = np.geomspace(frequency[0], frequency[-1], limit // 2)
    edges = np.unique(np.concatenate([[0], np.searchsorted(frequency, steps), [n]]))
    return extremes([density], edges.astype(np.int64))


def noise_density(s: Series) -> float:
    """Return the amplitude density [m/sqrt(Hz)] of white noise of the record's level."""
    return s.noise * float(np.sqrt(2.0 * np.median(np.diff(s.time))))
