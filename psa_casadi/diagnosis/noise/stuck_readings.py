"""Readings that a sensor repeats while the fitted model moves on: seen only beside a model."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.split import Experiment

#: Robust standard deviations of the residual from which on a repeated reading is the sensor's.
_FAR = 6.0
#: Share of repeated readings from which on the sensor's count is so coarse that they say nothing.
_RARE = 0.2


def without_stuck_readings(
    experiments: Sequence[Experiment], fit: Fit
) -> tuple[tuple[Experiment, ...], int]:
    """Return the experiments without repeated readings far from a fit, and how many these are.

    Noise repeats a reading by chance here and there; where that is also far from the model, which
    the record alone cannot tell from a stack that is late, the sensor was stuck.
    """
    kept, count = [], 0
    for e, predicted in zip(experiments, fit.predicted(experiments), strict=True):
        y = measured(e.record)
        residual = np.abs(y - predicted)
        again = np.r_[False, np.diff(y) == 0.0]
        noise = 1.4826 * float(np.nanmedian(residual))
        far = residual > _FAR * noise
        bad = again & far if np.mean(again) < _RARE else np.zeros_like(again)
        count += int(np.count_nonzero(bad))
        given = e.record.displacement
        record = e.record
        if given is not None and bad.any():
            record = replace(record, displacement=np.where(bad, np.nan, given))
        kept.append(replace(e, record=record, used=e.used & ~bad, held_out=e.held_out & ~bad))
    return tuple(kept), count
