"""Where a voltage turns."""

import numpy as np
import numpy.typing as npt

from psa_casadi.units import FloatArray


def reversals(voltage: FloatArray, threshold: float | None = None) -> npt.NDArray[np.int64]:
    """Return the samples at which the voltage turns and comes back by more than `threshold` [V].

    Without a threshold it is 1e-4 of the range, which is taken for noise.
    """
    threshold = 1e-4 * float(np.ptp(voltage)) if threshold is None else threshold
    step = np.diff(voltage)
    moving = np.flatnonzero(step)
    up = step[moving] > 0
    places = np.r_[0, moving[np.flatnonzero(up[1:] != up[:-1])] + 1, voltage.size - 1]
    turns: list[int] = []
    direction, extreme, level = 0, 0, float(voltage[0])
    for k, v in zip(places.tolist(), voltage[places].tolist(), strict=True):
        change = v - level
        if direction == 0:
            if abs(change) > threshold:
                direction, extreme, level = (1 if change > 0 else -1), k, v
        elif change * direction > 0:
            extreme, level = k, v
        elif -change * direction > threshold:
            turns.append(extreme)
            direction, extreme, level = -direction, k, v
    return np.array(turns, dtype=np.int64)
