"""Child processes that do not outlive this one: programs, and Pythons for what may crash.

Each leads a process group and is killed with that group when the block that started it ends, or by
`end_children`, for a process that has to stop.
"""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from psa_casadi.common.errors import MachineError
from psa_casadi.common.interruption import raise_if_stopped

Child = subprocess.Popen[bytes]

#: Time [s] between two looks whether the work is to end.
_LOOK = 0.1
#: Linux: what `prctl` calls the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1

_CHILDREN: set[Child] = set()
#: A token for each child that is being started; functions to call when all are among the children.
_STARTING: set[object] = set()
_WAITING: list[Callable[[], None]] = []


@contextmanager
def started(
    command: Sequence[str],
    *,
    directory: Path | None = None,
    environment: Mapping[str, str] | None = None,
) -> Iterator[Child]:
    """Start a program with pipes for its three streams; it and its group are killed afterwards.

    Raises:
        OSError: the program cannot be started.
    """
    start = object()
    _STARTING.add(start)
    try:
        child = subprocess.Popen(
            command, cwd=directory, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        _CHILDREN.add(child)
    finally:
        _STARTING.discard(start)
        if _WAITING and not _STARTING:
            _WAITING[0]()
    try:
        yield child
    finally:
        _CHILDREN.discard(child)
        kill(child)
        child.wait()


@contextmanager
def started_python(
    module: str, *arguments: str, directory: Path | None = None, **variables: str
) -> Iterator[Child]:
    """Start a module of the package in a Python like this one, with `variables` of environment.

    Raises:
        MachineError: it cannot be started.
    """
    root = str(Path(__file__).resolve().parents[2])
    # without "", the current folder: a file there must not replace a module
    paths = os.pathsep.join(os.path.abspath(p) for p in (*sys.path, root) if p)
    command = [sys.executable, "-P", "-m", module, *arguments]
    environment = {**os.environ, "PYTHONPATH": paths, **variables}
    with contextlib.ExitStack() as held:
        try:
            child = held.enter_context(
                started(command, directory=directory, environment=environment)
            )
        except OSError as error:
            raise MachineError(
                f"A second Python cannot be started ({error.strerror}); see that"
                f" {sys.executable or 'the interpreter'} can be run."
            ) from error
        yield child


def end_with_parent() -> None:
    """Let this process, a child, end when the one that started it does; on Linux only."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def heard(child: Child, *, limit: float | None = None) -> subprocess.CompletedProcess[bytes]:
    """Return what a child writes on its two streams until it ends.

    It gets only its arguments: a pipe that is full when the first wait ends is never
    written to again (CPython 3.11 to 3.13).

    Raises:
        KeyboardInterrupt: this work is to end.
        subprocess.TimeoutExpired: it took longer than `limit` [s].
    """
    end = time.monotonic() + limit if limit is not None else None
    try:
        while True:
            try:
                streams = child.communicate(timeout=_LOOK)
            except subprocess.TimeoutExpired:
                raise_if_stopped()
                if end is not None and time.monotonic() > end:
                    raise
            else:
                return subprocess.CompletedProcess(child.args, child.returncode, *streams)
    finally:
        kill(child)
        close_pipes(child)


def run_child(
    command: Sequence[str], *, directory: Path, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[bytes]:
    """Run a program to its end; it and its children are killed if this process does not wait.

    Raises:
        KeyboardInterrupt: this work is to end.
        OSError: the program cannot be started.
    """
    with started(command, directory=directory, environment=environment) as child:
        return heard(child)


def once_all_are_started(act: Callable[[], None]) -> None:
    """Act when every child is known to `end_children`: at once, or when the last has started.

    For what a signal asks: it may come between the start of a child and the next line.
    """
    _WAITING.append(act)
    if not _STARTING:
        act()


def end_children() -> None:
    """Kill all children that run."""
    for child in list(_CHILDREN):
        kill(child)


def interrupt(child: "subprocess.Popen[Any]") -> None:
    """Ask a child to end and keep what it has, as Ctrl-C does; where that is unknown, kill it."""
    if sys.platform == "win32":
        kill(child)
    elif child.returncode is None:
        with contextlib.suppress(OSError):
            os.kill(child.pid, signal.SIGINT)


def kill(child: "subprocess.Popen[Any]") -> None:
    """Kill a child with its group, unless it has ended: its number may be another's afterwards."""
    if child.returncode is None:
        kill_group(child)


def kill_group(child: "subprocess.Popen[Any]") -> None:
    """Kill a child and those it has started, whether it has ended or not."""
    with contextlib.suppress(OSError):
        if sys.platform == "win32":
            child.kill()
        else:
            os.killpg(child.pid, signal.SIGKILL)


def close_pipes(child: Child) -> None:
    """Close the pipes to a child; what it has not taken is lost."""
    for pipe in (child.stdin, child.stdout, child.stderr):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()
