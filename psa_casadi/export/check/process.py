"""The foreign code of an FMU runs in a process of its own; this one starts, watches and ends it."""

import os
import pickle
import queue
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import IO

from psa_casadi.children import Child, close_pipes, kill_group, started_python
from psa_casadi.errors import PsaError
from psa_casadi.export.check.memory import nearly_full
from psa_casadi.export.check.records import CLOSED, Reader, SpoiltError
from psa_casadi.export.check.rows import CheckRow, stopped
from psa_casadi.export.check.task import Task
from psa_casadi.scratch import temporary_folder

#: The module that runs there.
_CHILD = "psa_casadi.export.check.child"
#: The row that is there only if the process ends badly outside of any check.
OUTSIDE = "process ends"
#: How often its memory is looked at [s], and from which share of the limit it counts as reached.
_LOOK, _FULL = 0.02, 0.9
#: What is said of checks that do not come to an end.
OVERTIME = (
    "did not come back within the time limit of {:g} s of the whole check (--timeout sets it)"
)
#: How long a process may live that cannot tell anything any more, and its pipes after its end [s].
_LAST_WORDS = 2.0
_CHUNK, _MOST_BYTES, _KEPT = 1 << 16, 1 << 24, 2048


@dataclass
class Process:
    """A process that waits for its task; `said` is the end of what it printed."""

    process: Child
    said: bytes = b""
    _chunks: queue.Queue[bytes] = field(default_factory=queue.Queue)
    _threads: list[threading.Thread] = field(default_factory=list)
    _group_ended: bool = False

    def rows(self, task: Task, end: float) -> list[CheckRow]:
        """Give it the task; return the rows it finished, and how it ended unless that was well.

        `end` is when it ends at the latest, as `time.monotonic` tells it.

        Raises PsaError if it did not come as far as the code of the FMU.
        """
        reader = Reader(task.key)
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._pump, self._drain)
        ]
        for thread in self._threads:
            thread.start()
        self._give(task)
        problem = self._watched(reader, task, end)
        self.end()
        if not problem:
            return reader.rows
        said = self.said.decode(errors="replace").strip()[-300:]
        remark = f"{problem}; the last it printed: {said}" if said else problem
        if not reader.rows and not reader.begun:  # nothing of the FMU has run
            raise PsaError(f"The process for the code of the FMU did not start: {remark}.")
        return [*reader.rows, stopped(reader.begun or OUTSIDE, remark)]

    def _give(self, task: Task) -> None:
        """Pass the task on; a process that is gone already shows when its records are read."""
        pipe, data = _pipe(self.process.stdin), memoryview(pickle.dumps(task))
        with suppress(OSError):
            while data:
                data = data[pipe.write(data) :]
        with suppress(OSError):
            pipe.close()

    def _watched(self, reader: Reader, task: Task, end: float) -> str:
        """Read records until the process ends; return what was wrong, "" if nothing was."""
        try:
            closed, full = self._followed(reader, end)
            reader.close()
        except SpoiltError as error:
            return f"the FMU disturbed the channel of the results: {error}"
        if self.process.poll() is None and closed:
            return "the FMU disturbed the channel of the results: it was closed"
        if self.process.poll() is None:
            return f"the FMU {OVERTIME.format(task.limits.timeout)}"
        full = full or reader.without_memory
        return self._ended(reader, f"{task.limits.memory / 2**20:.0f} MiB" if full else "")

    def _followed(self, reader: Reader, end: float) -> tuple[bool, bool]:
        """Read records up to the end of the process, of the pipe or of the time.

        Return whether the pipe was closed, and whether the memory was full.
        """
        closed, full = False, False
        while time.monotonic() < end and not (closed and self.process.poll() is not None):
            full = full or nearly_full(self.process.pid, _FULL)
            chunk = self._chunk()
            if chunk:
                reader.feed(chunk)
            if self.process.poll() is not None:
                self._end_group()
            if (chunk == b"" and not closed) or self.process.poll() is not None:
                end = min(end, time.monotonic() + _LAST_WORDS)
            closed = closed or chunk == b""
        return closed, full

    def _ended(self, reader: Reader, memory: str) -> str:
        """Return what was wrong with a process that ended by itself."""
        code = self.process.returncode
        if code == 0 and reader.complete:
            return ""
        if memory:
            return f"the FMU reached the memory limit of {memory} (--memory sets it)"
        if code == CLOSED:
            return "the FMU disturbed the channel of the results: it was closed"
        if code < 0:
            return f"the FMU ended its process by the signal {_signal_name(-code)}"
        shown = f"{code:#x}" if code > 255 else str(code)  # Windows tells faults by such codes
        when = "when it was unloaded" if reader.complete else "before the checks were done"
        return f"the FMU ended its process with exit code {shown} {when}"

    def _chunk(self) -> bytes | None:
        """Return the next bytes, b"" at their end, None if there are none now."""
        with suppress(queue.Empty):
            return self._chunks.get(timeout=_LOOK)
        return None

    def _pump(self) -> None:
        """Pass on what comes, up to a bound: more is no sequence of records."""
        total = 0
        while total < _MOST_BYTES and (data := _read(self.process.stdout)):
            self._chunks.put(data)
            total += len(data)
        self._chunks.put(b"")

    def _drain(self) -> None:
        """Keep the end of what is printed, so that nobody waits for a full pipe."""
        while data := _read(self.process.stderr):
            self.said = (self.said + data)[-_KEPT:]

    def end(self) -> None:
        """End the process and those it started in its group; harmless when called twice."""
        self._end_group()
        self.process.kill()
        self.process.wait()
        for thread in self._threads:  # a process that left the group may hold a pipe open
            thread.join(_LAST_WORDS)
        if not any(thread.is_alive() for thread in self._threads):
            close_pipes(self.process)

    def _end_group(self) -> None:
        """End what the process started, once: its number may be another's afterwards."""
        if not self._group_ended:
            self._group_ended = True
            kill_group(self.process)


@contextmanager
def started(modules: Iterable[str] = ()) -> Iterator[Process]:
    """Start a process that can be given a task; it is ended, and its folder removed, afterwards.

    It starts, and imports `modules` of use, while the caller goes on. It works in a folder of its
    own, for what an FMU writes.
    Raises MachineError if it cannot be started.
    """
    with temporary_folder() as folder:
        temporary = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
        with started_python(_CHILD, *modules, directory=folder, **temporary) as own:
            process = Process(own)
            try:
                yield process
            finally:
                process.end()


def _pipe(stream: IO[bytes] | None) -> IO[bytes]:
    """Return a pipe that was asked for."""
    if stream is None:
        raise PsaError("A pipe to the process of the FMU is missing; report it.")
    return stream


def _read(stream: IO[bytes] | None) -> bytes:
    """Return the next bytes of a pipe, b"" at its end."""
    try:
        return os.read(_pipe(stream).fileno(), _CHUNK)
    except (OSError, ValueError):
        return b""


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return str(number)
