"""One interrupt (Ctrl-C) ends long work: a flag that compiled code reads while it runs.

Python hands an interrupt to its main thread, and there only between two of its own instructions: a
simulation in C does not see it, nor do fits in other threads. So whoever notices it calls `stop`,
and every simulation of the same work ends with KeyboardInterrupt before its next sample. What is
left to do with the best result so far is done after `wrap_up`.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Work:
    """What one interrupt ends: everything that runs in one context, and in its threads."""

    def __init__(self) -> None:
        self._flag = ctypes.c_int(0)
        self._wrapping_up = False

    @property
    def address(self) -> int:
        """Address of the flag, for compiled code: an int that is not 0 after `stop`."""
        return ctypes.addressof(self._flag)

    @property
    def stopped(self) -> bool:
        """Whether the work is to end."""
        return bool(self._flag.value)

    def stop(self) -> None:
        """End the work, but for what is done after `wrap_up`."""
        if not self._wrapping_up:
            self._flag.value = 1

    def wrap_up(self) -> None:
        """Let what follows run in spite of the interrupt; a further one does not set the flag."""
        self._wrapping_up = True
        self._flag.value = 0


_WORK: ContextVar[Work | None] = ContextVar("work", default=None)


@contextmanager
def interruptible_work() -> Iterator[Work]:
    """Make what runs inside one work, or part of the work that it is in; also a decorator."""
    item = _WORK.get()
    if item is not None:
        yield item
        return
    token = _WORK.set(Work())
    try:
        yield current_work()
    finally:
        _WORK.reset(token)


def current_work() -> Work:
    """Return the work of this context; one that nothing ends where there is none."""
    return _WORK.get() or Work()


def flag_address() -> int | None:
    """Return the address of this work's flag for compiled code, None where there is no work."""
    item = _WORK.get()
    return None if item is None else item.address


def raise_if_stopped() -> None:
    """Raise KeyboardInterrupt where this work is to end."""
    if current_work().stopped:
        raise KeyboardInterrupt
