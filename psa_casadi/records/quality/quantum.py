"""The quantisation step of a sensor, and the digits of a file, where a record shows them."""

import numpy as np

from psa_casadi.units import FloatArray

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
        if largest > step / (_NEAR * np.finfo(float).eps):  # no double tells
            break
        places = signal / step
        if np.all(np.abs(places - np.round(places)) < _NEAR):
            return step
    return 0.0
