"""Voltages of tests: levels one after the other, and parts one after the other."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from psa_casadi.units import FloatArray


def steps(time: FloatArray, levels: ArrayLike) -> FloatArray:
    """Return levels [V], each for the same share of the instants (n,)."""
    values = np.atleast_1d(np.asarray(levels, dtype=np.float64))
    return values[np.arange(time.size) * values.size // time.size]


def concatenate(parts: Sequence[FloatArray], step: float) -> tuple[FloatArray, FloatArray]:
    """Return instants [s] a step apart, and the parts [V] one after the other."""
    voltage = np.concatenate(parts)
    return step * np.arange(voltage.size, dtype=np.float64), voltage
