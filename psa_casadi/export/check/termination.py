"""A request to end is answered after folders and processes are removed, not before."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

#: Requests to end that a process is sent, where the system has them; Ctrl-C raises by itself.
_REQUESTS = ("SIGTERM", "SIGHUP", "SIGBREAK")


@contextmanager
def cleaned_up() -> Iterator[None]:
    """Let a request to end leave the block as SystemExit, so that what it holds is removed.

    In the main thread, and where nobody else handles the request; elsewhere nothing changes.
    """
    numbers = [getattr(signal, name) for name in _REQUESTS if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    numbers = [n for n in numbers if signal.getsignal(n) == signal.SIG_DFL]

    def leave(number: int, _frame: FrameType | None) -> None:
        for other in numbers:  # once is enough
            signal.signal(other, signal.SIG_IGN)
        raise SystemExit(128 + number)

    for number in numbers:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
