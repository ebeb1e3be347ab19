"""Temporary folders and half-written files that do not outlive their process.

What a block made goes when the block ends; `abandon` removes all of it at once, and ends all child
processes, for a process that is told to stop. What a killed process left goes with the next one
that writes to the same place: a process holds a lock on each thing it made, and the operating
system frees the lock when it dies. Where there are no locks (Windows, some network drives), what is
older than a week counts as left.
"""

import contextlib
import os
import secrets
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from psa_casadi.children import end_children, once_all_are_started

if sys.platform != "win32":
    import fcntl

#: What the names of all temporary folders and half-written files begin with.
PREFIX = ".psa_casadi-"
#: Age [s] after which a thing that cannot be locked counts as left.
_OLD = 7 * 86400.0
#: A name beside the prefix and the random part; a file system takes 255 bytes, a letter up to 4.
_LONGEST = 50
#: Requests to end that a process is sent, where the system has them; Ctrl-C raises by itself.
_REQUESTS = ("SIGTERM", "SIGHUP", "SIGBREAK")

_MADE: set[Path] = set()
_SWEPT: set[Path] = set()


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Yield a new folder that only this user can read, in `parent` or the system's place for them.

    Raises:
        OSError: the folder cannot be made.
    """
    place = Path(tempfile.gettempdir()) if parent is None else parent
    with _made(place, "", lambda path: path.mkdir(mode=0o700)) as path:
        yield path


@contextmanager
def temporary_file(place: Path, name: str) -> Iterator[Path]:
    """Yield a new empty file in a folder, whose name ends as `name` does; it may be renamed.

    Raises:
        OSError: the file cannot be made.
    """
    with _made(place, f"-{name[-_LONGEST:]}", lambda path: path.touch(exist_ok=False)) as path:
        yield path


def abandon() -> None:
    """End all child processes and remove all that this process made and would have removed."""
    end_children()
    for _ in range(20):  # a child may write once more until it is gone
        for path in list(_MADE):
            _remove(path)
        if not any(path.exists() for path in list(_MADE)):
            break
        time.sleep(0.01)


def answer_requests_to_end() -> tuple[int, ...]:
    """Let a request to end find nothing left behind; return the signals that are answered so.

    The process then ends at once, with the exit code of one that a signal ended; threads that
    compute are not waited for. Only in the main thread, and where nobody else answers the signal.
    """
    if threading.current_thread() is not threading.main_thread():
        return ()
    numbers = [getattr(signal, name) for name in _REQUESTS if hasattr(signal, name)]
    taken = tuple(n for n in numbers if signal.getsignal(n) is signal.SIG_DFL)
    for number in taken:
        signal.signal(number, _end)
    return taken


@contextmanager
def requests_to_end_answered() -> Iterator[None]:
    """Answer requests to end while the block runs, for a process that does not do so itself."""
    taken = answer_requests_to_end()
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def _end(number: int, _: FrameType | None) -> None:
    def leave() -> None:
        abandon()
        os._exit(128 + number)

    once_all_are_started(leave)


def sweep(place: Path) -> None:
    """Remove what dead processes left in a folder, once in the life of this process."""
    if place in _SWEPT:
        return
    _SWEPT.add(place)
    with contextlib.suppress(OSError), os.scandir(place) as entries:
        for entry in entries:
            if entry.name.startswith(PREFIX) and not entry.is_symlink():
                _remove_if_left(Path(entry.path))


@contextmanager
def _made(place: Path, ending: str, make: Callable[[Path], None]) -> Iterator[Path]:
    """Make a thing of a random name, hold its lock, and remove it after the block."""
    sweep(place)
    path, lock = _locked(place, ending, make)
    try:
        yield path
    finally:
        _remove(path)
        _MADE.discard(path)
        if lock is not None:
            os.close(lock)


def _locked(place: Path, ending: str, make: Callable[[Path], None]) -> tuple[Path, int | None]:
    while True:
        path = place / f"{PREFIX}{secrets.token_hex(4)}{ending}"
        try:
            make(path)
        except FileExistsError:
            continue
        _MADE.add(path)
        with contextlib.suppress(BlockingIOError, FileNotFoundError):
            lock = _lock(path)
            if path.exists():
                return path, lock
        _MADE.discard(path)  # another process took it for left before it was locked


def _lock(path: Path) -> int | None:
    """Return a descriptor that holds the lock of a file or folder; None where there are no locks.

    Raises BlockingIOError where another process holds it, FileNotFoundError where it is gone.
    """
    if sys.platform == "win32":
        return None
    how = os.O_RDONLY if path.is_dir() else os.O_RDWR  # a network drive locks what is written to
    descriptor = os.open(path, how | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _remove_if_left(path: Path) -> None:
    with contextlib.suppress(OSError):
        status = path.lstat()
        if sys.platform != "win32" and status.st_uid != os.geteuid():
            return
        lock = _lock(path)
        if lock is not None:
            _remove(path)
            os.close(lock)
        elif time.time() - status.st_mtime > _OLD:
            _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()
