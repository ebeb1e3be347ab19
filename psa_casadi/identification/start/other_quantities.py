"""Columns that hold no displacement: one that wraps round, its rate, its integral."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.record import FEWEST_SAMPLES, Record
from psa_casadi.units import FloatArray

#: Correlation with the voltage from which on a column holds what is correlated.
_FOLLOWS = 0.95
#: A step over the range, between two samples, that is a wrap, and by how much wraps may differ.
_STEP, _ALIKE = 0.5, 0.2
#: Shares of the readings below whose voltage the sign is turned.
_TURNS = np.arange(0.02, 0.99, 0.02)
#: Fewest wraps.
_WRAPS = 2

_WRAPPED = (
    "Record '{}': the displacement jumps {} times by {:.4g} {}, up or down, and follows the voltage"
    " without these jumps: the sensor, or its counter, begins again at the end of its range. Add"
    " the jumps up (numpy.unwrap with period={:.4g}), or record with a larger range."
)
_OTHER = (
    "Record '{}': the {} the displacement follows the voltage (correlation {:.3f}), the"
    " displacement itself does not ({:.3f}): the column may hold {} it."
)
_TURNED = (
    "Record '{}': with its sign turned below {:.4g} V the displacement follows the voltage"
    " (correlation {:.3f}), as it is it does not ({:.3f}): it may be rectified."
)


def refuse_wrapped(records: Sequence[Record]) -> None:
    """Raise InputError where a displacement begins again at the end of the sensor's range."""
    problems = [s for r in records if (s := _wrapped(r))]
    if problems:
        raise InputError(problems)


def _wrapped(record: Record) -> str:
    """Say that all large steps of a displacement are alike, and that it is right without them."""
    y, v = _readings(record)
    steps = np.diff(y)
    large = np.abs(steps) > _STEP * np.ptp(y)
    if np.count_nonzero(large) < _WRAPS:
        return ""
    period = float(np.median(np.abs(steps[large])))
    if np.any(np.abs(np.abs(steps[large]) - period) > _ALIKE * period):
        return ""
    turns = np.r_[0, np.cumsum(np.where(large, -np.sign(steps), 0.0))].astype(int)
    if y.size - np.max(np.unique(turns, return_counts=True)[1]) < FEWEST_SAMPLES:  # a stray reading
        return ""
    added = period * turns
    if abs(_correlation(y + added, v)) < _FOLLOWS or abs(_correlation(y, v)) > _FOLLOWS:
        return ""
    scale, unit = (1e6, "um") if record.displacement_unit == "m" else (1.0, "counts")
    count = int(np.count_nonzero(large))
    return _WRAPPED.format(record.name, count, scale * period, unit, scale * period)


def doubtful_quantity(records: Sequence[Record]) -> str:
    """Say that a rate, an integral, or the sign turned below a voltage follows it better; else "".

    A stack behind a lag that is long beside the voltage's changes looks so too. Nothing is said of
    a record of which less than half is read: what it shows may follow the rate by itself.
    """
    return next((s for r in records if (s := _rate_or_integral(r) or _rectified(r))), "")


def _rate_or_integral(record: Record) -> str:
    y, v = _readings(record)
    if 2 * y.size < record.n or abs(own := _correlation(y, v)) > _FOLLOWS:
        return ""
    step = np.diff(record.time[record.mask])
    rate = _correlation(np.diff(y) / step, 0.5 * (v[1:] + v[:-1]))
    if abs(rate) > _FOLLOWS:
        return _OTHER.format(record.name, "rate of", rate, own, "an integral of")
    line = np.column_stack([np.ones(step.size), np.cumsum(step)])
    both = np.column_stack([np.cumsum(0.5 * (y[1:] + y[:-1]) * step), v[1:]])
    summed, moved = (both - line @ np.linalg.lstsq(line, both, rcond=None)[0]).T
    integral = _correlation(summed, moved)
    if abs(integral) > _FOLLOWS:
        return _OTHER.format(record.name, "integral of", integral, own, "the rate of")
    return ""


def _rectified(record: Record) -> str:
    """Say that a displacement follows the voltage where its sign is turned below one voltage."""
    y, v = _readings(record)
    if 2 * y.size < record.n or abs(own := _correlation(y, v)) > _FOLLOWS:
        return ""
    turned = [(abs(_correlation(np.where(v < u, -y, y), v)), u) for u in np.quantile(v, _TURNS)]
    found, at = max(turned)
    return _TURNED.format(record.name, at, found, own) if found > _FOLLOWS else ""


def _readings(record: Record) -> tuple[FloatArray, FloatArray]:
    mask: NDArray[np.bool_] = record.mask
    return measured(record)[mask], record.voltage[mask]


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - np.mean(a), b - np.mean(b)
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / power**0.5 if power > 0.0 else 0.0
