"""The process that runs the foreign code of an FMU: `python -m psa_casadi.export.check.child`.

While its task is made ready it imports the modules that its arguments name.
It reads a task from stdin and writes records to what was its stdout; what the foreign code prints
goes to stderr. Its memory and time are limited, and it ends when the process that started it does.
"""

import faulthandler
import importlib
import os
import pickle
import sys

from psa_casadi.children import end_with_parent
from psa_casadi.export.check.measured import measured
from psa_casadi.export.check.memory import limit_data
from psa_casadi.export.check.records import Writer
from psa_casadi.export.check.task import Task

#: How much longer than the limit of a check it lives [s] if nobody ends it.
_GRACE = 30.0


def main() -> None:
    """Run the checks of one task."""
    records = os.dup(1)
    os.dup2(2, 1)
    end_with_parent()
    for name in sys.argv[1:]:
        importlib.import_module(name)
    task: Task = pickle.load(sys.stdin.buffer)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    limit_data(task.limits.memory)
    writer = Writer(records, task.key)
    try:
        for record in measured(task):
            faulthandler.dump_traceback_later(task.limits.timeout + _GRACE, exit=True)
            writer.write(record)
    except MemoryError:
        writer.out_of_memory()
        raise
    writer.end()


if __name__ == "__main__":
    main()
