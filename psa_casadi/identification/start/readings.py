"""Readings from which nothing can be identified: of one or two values, or hardly any that count."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.record import FEWEST_SAMPLES, Record

#: Numbers whose squares would overflow.
_LARGEST = 1e30

_STUCK = (
    "But for stuck readings, the displacement is one value: the sensor is out of its range, or"
    " another column holds its readings (--columns displacement=...)."
)
_FEW = (
    "Only {} of {} readings of the displacement count, too few for a fit, which needs {}; record"
    " again, with the sensor in its range throughout."
)
_STILL = (
    "The displacement is {:.6g} m throughout: the sensor is out of its range or was not connected,"
    " or another column holds its readings (--columns displacement=...)."
)
_HARDLY = (
    "Only {} readings of the displacement differ from {:.6g} m, too few for a fit, which needs {}:"
    " the sensor is out of its range nearly throughout. Record again, with the sensor in its range."
)
_TWO = (
    "The displacement has two values only, {:.6g} and {:.6g} m: that is a switch, or a sensor whose"
    " step is as large as the motion, and nothing of a stack can be identified from it. Record it"
    " with a finer sensor, or name another column (--columns displacement=...)."
)


def refuse_stuck(records: Sequence[Record]) -> None:
    """Raise InputError where no displacement that counts changes."""
    if not any(r.mask.any() and r.range_m > 0.0 for r in records):
        raise InputError([_STUCK])


def refuse_still(records: Sequence[Record]) -> None:
    """Raise InputError where displacements, as they were read, have one or two values."""
    for name, columns in (
        ("displacement", [measured(r)[r.mask] for r in records]),
        ("voltage", [r.voltage for r in records]),
    ):
        largest = max(float(np.max(np.abs(c), initial=0.0)) for c in columns)
        if largest > _LARGEST:
            raise InputError(
                [f"The {name} reaches {largest:.2g}: that is no reading; correct the column."]
            )
    values = [np.unique(measured(r)[r.mask]) for r in records]
    if all(v.size <= 1 for v in values):
        raise InputError([_STILL.format(values[0][0])])
    if all(v.size <= 2 for v in values):
        raise InputError([_TWO.format(*max(values, key=np.ptp))])


def _usual(records: Sequence[Record]) -> tuple[float, int]:
    """Return the reading that is there most often in a record, and how many are others in all."""
    usual, most, others = 0.0, 0, 0
    for r in records:
        values, counts = np.unique(measured(r)[r.mask], return_counts=True)
        if counts.size:
            others += int(counts.sum() - counts.max())
            if counts.max() > most:
                usual, most = float(values[np.argmax(counts)]), int(counts.max())
    return usual, others


def refuse_few(given: Sequence[Record], kept: Sequence[Record], said: Sequence[str]) -> None:
    """Raise InputError where masking left hardly a reading; `said` is what it was done for."""
    before, after = (sum(int(r.mask.sum()) for r in records) for records in (given, kept))
    if after < min(before, FEWEST_SAMPLES):
        raise InputError([*said, _FEW.format(after, before, FEWEST_SAMPLES)])
    usual, others = _usual(kept)
    if others < min(after, FEWEST_SAMPLES):
        raise InputError([*said, _HARDLY.format(others, usual, FEWEST_SAMPLES)])
