"""The noise of a record: its level and its colour, as a first-order autoregression."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Correlations below this are taken as white: estimated ones of white noise are not exactly 0.
_WHITE = 0.05
_LARGEST = 0.95


@dataclass(frozen=True)
class Colour:
    """Noise e_k = correlation e_(k-1) + w_k, with w white of standard deviation `level` [m].

    An autoregression of first order can describe the noise of a sensor with a filter, but neither a
    tone nor a slow misfit on top of white noise: those remain visible after whitening.
    """

    correlation: float
    level: float
    lengths: tuple[int, ...]

    def whiten(self, signal: FloatArray) -> FloatArray:
        """Filter a signal (samples,) or columns (samples, k), every record for itself."""
        if not self.correlation:
            return signal
        white = signal.copy()
        first = 0
        for length in self.lengths:
            part = signal[first : first + length]
            white[first + 1 : first + length] = part[1:] - self.correlation * part[:-1]
            white[first] = part[0] * np.sqrt(1.0 - self.correlation**2)
            first += length
        return white


def colour_of(remainder: FloatArray, lengths: Sequence[int]) -> Colour:
    """Estimate colour and level from what no model and no candidate explains."""
    top = bottom = 0.0
    first = 0
    for length in lengths:
        part = remainder[first : first + length]
        top += float(part[1:] @ part[:-1])
        bottom += float(part @ part)
        first += length
    correlation = float(np.clip(top / bottom, 0.0, _LARGEST)) if bottom > 0 else 0.0
    if correlation < _WHITE:
        correlation = 0.0
    colour = Colour(correlation, 1.0, tuple(lengths))
    level = float(np.sqrt(np.mean(colour.whiten(remainder) ** 2)))
    return Colour(correlation, max(level, 1e-15), tuple(lengths))
