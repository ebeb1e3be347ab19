"""The check of an FMU without a process for its code: starting that costs more than the checks do.

For FMUs of this package whose code does no harm, faulty as it may be.
`tests/export/test_fmu.py` and `tests/export/test_fmu_hostile.py` have the process.
"""

import pickle
import warnings

from psa_casadi.export.check.apart import Task, checks_of
from psa_casadi.export.check.rows import CheckRow


def rows_here(task: Task, _: float) -> list[CheckRow]:
    """Stand in for `apart.rows_apart`; the task gets here as it gets there."""
    there = pickle.loads(pickle.dumps(task))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as there: what a warning leads to is in the rows
        return [check.row() for check in checks_of(there)]
