"""Models compiled on free cores before they are asked for.

A search simulates the base with every effect of the table, and each of these models is compiled
once on a machine. The fit before the search works on one core and leaves the others idle.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import Context, copy_context
from functools import partial

from psa_casadi.errors import MachineError, PsaError
from psa_casadi.model.compose import Model
from psa_casadi.simulation.exact.run import why_not
from psa_casadi.simulation.side_by_side import side_by_side, threads
from psa_casadi.simulation.ways import output_of


@contextmanager
def compiled_ahead(
    models: Iterable[Model], first: Iterable[Callable[[], object]] = ()
) -> Iterator[None]:
    """Compile models for exact steps beside what runs inside, after the work that comes `first`.

    At the end, what has begun is finished and the rest is left out. What fails is tried again by
    whoever needs it, and fails there.
    """
    count = threads()
    if count == 1:
        yield
        return
    works: list[Callable[[], object]] = [*first, *(partial(_compile, m) for m in models)]
    with ThreadPoolExecutor(count - 1) as pool:
        for work in works:
            pool.submit(_in_context(copy_context(), work))
        try:
            yield
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _in_context(context: Context, work: Callable[[], object]) -> Callable[[], object]:
    return lambda: context.run(work)


def compiled(models: Iterable[Model]) -> None:
    """Compile models for exact steps on all cores; what fails is left to whoever needs it."""
    side_by_side(_compile, models)


def _compile(model: Model) -> None:
    with suppress(PsaError, MachineError):
        why_not(model.structure, output_of(model) or "")
