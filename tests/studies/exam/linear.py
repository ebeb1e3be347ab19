"""Linear filters in exact steps; their input is a straight line between two samples.

Source: K. J. Astrom, B. Wittenmark, "Computer-Controlled Systems", first-order hold.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.signal import cont2discrete, lfilter

from tests.studies.exam.record import Floats


def filtered(
    numerator: Sequence[float], denominator: Sequence[float], signal: Floats, step: float
) -> Floats:
    """Return numerator(s)/denominator(s) of a signal, at rest before its first sample."""
    b, a, _ = cont2discrete((np.array(numerator), np.array(denominator)), step, method="foh")
    rest = numerator[-1] / denominator[-1] * signal[0]
    out = rest + lfilter(np.ravel(b), np.ravel(a), signal - signal[0])
    return np.asarray(out, dtype=np.float64)


def lagged(signal: Floats, time_constant: float, step: float) -> Floats:
    """Return 1/(tau s + 1) of a signal."""
    return filtered([1.0], [time_constant, 1.0], signal, step)


def resonant(
    signal: Floats, frequency: float, damping: float, step: float, zero: float = 0.0
) -> Floats:
    """Return (zero s + 1)/(s^2/w^2 + 2 zeta s/w + 1) of a signal, w = 2 pi f."""
    w = 2 * math.pi * frequency
    numerator = [zero, 1.0] if zero else [1.0]
    return filtered(numerator, [1 / w**2, 2 * damping / w, 1.0], signal, step)
