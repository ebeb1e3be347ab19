"""Runs of samples for which something holds."""

import numpy as np
from numpy.typing import NDArray


def runs_of(found: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first sample of every run of True in (n,), and the one behind its last, (k,)."""
    edges = np.flatnonzero(np.diff(np.r_[False, found, False].astype(np.int8)))
    return edges[::2], edges[1::2]
