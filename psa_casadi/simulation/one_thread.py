"""Linear algebra on one thread while fits run side by side.

The matrices of a fit are thin: the threads of a linear algebra library gain nothing with them and
wait in loops for the next product, which takes the cores from the fits. On one thread the rounding
does not depend on the machine's cores either.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def one_thread_of_algebra() -> Iterator[None]:
    """Keep the linear algebra of the process on one thread; also a decorator."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield
