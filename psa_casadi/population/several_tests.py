"""Many tests at once: p values adjusted so that few, or none, of those below a limit are chance."""

from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from psa_casadi.units import FloatArray

Adjustment = Literal["benjamini-hochberg", "bonferroni"]
#: What an adjusted p value must be below to be told.
LIMIT = 0.05


def adjusted(p: ArrayLike, how: Adjustment = "benjamini-hochberg") -> FloatArray:
    """Return adjusted p values, shape (n,) as `p`.

    `bonferroni` (Holm's step-down form) bounds the chance of one false alarm or more.
    `benjamini-hochberg` bounds the expected share of false ones among those told; where nothing is
    true both bounds are the same.

    Sources: S. Holm, Scand. J. Statist. 6 (1979) 65; Y. Benjamini and Y. Hochberg, J. R. Statist.
    Soc. B 57 (1995) 289.
    """
    values = np.asarray(p, dtype=float)
    if values.size == 0:
        return values
    if how == "benjamini-hochberg":
        return np.asarray(scipy.stats.false_discovery_control(values), dtype=float)
    order = np.argsort(values)
    steps = np.maximum.accumulate(values[order] * np.arange(values.size, 0, -1))
    found = np.empty_like(values)
    found[order] = np.minimum(1.0, steps)
    return found
