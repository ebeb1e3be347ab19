"""Training and held-out samples of a record: the last part is held out, whole segments together."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.experiment.record import Record

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: Share of every record that is held out when no record is named for it.
HELD_OUT_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class Experiment:
    """A record with the samples that count for a fit (`used`) and those held out for judging it."""

    record: Record
    used: BoolArray
    held_out: BoolArray

    @property
    def stop(self) -> int:
        """One past the last used sample: a fit need not simulate further."""
        return int(np.flatnonzero(self.used)[-1]) + 1


def whole(record: Record) -> Experiment:
    """Return the experiment that uses every valid sample of a record and holds out none."""
    return Experiment(record, record.mask, np.zeros(record.n, dtype=bool))


def split(record: Record, share: float = HELD_OUT_SHARE) -> Experiment:
    """Hold out the last `share` of a record, from the voltage reversal nearest to that point on.

    A segment between two reversals is never cut, unless no reversal lies within a tenth of the
    record around the point.
    """
    point = round((1.0 - share) * record.n)
    turns = reversals(record.voltage)
    near = turns[np.abs(turns - point) <= 0.1 * record.n]
    if len(near):
        point = int(near[np.argmin(np.abs(near - point))])
    before = np.arange(record.n) < point
    return Experiment(record, record.mask & before, record.mask & ~before)


def reversals(voltage: FloatArray) -> npt.NDArray[np.int64]:
    """Return the samples at which the voltage turns, noise of 1e-4 of its range aside."""
    threshold = 1e-4 * float(np.ptp(voltage))
    turns, direction, extreme = [], 0, 0
    for k, v in enumerate(voltage):
        change = v - voltage[extreme]
        if direction == 0:
            if abs(change) > threshold:
                direction, extreme = (1 if change > 0 else -1), k
        elif change * direction > 0:
            extreme = k
        elif -change * direction > threshold:
            turns.append(extreme)
            direction, extreme = -direction, k
    return np.array(turns, dtype=np.int64)
