"""Parts of held-out samples: records, or blocks of them; and the jackknife over these."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import scipy

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Held-out records from which on they are the parts; else so many blocks of each are.
FEWEST_RECORDS, _BLOCKS = 4, 8


def parts_of(*errors: Sequence[FloatArray]) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Return sums of squares (parts, models, outputs) and sample counts (parts, outputs).

    `errors` holds of every model the held-out errors (n, outputs) of every record, nan where an
    output is not judged. The parts are the records that have any, where there are at least four,
    else eight blocks of each.
    """
    rows = [own for own in zip(*errors, strict=True) if len(own[0])]
    if len(rows) < FEWEST_RECORDS:
        rows = [
            block
            for own in rows
            for block in zip(*(np.array_split(e, _BLOCKS) for e in own), strict=True)
            if len(block[0])
        ]
    outputs = errors[0][0].shape[1]
    judged = [~np.isnan(np.array(row)).all(axis=0) for row in rows]
    sums = [
        [np.sum(e**2, axis=0, where=there) for e in row]
        for row, there in zip(rows, judged, strict=True)
    ]
    counts = np.array([there.sum(axis=0) for there in judged], dtype=np.int64)
    return np.reshape(sums, (-1, len(errors), outputs)), counts.reshape(-1, outputs)


def jackknife(of: Callable[[BoolArray], float], every: BoolArray) -> tuple[float, float]:
    """Return a figure over all parts, and the half width of its 95 % interval.

    With L the figure over all of k parts and L_i that without part i it is
    L +- t_(k-1) sqrt((k-1)/k sum (L_i - mean)^2) (Efron and Tibshirani 1993, chapter 11).
    """
    k = len(every)
    if k < 2:
        return of(every), 0.0
    without = [of(every & (np.arange(k) != i)) for i in range(k)]
    spread = float(np.sqrt((k - 1) * np.var(without)))
    return of(every), float(scipy.special.stdtrit(k - 1, 0.975)) * spread
