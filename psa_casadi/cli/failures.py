"""How a command ends: 2 for the user's input, 1 for everything else, 130 for Ctrl-C."""

import atexit
import errno
import functools
import io
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, ParamSpec

import typer

from psa_casadi.cli import INTERRUPTED
from psa_casadi.cli.screen import print_message, show_written
from psa_casadi.common.cache import sweep_rooms
from psa_casadi.common.characters import plain
from psa_casadi.common.errors import InputError, MachineError, PsaError
from psa_casadi.common.files import (
    abandon,
    answer_requests_to_end,
    atomic_write,
    temporary_folder,
    written,
)
from psa_casadi.common.interruption import Work, interruptible_work

_SHOW_CURSOR = "\x1b[?25h"


@contextmanager
def interrupts() -> Iterator[None]:
    """Let Ctrl-C end what runs inside, compiled code and other threads too; also a decorator.

    Python's handler waits until the main thread is back from C. Here a thread that the signal
    wakes at once sets the flag of the work (`psa_casadi.common.interruption`). Outside the main
    thread of a process nothing changes.
    """
    with interruptible_work() as work:
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)

        def interrupt(number: int, frame: FrameType | None) -> None:
            work.stop()  # a solver that takes the exception for its failure ends all the same
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


@dataclass
class Outputs:
    """The files that a command writes, by option; None where one is not wanted."""

    named: Mapping[str, Path | None]
    done: list[Path] = field(default_factory=list)

    def write(self, option: str, writer: Callable[[Path], object]) -> None:
        """Write the file of an option, if it is wanted and not there yet."""
        path = self.named[option]
        if path is not None and path not in self.done:
            writer(path)
            self.done.append(path)

    def cut_off(self, what: str, mark: str = "") -> KeyboardInterrupt:
        """Return an interrupt that names what it cut off, what is there and what is missing."""
        missing = ", ".join(str(p) for p in self.named.values() if p and p not in self.done)
        there = ", ".join(map(str, self.done))
        kept = f". Kept: {there}{mark}." if there else "; no -o names a file to keep it in."
        return KeyboardInterrupt(f"{what}{kept}{f' Not written: {missing}.' if missing else ''}")


def leave() -> NoReturn:
    """End the process at once, without files that are half written or children that go on."""
    abandon()
    if sys.stderr.isatty():
        with suppress(OSError):
            os.write(2, _SHOW_CURSOR.encode())
    os._exit(INTERRUPTED)


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
    """Give a command streams that can be written to, and an end that leaves nothing behind.

    All temporary files, those of other packages and programs too, lie in a folder of ours. Where
    none can be made, the first to need one fails.
    """
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: the next file that is opened would take its place
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):  # letters that it lacks; stderr spells them out
        sys.stdout.reconfigure(errors="replace")
    answer_requests_to_end()
    with suppress(OSError):
        held = ExitStack()
        folder = str(held.enter_context(temporary_folder()))
        atexit.register(held.close)
        tempfile.tempdir = os.environ["TMPDIR"] = folder
    sweep_rooms()


def _refused_by_the_machine(error: Exception) -> str | None:
    """Return what the machine refused and what to do; None where the error is not of this kind."""
    message = str(error)
    if isinstance(error, MemoryError) or any(word in message for word in _MEMORY):
        return (
            "there is too little memory; close other programs, raise the limit (ulimit -v), or give"
            " fewer or shorter records."
        )
    if isinstance(error, OSError) and "No usable temporary directory" in message:
        return "there is no folder for temporary files; set TMPDIR to one that may be written to."
    if isinstance(error, OSError) and error.errno in _REFUSALS:
        what, cure = _REFUSALS[error.errno]
        where = f" ({error.filename})" if error.filename else ""
        return f"{what}{where}; {cure}."
    if isinstance(error, RuntimeError) and "can't start new thread" in message:
        return "no more threads may be started; close other programs, or raise the limit."
    if isinstance(error, ImportError) and not (error.name or "").startswith("psa_casadi"):
        return (
            f"the installation is not complete ({message}); install psa_casadi again with what it"
            " needs."
        )
    return None


P = ParamSpec("P")

#: Set in the environment, this variable lets a failure end with its traceback.
DEBUG = "PSA_CASADI_DEBUG"
#: The message if the folder that the command runs in was removed.
_NOWHERE = "The folder that this runs in is not there any more; change to another one, as by `cd`."


