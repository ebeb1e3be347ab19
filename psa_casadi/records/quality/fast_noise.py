"""The white noise of a signal, told from fast motion."""

import numpy as np

from psa_casadi.units import FloatArray

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
