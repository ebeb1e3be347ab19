"""Which noise a fitted model leaves of every output of its records."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.noise import runs_of
from psa_casadi.records.noise_kinds import NoiseFound, noise_kinds
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Signals
from psa_casadi.records.split import Experiment
from psa_casadi.records.suspects import SPIKE
from psa_casadi.units import BoolArray, FloatArray


def noise_found(
    fit: Fit, experiments: Sequence[Experiment], arguments: Sequence[Record | Signals] = ()
) -> tuple[NoiseFound, ...]:
    """Return the kinds of noise in every output of every record, fitted and held-out samples.

    The noise is that of the samples as they were measured, not of averages or without outliers; the
    prediction is a straight line between those of the experiments' samples. The model is simulated
    once more. Raises SimulationError where it cannot be.
    """
    result = list[NoiseFound]()
    for e, displayed in zip(experiments, fit.shown(experiments), strict=True):
        times = e.record.time
        whole = next((r for r in arguments if _holds(r, e)), e.record)
        inside = (whole.time >= times[0]) & (whole.time <= times[-1])
        time = whole.time[inside]
        named = [c for n in fit.model.input_names if (c := whole.column(n)) is not None]
        moving = [u[inside] for u in named if np.isfinite(u).all() and np.ptp(u[inside]) > 0.0]
        near = np.searchsorted(0.5 * (times[1:] + times[:-1]), time)
        for j, channel in enumerate(e.channels):
            reading = whole.column(channel.column)
            if reading is None or not np.isfinite(displayed[:, j]).any():
                continue
            y = np.interp(time, times, displayed[:, j])
            inputs = sorted(moving, key=lambda u: -_correlation(u, y))
            used = _used(e, j)[near]
            kinds = noise_kinds(time, reading[inside], y, inputs, used)
            result.append(NoiseFound(e.record.name, channel.column, channel.unit, kinds))
    return tuple(result)


def _holds(record: Record | Signals, e: Experiment) -> bool:
    """Whether an experiment's record was made of a record: of its file, within its time."""
    starts, ends = e.record.time[0], e.record.time[-1]
    within = record.time[0] <= starts and ends <= record.time[-1]
    return bool(record.sha256 == e.record.sha256 and within)


def _used(e: Experiment, channel: int) -> BoolArray:
    """Return the samples (n,) that are fitted or judged, and outliers that are masked there."""
    used = e.at(channel, e.used | e.held_out)
    for start, stop in runs_of(~used):
        used[start:stop] = stop - start <= SPIKE
    return used


def _correlation(u: FloatArray, y: FloatArray) -> float:
    """Return the size of the correlation of an input with an output (n,), 0 where there is none."""
    return abs(float(np.corrcoef(u, y)[0, 1])) if np.ptp(y) > 0.0 and np.ptp(u) > 0.0 else 0.0
