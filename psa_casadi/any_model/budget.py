"""The error budget of any model: what each cause removes of the base's held-out error.

Shares are of the power above the noise, outputs over their noise, with the intervals of a stack's
budget (`psa_casadi.diagnosis.held_out`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.runs import Run, counted
from psa_casadi.diagnosis.held_out import Removed, Share

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class OdeBudget:
    """Where the held-out error of the base model above the noise goes.

    `together` is what all causes remove, `causes` what each does beside the others (the model
    fitted again without it leaves so much more), `unnamed` what a free function would remove.
    """

    together: Share
    causes: tuple[Share, ...]
    unnamed: Share | None = None


def removed_from(
    runs: Sequence[Run], outputs: Sequence[int], base: Sequence[FloatArray], noise: Sequence[float]
) -> Removed:
    """Return what models remove of a base's held-out error in the given outputs of a model.

    `base` are its predictions (n, ny) of all runs, `noise` is the rms of each output's noise in the
    output's unit.
    """
    return Removed(partial(_judged_errors, runs, tuple(outputs)), base, tuple(noise))


def _judged_errors(
    runs: Sequence[Run], outputs: Sequence[int], predicted: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return the errors (n, outputs) where any output is judged, else nan.

    An output of which no sample is held out is judged by its fitted ones.
    """
    parts = []
    told = zip(*(counted(runs, j) for j in outputs), strict=True)
    for r, y, own in zip(runs, predicted, told, strict=True):
        which = np.column_stack(own)
        errors = np.where(which, r.errors(y)[:, outputs], np.nan)
        parts.append(errors[which.any(axis=1)])
    return parts
