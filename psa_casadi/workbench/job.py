"""A command in a process of its own, which can be watched and stopped."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Literal

from psa_casadi.children import Child, close_pipes, interrupt, kill, started_python
from psa_casadi.errors import MachineError

Status = Literal["running", "done", "failed", "stopped"]
#: Lines that are kept of what a command says, and the longest part of one.
_LINES, _LONGEST = 400, 2000
#: Time [s] that an interrupted command has to write what it keeps.
_PATIENCE = 20.0


class Job:
    """A module of Python that runs in a folder; it and its children end with this process.

    `said` and `told` are what it has written to its two streams by now, line by line; `seconds` is
    how long it has run. `ended` is called once, from the thread that waits for it.
    """

    def __init__(
        self, module: str, arguments: Sequence[str], folder: Path, ended: Callable[[], None]
    ) -> None:
        self._module, self._arguments, self._folder = module, tuple(arguments), folder
        self._ended, self._stopped = ended, False
        self._child: Child | None = None
        self._begin, self._end = time.monotonic(), 0.0
        self.status: Status = "running"
        self.said: deque[str] = deque(maxlen=_LINES)
        self.told: deque[str] = deque(maxlen=_LINES)
        # this thread lives as long as the child: on Linux a child ends with its parent's thread
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def seconds(self) -> float:
        """Time [s] that it has run by now, or took."""
        return (self._end or time.monotonic()) - self._begin

    @property
    def pid(self) -> int | None:
        """Number of its process, None before it has started."""
        return None if self._child is None else self._child.pid

    def stop(self) -> None:
        """Let it end and keep what it has; after a while it is killed."""
        self._stopped = True
        child = self._child
        if child is not None:
            interrupt(child)
            threading.Timer(_PATIENCE, kill, (child,)).start()

    def end(self) -> None:
        """Kill it and wait until it is gone."""
        self._stopped = True
        if self._child is not None:
            kill(self._child)
        self._thread.join()

    def _run(self) -> None:
        code = 1
        try:
            with started_python(self._module, *self._arguments, directory=self._folder) as child:
                self._child = child
                if self._stopped:
                    interrupt(child)
                code = self._heard(child)
        except MachineError as error:
            self.told.append(str(error))
        finally:
            self._end = time.monotonic()
            self.status = "stopped" if self._stopped and code else "failed" if code else "done"
            self._ended()

    def _heard(self, child: Child) -> int:
        """Keep what a child says until it ends; return its exit code."""
        pairs = ((child.stdout, self.said), (child.stderr, self.told))
        readers = [
            threading.Thread(target=_keep, args=(stream, lines), daemon=True)
            for stream, lines in pairs
            if stream is not None
        ]
        if child.stdin is not None:
            child.stdin.close()
        for reader in readers:
            reader.start()
        code = child.wait()
        for reader in readers:
            reader.join(1.0)  # one that the child has started may still hold its streams
        close_pipes(child)
        return code


def _keep(stream: IO[bytes], lines: deque[str]) -> None:
    while row := stream.readline(_LONGEST):
        lines.append(row.decode("utf-8", "replace").rstrip("\r\n"))
