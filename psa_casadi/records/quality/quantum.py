"""The quantisation step of a sensor, where a record shows it."""

import numpy as np

from psa_casadi.units import FloatArray

#: Fewer samples of each level than this, on average, show no levels.
_VISITS = 4
#: A signal with fewer levels than this is no measurement of a motion.
_LEVELS = 3


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
