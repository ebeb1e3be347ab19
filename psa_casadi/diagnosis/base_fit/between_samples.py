"""What the voltage does between two samples: straight lines, or a smooth curve through them.

A simulation joins the samples of the voltage by straight lines. Where an amplifier smooths them,
chords cut the bends of a fast signal off: by u'' h^2/12 in the mean of a sampling interval h, 0.2 %
of the amplitude of a sine with 40 samples a period. A plant that answers within some intervals
shows this mean, and the error looks like a further resonance or a lag.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import trace_record
from psa_casadi.notes import Note, note
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: Standard errors by which the share of the difference that the residual holds must exceed none,
#: and how far it may be from the whole of it. Smooth plants have 0.85 to 0.98 (the base has bent
#: itself to the rest), others 0.0 +- 0.1, and residuals that hold something else -6000 to 11.
_SURE, _NEAR = 6.0, 0.25


def smooth_between(
    fit: Fit, experiments: Sequence[Experiment]
) -> tuple[tuple[Experiment, ...], Note] | None:
    """Return the experiments with the voltage moved to a smooth curve's mean, and a note; or None.

    The difference of the two displacements is fitted to what the `fit` leaves, beside all fitted
    parameters: the share of it that the residual holds is near 1 for a smooth voltage, 0 for
    straight lines. None where it is neither, or a record cannot be simulated.
    """
    try:
        pairs = enumerate(experiments)
        added = np.concatenate([_difference(fit, k, e)[e.used] for k, e in pairs])
    except PsaError:
        return None
    basis, _ = np.linalg.qr(fit.jacobian / np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-300))
    own, left = (x - basis @ (basis.T @ x) for x in (added, fit.residuals))
    power = float(own @ own)
    if power <= 0.0:
        return None
    share, error = float(own @ left) / power, float(np.sqrt(np.mean(left**2) / power))
    if not (share > _SURE * error and abs(share - 1.0) < _NEAR):
        return None
    moved = tuple(replace(e, record=_moved(e.record)) for e in experiments)
    interval = (share - 1.96 * error, share + 1.96 * error)
    return moved, note("smooth_voltage", share=share, low=interval[0], high=interval[1])


def _difference(fit: Fit, number: int, experiment: Experiment) -> FloatArray:
    """Return what a smooth voltage changes in a record's displacement (n,) [m].

    Straight lines between twice as many samples of the curve lack a quarter of it.
    """
    record, start = experiment.record, fit.start(number)
    if experiment.held_out_whole:
        return np.zeros(record.n)
    time, voltage = np.empty(2 * record.n - 1), np.empty(2 * record.n - 1)
    time[::2], time[1::2] = record.time, _middle(record.time)
    voltage[::2], voltage[1::2] = record.voltage, _middle(record.voltage) + 1.5 * _higher(record)
    finer = Record(
        name=record.name,
        time=time,
        voltage=voltage,
        load_force=_between(record, time, record.load_force),
        temperature=_between(record, time, record.temperature),
    )
    straight, smooth = (
        trace_record(fit.model, r, start, (), stop=r.n, way=fit.way, by_start=False).output
        for r in (record, finer)
    )
    return np.asarray((smooth[::2] - straight) * 4.0 / 3.0)


def _between(record: Record, time: FloatArray, column: FloatArray | None) -> FloatArray | None:
    return None if column is None else np.interp(time, record.time, column)


def _middle(values: FloatArray) -> FloatArray:
    return 0.5 * (values[1:] + values[:-1])


def _higher(record: Record) -> FloatArray:
    """Return by how much the mean of a smooth curve is above each straight line, (n - 1,) [V].

    A parabola with the second derivative c has a mean that is higher by -h^2 c/12, and is higher by
    1.5 times that in the middle. At a sample, c is the median of the second differences there and
    on either side: a corner has none.
    """
    step = np.diff(record.time)
    bends = np.zeros(record.n + 2)
    bends[2:-2] = np.diff(np.diff(record.voltage) / step) / _middle(step)
    bends = np.median([bends[:-2], bends[1:-1], bends[2:]], axis=0)
    return np.asarray(-(step**2) * _middle(bends) / 12.0)


def _moved(record: Record) -> Record:
    """Return a record whose straight lines have the mean of a smooth curve in each interval.

    A sample is moved by the mean of the intervals on its sides.
    """
    higher = _higher(record)
    beside = np.concatenate([higher[:1], _middle(higher), higher[-1:]])
    return replace(record, voltage=record.voltage + beside)
