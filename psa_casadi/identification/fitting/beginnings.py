"""Where records begin that are held out whole, of which no fit sees a sample.

The stack begins as in the fitted records of the device that begin at the same voltage: what the
first tenth of a record tells of its memories is mostly the model's own error there. A loop that is
simulated from it drifts off by a tenth of the range, where one that begins as the device's other
records do stays within a hundredth. Where no fitted record begins alike, the first tenth finds the
whole start. States of drive, sensor and environment belong to the record, and the first tenth finds
them, too; but it hardly tells a charge that leaks slowly from the sensor's offset, and what it
leaves open grows along the record. So such a state is looked for within the size that it has where
the fitted records begin which begin alike (their root mean square is its prior).
"""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.levenberg_marquardt import Evaluate, minimise
from psa_casadi.identification.fitting.prediction import measured, trace_record
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import Way

FloatArray = npt.NDArray[np.float64]

#: First voltages that differ by less than this share of the records' range are the same.
_SAME = 0.01
#: Coordinates of a start are of order 1: smaller than this none is known.
_LEAST = 1e-6
#: How far the start is sought in the first tenth.
_EVALUATIONS, _TOLERANCE = 30, 1e-5


def beginnings(
    model: Model,
    unknowns: Unknowns,
    theta: FloatArray,
    experiments: Sequence[Experiment],
    level: float,
    way: Way,
) -> FloatArray:
    """Return theta with start and offset of the records that are held out whole; others stay.

    `model` has the values of theta; `level` [m] is that of white noise which tells as little as
    what the model misses. Raises PsaError where a record cannot be simulated.
    """
    found = theta.copy()
    own = {s.name for c in model.components if c.belongs_to != "plant" for s in c.states}
    for k, experiment in enumerate(experiments):
        if not experiment.held_out_whole or not experiment.known.any():
            continue
        first, last = unknowns.first(k), unknowns.first(k + 1)
        found[first:last] = 0.0
        told = _told(unknowns, theta, experiments, k)
        shared = {c: told[c] for c in told if unknowns.started[k][c - first] not in own}
        found[list(shared)] = [float(np.mean(v)) for v in shared.values()]
        sizes = {c: float(unknowns.prior[c]) for c in range(first, last) if c not in shared}
        for c in sizes.keys() & told.keys():
            size = float(np.sqrt(np.mean(np.square(told[c]))))
            sizes[c] = min(sizes[c], max(size, _LEAST))
        found[list(sizes)] = _sought(model, unknowns, found, experiment, k, level, sizes, way)
    return found


def _told(
    unknowns: Unknowns, theta: FloatArray, experiments: Sequence[Experiment], k: int
) -> dict[int, list[float]]:
    """Return what the fitted records that begin as record k does tell of its start's coordinates.

    One value for each of these records, by the coordinate's place.
    """
    first = unknowns.first(k)
    size = max(float(np.ptp(e.record.voltage)) for e in experiments)
    begins = [float(e.record.voltage[0]) for e in experiments]
    alike = [
        j
        for j, other in enumerate(experiments)
        if not other.held_out_whole and abs(begins[j] - begins[k]) <= _SAME * size
    ]
    found = {
        first + place: [
            float(theta[_place(unknowns, j, name)]) for j in alike if name in unknowns.started[j]
        ]
        for place, name in enumerate(unknowns.started[k])
    }
    return {c: values for c, values in found.items() if values}


def _place(unknowns: Unknowns, record: int, name: str) -> int:
    return unknowns.first(record) + unknowns.started[record].index(name)


def _sought(
    model: Model,
    unknowns: Unknowns,
    theta: FloatArray,
    experiment: Experiment,
    k: int,
    level: float,
    sizes: Mapping[int, float],
    way: Way,
) -> FloatArray:
    """Return the coordinates of record k with which its first tenth fits best, of such sizes."""
    known, columns = np.flatnonzero(experiment.known), list(sizes)
    stop = int(known[-1]) + 1
    y, prior = measured(experiment.record)[known], 1.0 / np.array(list(sizes.values()))

    def evaluate(own: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        there = theta.copy()
        there[columns] = own
        try:
            run = trace_record(
                model, experiment.record, unknowns.start(there, k), (), stop=stop, way=way
            )
        except PsaError:
            return None
        by_start, by_offset = unknowns.place_slopes(there, k)
        slopes = (run.sensitivity @ by_start + by_offset)[known][:, columns] / level
        missed = (run.output[known] + unknowns.offset(there, k) - y) / level
        return np.concatenate([missed, own * prior]), np.vstack([slopes, np.diag(prior)])

    return _minimum(evaluate, len(columns))


def _minimum(evaluate: Evaluate, size: int) -> FloatArray:
    """Return where the search ends; the last coordinate is the offset, exactly linear."""
    free = np.full(size, np.inf)
    found = minimise(
        evaluate,
        np.zeros(size),
        (-free, free),
        tolerance=_TOLERANCE,
        evaluations=_EVALUATIONS,
        linear=(size - 1,),
    )
    if found is None:
        raise PsaError("A held-out record cannot be simulated from where the others begin.")
    return found.theta
