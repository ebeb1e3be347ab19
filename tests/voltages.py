"""Voltages of tests."""

import numpy as np
from numpy.typing import ArrayLike

from psa_casadi.common.units import FloatArray


def steps(time: FloatArray, levels: ArrayLike) -> FloatArray:
    """Return levels [V], each for the same share of the instants (n,)."""
    values = np.atleast_1d(np.asarray(levels, dtype=np.float64))
    return values[np.arange(time.size) * values.size // time.size]
