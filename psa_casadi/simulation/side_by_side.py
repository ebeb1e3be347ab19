"""Work that spends its time in the stepper, done on all cores by threads of one process.

The stepper does not hold Python's lock, so that threads share models and compiled libraries and
lose little to each other.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import TypeVar

from psa_casadi.interruption import interruptible_work

#: Environment variable with the number of threads; without it there is one for each core.
VARIABLE = "PSA_CASADI_THREADS"
_ALONE: ContextVar[bool] = ContextVar("one thread", default=False)
Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return the results for all items in their order; the first exception ends it.

    What has begun is finished first, what has not is left out. Context variables are the caller's.
    A keyboard interrupt ends the simulations of what has begun, too.
    """
    given, count = list(items), threads()
    if len(given) < 2 or count == 1:
        return [work(item) for item in given]
    with interruptible_work() as own, ThreadPoolExecutor(max_workers=count) as pool:
        contexts = [copy_context() for _ in given]
        try:
            return list(pool.map(lambda context, item: context.run(work, item), contexts, given))
        except KeyboardInterrupt:
            own.stop()
            raise


@contextmanager
def one_thread() -> Iterator[None]:
    """Give what runs inside one thread, as where other work fills the cores."""
    token = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(token)


def threads() -> int:
    """Return how many threads work may have: `PSA_CASADI_THREADS`, else one for each core."""
    if _ALONE.get():
        return 1
    wanted = os.environ.get(VARIABLE, "")
    return int(wanted) if wanted.isdecimal() and int(wanted) > 0 else os.cpu_count() or 1
