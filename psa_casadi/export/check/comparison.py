"""Trajectories of an FMU against those that its model must give."""

import numpy as np

from psa_casadi.export.check.rows import CheckRow
from psa_casadi.export.check.truth import Run, Truth
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.masters import co_simulate, integrate


def compare(fmu: Fmu, truth: Truth, run: Run) -> CheckRow:
    """Return the row of one run: the largest difference over the scale, and which output has it."""
    names = truth.compared
    if run.integrated:
        found = integrate(fmu, run.times, run.inputs, names, tolerance=run.tolerance or run.limit)
    else:
        found = co_simulate(
            fmu, run.times, run.inputs, names, tolerance=run.tolerance, settled=truth.settled
        )
    error = np.max(np.abs(found - run.expected), axis=0) / (
        truth.scale if run.scale is None else run.scale
    )
    worst = int(np.argmax(error))
    largest = float(error[worst])
    remark = f"largest in {names[worst]}, against the {run.by or truth.by}"
    return CheckRow(run.name, largest, run.limit, largest <= run.limit, remark)
