"""Expressions are made by one thread at a time.

CasADi lets other threads run while it works, and counts who holds a node of an expression without a
lock: two threads that make expressions at once may end the process.
"""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_ONE = RLock()


def in_turn(work: Callable[P, R]) -> Callable[P, R]:
    """Return work on expressions that waits until no other thread is at such work."""

    @wraps(work)
    def alone(*inputs: P.args, **words: P.kwargs) -> R:
        with _ONE:
            return work(*inputs, **words)

    return alone
