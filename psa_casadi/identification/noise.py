"""The noise floor of a measured displacement, and how a residual compares with it."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def high_frequency_noise(signal: FloatArray) -> float:
    """Standard deviation of the white part of a signal, from its third differences.

    White noise of variance s^2 has third differences of variance 20 s^2, while anything smooth
    over four samples has almost none. The median absolute value makes it robust against steps;
    a smaller figure than the root mean square of the signal itself is returned in any case.
    """
    if len(signal) < 8:
        return float(np.std(signal))
    differences = np.diff(signal, 3)
    robust = float(np.median(np.abs(differences))) / 0.6744897501960817 / np.sqrt(20.0)
    return min(robust, float(np.std(signal))) if robust > 0 else float(np.std(signal))


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
