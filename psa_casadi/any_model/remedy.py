"""What a cause changes of a model's outputs along its own records."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from psa_casadi.any_model.fit import OdeFit
from psa_casadi.any_model.runs import Run
from psa_casadi.component import Component
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.errors import PsaError


def changes(effect: Component, fit: OdeFit, runs: Sequence[Run]) -> tuple[Size, ...]:
    """Return by how much an effect changes each measured output within a record, at most.

    It is the range of the difference of two runs from the same start, with the effect and with its
    gain at 0; nothing where the latter cannot be simulated.
    """
    without = replace(fit, model=fit.model.with_values({effect.gain or "": 0.0}))
    try:
        moved = [
            np.ptp(a - b, axis=0)
            for a, b in zip(fit.predicted(runs), without.predicted(runs), strict=True)
        ]
    except PsaError:
        return ()
    most, longest = np.max(moved, axis=0), max(float(np.ptp(r.time)) for r in runs)
    outputs = fit.model.structure.outputs
    return tuple(
        Size("record", float(most[k]), outputs[k].unit, None, longest, "s", None, output=o.column)
        for k, o in zip(fit.places, fit.outputs, strict=True)
    )
