"""Ctrl-C: the first ends the work and keeps what there is, a second one ends all at once."""

import os
import signal
import socket
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

from psa_casadi.cli import INTERRUPTED
from psa_casadi.files import abandon
from psa_casadi.interruption import Work, interruptible_work

_SHOW_CURSOR = "\x1b[?25h"


@contextmanager
def interrupts() -> Iterator[None]:
    """Let Ctrl-C end what runs inside, compiled code and other threads too; also a decorator.

    Python's own handler waits until the main thread is back from C. Here a thread that the signal
    wakes at once sets the flag of the work (`psa_casadi.interruption`). Outside the main thread of
    a process nothing changes.
    """
    with interruptible_work() as work:
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)

        def interrupt(number: int, frame: FrameType | None) -> None:
            work.stop()  # a solver that takes the exception for its own failure ends all the same
            raise KeyboardInterrupt

        handler = signal.signal(signal.SIGINT, interrupt)
        wakeup = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        watcher = threading.Thread(target=_watch, args=(ours, work), daemon=True)
        watcher.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(wakeup)
            signal.signal(signal.SIGINT, handler)
            theirs.close()
            watcher.join()
            ours.close()


def _watch(woken: socket.socket, work: Work) -> None:
    """Stop the work at the first SIGINT, leave the process at the second; until the peer closes."""
    count = 0
    while received := woken.recv(64):
        count += received.count(signal.SIGINT)
        if count == 1:
            work.stop()
        elif count > 1:
            leave()


def kept(
    what: str, files: Iterable[Path | None], missing: Iterable[Path | None], mark: str = ""
) -> str:
    """Say what an interrupt has cut off, which files there are, and which were not written."""
    there, absent = (", ".join(str(p) for p in ps if p is not None) for ps in (files, missing))
    told = (
        f"{what}. Kept: {there}{mark}." if there else f"{what}; no -o names a file to keep it in."
    )
    return f"{told} Not written: {absent}." if absent else told


def leave() -> NoReturn:
    """End the process at once, without files that are half written or children that go on."""
    abandon()
    if sys.stderr.isatty():
        with suppress(OSError):
            os.write(2, _SHOW_CURSOR.encode())
    os._exit(INTERRUPTED)
