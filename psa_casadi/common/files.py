"""Output files that are written whole or not at all, and what does not outlive its process.

What a block made goes when the block ends; `abandon` removes all of it at once, and ends all child
processes, for a process that has to stop. What a killed process left goes with the next one
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

from psa_casadi.common.children import end_children, once_all_are_started
from psa_casadi.common.errors import InputError

if sys.platform != "win32":
    import fcntl

#: What the names of all temporary folders and half-written files begin with.
PREFIX = ".psa_casadi-"
#: Age [s] after which a thing that cannot be locked counts as left.
_OLD = 7 * 86400.0
#: Characters of a name after the prefix and the random part; a file system takes 255 bytes, a
#: letter up to 4.
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

    def make(path: Path) -> None:
        path.mkdir(mode=0o700)
        path.chmod(0o700)  # whatever the umask is

    with _made(place, "", make) as path:
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
        except (FileExistsError, FileNotFoundError):  # the name is taken, or was swept at once
            if place.is_dir():
                continue
            raise
        _MADE.add(path)
        try:
            with contextlib.suppress(BlockingIOError, FileNotFoundError):
                lock = _lock(path)
                if path.exists():
                    return path, lock
        except OSError:  # where the umask lets nobody open it
            _remove(path)
            raise
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


#: Files that were written, in their order.
_WRITTEN: list[Path] = []


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path in the folder of `path` to write to; it replaces `path` if the block ends well.

    If the block raises, or the process is killed, a file that stood at `path` stays as it was. What
    the block wrote is removed, after a kill by the next that writes to the folder. A link is
    followed. A device or a pipe (`/dev/stdout`) cannot be replaced and is yielded itself.

    Raises:
        InputError: `path` cannot be written to, with the reason.
    """
    reason = why_not_written(path)
    if reason:
        raise InputError(reason)
    target = Path(path).resolve()
    try:
        if target.exists() and not target.is_file():
            yield target
            return
        with temporary_file(target.parent, target.name) as temporary:
            yield temporary
            if target.exists():
                temporary.chmod(target.stat().st_mode & 0o777)
            replace_durably(temporary, target)
            _WRITTEN.append(Path(path))
    except BrokenPipeError:  # who read it has gone
        raise
    except OSError as error:
        raise InputError(
            f"{path}: cannot write ({error.strerror or error}); choose another place or free this"
            " one."
        ) from error


def written() -> tuple[Path, ...]:
    """Return the files that this process has written whole, by the names that callers gave."""
    return tuple(_WRITTEN)


def atomic_write(path: str | os.PathLike[str], data: str | bytes) -> None:
    """Write `data` to `path`, whole or not at all; text is written as UTF-8, line ends unchanged.

    Raises:
        InputError: `path` cannot be written to, or the text cannot be, with the reason.
    """
    try:
        content = data.encode() if isinstance(data, str) else data
    except UnicodeEncodeError as error:
        code = ord(error.object[error.start])
        raise InputError(
            f"{path}: cannot write, the text has the character U+{code:04X}, which UTF-8 does not"
            " have; remove it from names and descriptions."
        ) from error
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def why_not_written(path: str | os.PathLike[str]) -> str | None:
    """Return a sentence on why no file can stand at `path`; None where one can."""
    try:
        target = Path(path).resolve()
        if target.is_dir():
            return f"{path}: cannot write, this is a directory; name a file in it."
        if not target.parent.is_dir():
            return (
                f"{path}: cannot write, the directory {target.parent} does not exist; create it"
                " first."
            )
        target.exists()
    except (OSError, RuntimeError) as error:  # a name too long; links that lead in a circle
        reason = error.strerror if isinstance(error, OSError) else error
        return f"{path}: cannot write ({reason}); choose another name."
    return None


def make_folder(path: str | os.PathLike[str]) -> None:
    """Make a folder and those above it, where they are not there; InputError where that fails."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(
            f"{path}: cannot be created, there is a file of that name; name another folder."
        ) from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be created ({error.strerror}); name another folder."
        ) from error


def why_not_read(error: Exception) -> str:
    """Return in words why a file could not be read."""
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    if isinstance(error, UnicodeDecodeError):
        return "it is no text in UTF-8"
    reason = error.strerror if isinstance(error, OSError) else None
    return reason.lower() if reason else str(error)


def replace_durably(temporary: Path, target: Path) -> None:
    """Put a written file in the place of another, so that a power cut leaves one of them whole."""
    with temporary.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(temporary, target)