def guarded(command: Callable[P, None]) -> Callable[P, None]:
    """Return the command with its errors as sentences, without a traceback.

    Exit code 2: what the user gave cannot be used; every mistake is listed. Exit code 1: a failure
    that is not the user's. 130: interrupted; the message names what was kept. `--junit` gets an
    error as a failed test.
    """

    @functools.wraps(command)
    def run(*args: P.args, **options: P.kwargs) -> None:
        before, began = len(written()), time.perf_counter()
        try:
            with interrupts():
                command(*args, **options)
        except (typer.Exit, typer.Abort):
            raise
        except BrokenPipeError as error:  # nobody reads any more what is still to be written
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError, ValueError):
                    os.dup2(nowhere, stream.fileno())
            raise typer.Exit(1) from error
        except KeyboardInterrupt as stop:
            there = ", ".join(dict.fromkeys(str(p) for p in written()[before:]))
            none = "there was no result yet, so nothing was kept."
            kept_files = f"written before: {there}." if there else none
            print_message(f"Interrupted: {str(stop) or kept_files}")
            raise typer.Exit(INTERRUPTED) from None
        except Exception as error:
            if os.environ.get(DEBUG):
                raise
            cause = InputError(_NOWHERE) if _is_nowhere(error) else error
            lines = _error_lines(cause)
            for line in lines:
                print_message(line)
            if options.get("junit"):
                _error_to_junit(command.__name__, options, lines, began)
            raise typer.Exit(2 if isinstance(cause, InputError) else 1) from error

    return run


def _is_nowhere(error: Exception) -> bool:
    """Whether an error comes from a working folder that was removed."""
    try:
        Path.cwd()
    except FileNotFoundError:
        return isinstance(error, FileNotFoundError)
    return False


def _error_lines(error: Exception) -> list[str]:
    """Return the message of an error."""
    if isinstance(error, InputError):
        if len(error.problems) == 1:
            return [f"Error: {error.problems[0]}"]
        count = sum(not p.startswith("... and") for p in error.problems)
        each = (f"  - {problem}" for problem in error.problems)
        return [f"Error: {count} problems with the input:", *each]
    if isinstance(error, (PsaError, MachineError)):
        return [f"Failed: {error}"]
    fault = (
        f"an unexpected {type(error).__name__} ({error}). This is a fault of psa_casadi, not of the"
        f" input; set {DEBUG}=1 to see where it happened, and report it."
    )
    return [f"Failed: {_refused_by_the_machine(error) or fault}"]


@dataclass(frozen=True)
class Case:
    """One test: its name, its result, and why it failed, "" where it passed."""

    name: str
    result: str
    failure: str = ""


def junit_text(command: str, subject: str, cases: Sequence[Case], seconds: float) -> str:
    """Return JUnit XML: one suite of the `command` on its `subject`, which took `seconds`.

    The elements and attributes are those that Jenkins' schema and GitLab's and GitHub's readers
    share: counts in `testsuites` and `testsuite`, `failure` with a message, `system-out`.
    """
    from xml.etree import ElementTree

    counts = {
        "name": plain(f"psa {command} {subject}"),
        "tests": str(len(cases)),
        "failures": str(sum(bool(c.failure) for c in cases)),
        "errors": "0",
        "time": f"{seconds:.3f}",
    }
    suites = ElementTree.Element("testsuites", counts)
    suite = ElementTree.SubElement(suites, "testsuite", {**counts, "skipped": "0"})
    for case in cases:
        attributes = {"classname": plain(f"psa.{command}.{subject}"), "name": plain(case.name)}
        test = ElementTree.SubElement(suite, "testcase", attributes)
        if case.failure:
            failure = {"message": plain(case.failure), "type": "failure"}
            ElementTree.SubElement(test, "failure", failure).text = plain(case.failure)
        ElementTree.SubElement(test, "system-out").text = plain(case.result)
    ElementTree.indent(suites)
    return ElementTree.tostring(suites, encoding="unicode", xml_declaration=True) + "\n"


def _error_to_junit(
    command: str, options: Mapping[str, Any], lines: Sequence[str], began: float
) -> None:
    """Write an error to the file of --junit: no older result stays there.

    A file that is there and no JUnit is left as it is: it may be named by mistake.
    """
    junit = options["junit"]
    with suppress(OSError, PsaError):
        if not junit.exists() or b"<testsuites" in junit.read_bytes()[:200]:
            subject = ", ".join(p.name for p in options.get("records") or [options["fmu"]])
            case = Case("run", "", "\n".join(lines))
            seconds = time.perf_counter() - began
            atomic_write(junit, junit_text(command, subject, [case], seconds))


def judge(
    command: str,
    subject: str,
    cases: Sequence[Case],
    junit: Path | None,
    began: float,
    *,
    show_failures: bool = False,
) -> None:
    """Write the checks of a subject as JUnit tests, if a file is named; end with 1 if one failed.

    `began` is the start of the command, of `time.perf_counter`; `show_failures` prints failures.
    """
    if junit is not None:
        atomic_write(junit, junit_text(command, subject, cases, time.perf_counter() - began))
        show_written(junit)
    failures = [case.failure for case in cases if case.failure]
    for failure in failures if show_failures else ():
        print_message(f"Not as expected: {failure}")
    if failures:
        raise typer.Exit(1)
