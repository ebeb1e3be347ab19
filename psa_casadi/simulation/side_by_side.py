"""Work that spends its time in the stepper, done on all cores by threads of one process.

The stepper does not hold Python's lock, so that threads share models and compiled libraries and
lose little to each other.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar, copy_context
from functools import partial
from typing import TypeVar

from threadpoolctl import threadpool_limits

from psa_casadi.common.errors import MachineError, PsaError
from psa_casadi.common.interruption import interruptible_work, set_within
from psa_casadi.model.compose import Model
from psa_casadi.simulation.exact.run import why_not
from psa_casadi.simulation.simulate import output_of
from psa_casadi.simulation.stepper import make_ready

#: Environment variable with the number of threads; without it there is one for each core.
VARIABLE = "PSA_CASADI_THREADS"
_ALONE: ContextVar[bool] = ContextVar("one thread", default=False)
Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return the results for all items in their order; the first exception ends it.

    Work that has started is finished first, other work is left out. Context variables are the
    caller's. A keyboard interrupt ends the simulations of work that has started, too.
    """
    inputs, count = list(items), threads()
    if len(inputs) < 2 or count == 1:
        return [work(item) for item in inputs]
    with interruptible_work() as part, ThreadPoolExecutor(max_workers=count) as pool:
        contexts = [copy_context() for _ in inputs]
        try:
            return list(pool.map(lambda context, item: context.run(work, item), contexts, inputs))
        except KeyboardInterrupt:
            part.stop()
            raise


def one_thread() -> AbstractContextManager[bool]:
    """Give work in the block one thread, for use where other work fills the cores."""
    return set_within(_ALONE, True)


def threads() -> int:
    """Return how many threads work may have: `PSA_CASADI_THREADS`, else one for each core."""
    if _ALONE.get():
        return 1
    wanted = os.environ.get(VARIABLE, "")
    return int(wanted) if wanted.isdecimal() and int(wanted) > 0 else os.cpu_count() or 1


@contextmanager
def one_thread_of_algebra() -> Iterator[None]:
    """Keep the linear algebra of the process on one thread; also a decorator."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


@contextmanager
def compiled_ahead(
    models: Iterable[Model], first: Iterable[Callable[[], object]] = ()
) -> Iterator[None]:
    """Compile models while the block runs, after the work that comes `first` (see `compiled`).

    At the end, compilations that have started finish and the rest is left out. What fails is tried
    again by whoever needs it, and fails there.
    """
    count = threads()
    if count == 1:
        yield
        return
    works: list[Callable[[], object]] = [*first, *(partial(_compile, m) for m in models)]
    with ThreadPoolExecutor(count - 1) as pool:
        for work in works:
            pool.submit(copy_context().run, work)
        try:
            yield
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def compiled(models: Iterable[Model]) -> None:
    """Compile models on all cores: exact steps of what they show, or else the stepper.

    That is the displacement, of models that have none every output. What fails is left to whoever
    needs it.
    """
    side_by_side(_compile, models)


def _compile(model: Model) -> None:
    text = output_of(model)
    with suppress(PsaError, MachineError):
        if why_not(model.structure, model.output_names if text is None else (text,)):
            make_ready(model)
