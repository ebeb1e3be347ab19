"""What a command stands on: its streams, the signals that end it, what the machine can refuse."""

import atexit
import contextlib
import errno
import io
import os
import sys
import tempfile

from psa_casadi.cache import sweep_rooms
from psa_casadi.files import answer_requests_to_end, temporary_folder

#: What the operating system refuses: what happened, and what to do.
_REFUSALS = {
    errno.ENOSPC: (
        "the disk is full",
        "free some space, or choose another disk (TMPDIR names that of temporary files)",
    ),
    errno.EROFS: ("the disk may only be read", "choose a place that may be written to"),
    errno.EACCES: ("the system denies access", "change its permissions, or choose another place"),
    errno.EPERM: ("the system denies access", "change its permissions, or choose another place"),
    errno.EMFILE: ("too many files are open", "raise the limit (ulimit -n)"),
    errno.ENFILE: ("too many files are open", "close other programs"),
    errno.EFBIG: ("a file is larger than may be", "raise the limit (ulimit -f)"),
    errno.ENAMETOOLONG: ("a file's name is too long", "choose a shorter name or folder"),
    errno.ENOMEM: ("there is too little memory", "close other programs, or raise its limit"),
    errno.EAGAIN: ("no more processes may be started", "close others, or raise the limit"),
    errno.EIO: ("the disk reports a fault", "choose another one"),
}
if sys.platform != "win32":
    _REFUSALS[errno.EDQUOT] = ("the user's share of the disk is full", "free some space")
_MEMORY = ("bad_alloc", "failed to map segment", "Cannot allocate memory", "cannot allocate memory")


def prepare() -> None:
    """Give a command streams that can be written to, and an end that leaves nothing behind."""
    _open_streams()
    answer_requests_to_end()
    _take_temporary_folder()
    sweep_rooms()


def _open_streams() -> None:
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: the next file that is opened would take its place
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):  # letters that it lacks; stderr spells them out
        sys.stdout.reconfigure(errors="replace")


def _take_temporary_folder() -> None:
    """Let all temporary files, those of other packages and programs too, lie in a folder of ours.

    Where none can be made, the first to need one says so.
    """
    with contextlib.suppress(OSError):
        held = contextlib.ExitStack()
        folder = str(held.enter_context(temporary_folder()))
        atexit.register(held.close)
        tempfile.tempdir = os.environ["TMPDIR"] = folder


def silence() -> None:
    """Let what is still to be written vanish: nobody reads it any more."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            os.dup2(nowhere, stream.fileno())


def refused_by_the_machine(error: BaseException) -> str | None:
    """Return what the machine refused and what to do; None where the error is not of this kind."""
    said = str(error)
    if isinstance(error, MemoryError) or any(word in said for word in _MEMORY):
        return (
            "there is too little memory; close other programs, raise the limit (ulimit -v), or give"
            " fewer or shorter records."
        )
    if isinstance(error, OSError) and "No usable temporary directory" in said:
        return "there is no folder for temporary files; set TMPDIR to one that may be written to."
    if isinstance(error, OSError) and error.errno in _REFUSALS:
        what, cure = _REFUSALS[error.errno]
        where = f" ({error.filename})" if error.filename else ""
        return f"{what}{where}; {cure}."
    if isinstance(error, RuntimeError) and "can't start new thread" in said:
        return "no more threads may be started; close other programs, or raise the limit."
    if isinstance(error, ImportError) and not (error.name or "").startswith("psa_casadi"):
        return (
            f"the installation is not complete ({said}); install psa_casadi again with what it"
            " needs."
        )
    return None
