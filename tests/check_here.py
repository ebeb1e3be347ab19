"""The check of an FMU without a process for its code: starting that costs more than the checks do.

For FMUs of this package whose code does no harm, faulty as it may be. `tests/test_fmu.py` and
`tests/test_fmu_hostile.py` have the process.
"""

import pickle
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from psa_casadi.export.check.measured import measured
from psa_casadi.export.check.rows import CheckRow
from psa_casadi.export.check.task import Task


class Here:
    """Runs a task in this process; it gets there as it gets to the other one."""

    def rows(self, task: Task, end: float) -> list[CheckRow]:
        """Return the rows of a task."""
        there = pickle.loads(pickle.dumps(task))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # as there: what a warning leads to is in the rows
            return [row for row in measured(there) if isinstance(row, CheckRow)]


@contextmanager
def started_here(_: Iterable[str] = ()) -> Iterator[Here]:
    """Stand in for `psa_casadi.export.check.process.started`."""
    yield Here()
