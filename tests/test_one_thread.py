"""Linear algebra runs on one thread within a fit; work beside it on as many as are wanted."""

import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from psa_casadi.simulation.side_by_side import VARIABLE, one_thread_of_algebra, side_by_side


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


@pytest.mark.parametrize(("wanted", "own"), [("1", True), ("2", False), ("many", False)])
def test_work_has_the_threads_that_are_wanted(
    wanted: str, own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is no number counts as nothing said: a thread for each core."""
    monkeypatch.setattr("os.cpu_count", lambda: 3)
    monkeypatch.setenv(VARIABLE, wanted)
    found = side_by_side(lambda _: threading.get_ident(), range(3))
    assert (set(found) == {threading.get_ident()}) == own
