"""The user's cache of what takes long to make; what in it is damaged or not the user's is not used.

A checksum file lies next to every file. If the cache cannot be used, a folder that
goes with this process replaces it, and one line warns of it.
"""

import atexit
import errno
import functools
import hashlib
import logging
import os
import platform
import shutil
import stat
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

from psa_casadi.common.files import replace_durably, sweep, temporary_folder

#: Environment variable that names another folder.
VARIABLE = "PSA_CASADI_CACHE"
#: Rooms that could not be used or written to; nothing more is written there.
_REFUSED: set[Path] = set()


def cache_directory() -> Path:
    """Return the user's cache folder; `PSA_CASADI_CACHE` overrides it. It may not exist yet.

    A user without a home gets a folder that goes with this process.
    """
    try:
        return _wanted()
    except RuntimeError:
        return _private()


def _wanted() -> Path:
    """Return the cache that the user wants; raises RuntimeError for one without a home."""
    if override := os.environ.get(VARIABLE):
        return Path(override).absolute()
    if platform.system() == "Windows":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif platform.system() == "Darwin":
        base = Path.home() / "Library" / "Caches"
    else:  # XDG base directory specification
        base = Path(os.environ.get("XDG_CACHE_HOME", ""))
        base = base if base.is_absolute() else Path.home() / ".cache"
    return base / "psa_casadi"


def cached(
    room: str,
    name: str,
    make: Callable[[Path], Path],
    usable: Callable[[Path], object] = lambda path: None,
) -> Path:
    """Return the path of a file of the cache, made where it is not there, damaged or not ours.

    `make` writes it into an empty folder and returns its path there; `usable` raises OSError where
    it cannot be used. Raises what `make` raises, and OSError if the file can be kept nowhere.
    """
    wanted = cache_directory() / room
    try:
        return _found_or_made(wanted, name, make, usable)
    except OSError as error:
        _refuse(wanted, error)
    return _found_or_made(_private() / room, name, make, usable)


def sweep_rooms() -> None:
    """Remove what dead processes left in the folders of the cache."""
    with suppress(OSError, RuntimeError):
        for room in _wanted().iterdir():
            if room.is_dir() and not room.is_symlink():
                sweep(room)


def writable_room(room: str) -> Path:
    """Return a folder of the cache that can be written to.

    Raises:
        OSError: there is none.
    """
    wanted = cache_directory() / room
    try:
        _make_ours(wanted)
        with temporary_folder(wanted):
            return wanted
    except OSError as error:
        _refuse(wanted, error)
    _make_ours(_private() / room)
    return _private() / room


@functools.cache
def _private() -> Path:
    """Return a folder for this process, removed when it ends."""
    held, process = ExitStack(), os.getpid()
    folder = held.enter_context(temporary_folder())
    atexit.register(lambda: held.close() if os.getpid() == process else None)
    return folder


def _refuse(room: Path, error: OSError) -> None:
    if room not in _REFUSED:
        _REFUSED.add(room)
        logging.getLogger("psa_casadi").warning(
            "The cache folder %s cannot be used (%s); what it would keep is made again each time."
            " Free it, or set %s to another folder.",
            room,
            error.strerror or error,
            VARIABLE,
        )


def _found_or_made(
    room: Path, name: str, make: Callable[[Path], Path], usable: Callable[[Path], object]
) -> Path:
    path, others = room / name, room / f"{name}.sha256"
    _make_ours(room)
    try:
        whole = _read(others) == _checksum(name, _read(path))
    except OSError:
        whole = False
    if not whole:
        if room in _REFUSED:
            raise OSError(errno.EACCES, "not written to any more", str(room))
        with temporary_folder(room) as work:
            made = make(work)
            checksum = made.with_name(others.name)
            checksum.write_bytes(_checksum(name, made.read_bytes()))
            for source, target in ((checksum, others), (made, path)):
                if target.is_dir() and not target.is_symlink():
                    shutil.rmtree(target)
                source.chmod(0o700)
                replace_durably(source, target)
    usable(path)
    return path


def _read(path: Path) -> bytes:
    """Return what is in a file; raise OSError where others may have written it."""
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "no plain file", str(path))
    _demand_ours(path, status)
    return path.read_bytes()


def _checksum(name: str, content: bytes) -> bytes:
    """Return the checksum of a file under its name: one under another's name is damaged too."""
    return hashlib.sha256(name.encode() + b"\0" + content).hexdigest().encode()


def _make_ours(room: Path) -> None:
    """Make a room of the cache; raise OSError where others may write to it, or to what holds it."""
    for folder in (room.parent, room):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _demand_ours(room.parent, room.parent.stat(), sticky=True)
    for status in (room.lstat(), room.stat()):
        _demand_ours(room, status)


def _demand_ours(path: Path, status: os.stat_result, *, sticky: bool = False) -> None:
    """Demand that none but the user and root can have changed a file or folder (POSIX only).

    In a `sticky` folder others may make files, and leave those of the user alone.
    """
    if os.name != "posix" or (stat.S_ISLNK(status.st_mode) and status.st_uid == os.geteuid()):
        return
    if status.st_uid not in (0, os.geteuid()):
        raise OSError(errno.EPERM, f"{path.name} belongs to another user", str(path))
    shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    if shared and not (sticky and status.st_mode & stat.S_ISVTX):
        raise OSError(errno.EPERM, f"others may write to {path.name}", str(path))
