"""Linear algebra runs on one thread within a fit, and as before after it."""

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from psa_casadi.simulation.one_thread import one_thread_of_algebra


def _threads() -> set[int]:
    np.eye(2) @ np.eye(2)  # there is a library to ask
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@one_thread_of_algebra()
def _within() -> set[int]:
    return _threads()


def test_the_number_of_threads_is_restored() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        before = _threads()
        with one_thread_of_algebra():
            assert _threads() == {1}
            assert _within() == {1}
            assert _threads() == {1}
        assert _threads() == before
