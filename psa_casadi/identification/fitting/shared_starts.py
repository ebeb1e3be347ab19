"""Where held-out records begin: as the fitted ones of the device that begin at the same voltage.

What the first tenth of a record tells of its memories is mostly the model's own error there: a loop
that is simulated from it drifts off by a tenth of the range, where one that begins as the device's
other records do stays within a hundredth.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: First voltages that differ by less than this share of the records' range are the same.
_SAME = 0.01


def shared_starts(
    model: Model, unknowns: Unknowns, theta: FloatArray, experiments: Sequence[Experiment]
) -> tuple[FloatArray, tuple[int, ...]]:
    """Return theta with shared starts, and the records that have one.

    A record that is held out as a whole has the mean start, in the coordinates of the fit, of the
    fitted records whose voltage begins alike. States of drive, sensor and environment stay its own.
    """
    ranges = [float(np.ptp(e.record.voltage)) for e in experiments]
    own = {s.name for c in model.components if c.belongs_to != "plant" for s in c.states}
    first = [float(e.record.voltage[0]) for e in experiments]
    found, moved = theta.copy(), []
    for k, experiment in enumerate(experiments):
        if not experiment.held_out_whole:
            continue
        alike = [
            j
            for j, other in enumerate(experiments)
            if not other.held_out_whole and abs(first[j] - first[k]) <= _SAME * max(ranges)
        ]
        names = [n for n in unknowns.started[k] if n not in own]
        if not alike or not names or not experiment.used.any():
            continue
        moved.append(k)
        for name in names:
            with_it = [j for j in alike if name in unknowns.started[j]]
            if with_it:
                found[_place(unknowns, k, name)] = np.mean(
                    [theta[_place(unknowns, j, name)] for j in with_it]
                )
    return found, tuple(moved)


def _place(unknowns: Unknowns, record: int, name: str) -> int:
    return unknowns.first(record) + unknowns.started[record].index(name)
