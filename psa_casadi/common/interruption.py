"""One interrupt (Ctrl-C) ends long work: a flag that compiled code reads while it runs.

Python hands an interrupt to its main thread, and there only between two Python instructions: a
simulation in C does not see it, nor do fits in other threads. So whoever notices it calls `stop`,
and every simulation of the same work ends with KeyboardInterrupt before its next sample. What is
left to do with the best result so far is done after `wrap_up`.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

T = TypeVar("T")


@contextmanager
def set_within(variable: ContextVar[Any], value: T) -> Iterator[T]:
    """Set a context variable while the block runs, and yield its value."""
    token = variable.set(value)
    try:
        yield value
    finally:
        variable.reset(token)


class Work:
    """What one interrupt ends: everything that runs in one context, and in its threads.

    `flag` is an int for compiled code that is not 0 after `stop`.
    """

    def __init__(self) -> None:
        self.flag = ctypes.c_int(0)
        self._wrapping_up = False

    @property
    def stopped(self) -> bool:
        """Whether the work is to end."""
        return bool(self.flag.value)

    def stop(self) -> None:
        """End the work, but for what is done after `wrap_up`."""
        if not self._wrapping_up:
            self.flag.value = 1

    def wrap_up(self) -> None:
        """Let what follows run in spite of the interrupt; a further one does not set the flag."""
        self._wrapping_up = True
        self.flag.value = 0


_WORK: ContextVar[Work | None] = ContextVar("work", default=None)


@contextmanager
def interruptible_work() -> Iterator[Work]:
    """Make what runs inside one work, or part of the work that it is in; also a decorator."""
    work = _WORK.get()
    if work is not None:
        yield work
        return
    with set_within(_WORK, Work()) as work:
        yield work


def current_work() -> Work:
    """Return the work of this context; one that nothing ends where there is none."""
    return _WORK.get() or Work()


def flag_address() -> int | None:
    """Return the address of this work's flag for compiled code, None without work."""
    work = _WORK.get()
    return None if work is None else ctypes.addressof(work.flag)


def raise_if_stopped() -> None:
    """Raise KeyboardInterrupt where this work is to end."""
    if current_work().stopped:
        raise KeyboardInterrupt
