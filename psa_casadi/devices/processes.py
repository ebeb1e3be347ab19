"""An executor of processes that are this package's own, each with one thread.

Unlike the executor of the standard library it needs no guard around the main program, and a process
that dies takes one device with it instead of all.
"""

import contextlib
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import BinaryIO, cast

from psa_casadi.children import Child, close_pipes, kill, started_python
from psa_casadi.devices.device import work_on
from psa_casadi.devices.jobs import DeviceOutcome, DeviceTask
from psa_casadi.devices.worker import receive, send
from psa_casadi.errors import MachineError
from psa_casadi.simulation.side_by_side import VARIABLE

#: One thread for each process: of ours, and of the linear algebra libraries.
_THREADS = {
    VARIABLE: "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


@dataclass(eq=False)
class _Process:
    """A process with what ends it."""

    child: Child
    held: ExitStack = field(default_factory=ExitStack)

    def end(self) -> None:
        kill(self.child)
        close_pipes(self.child)
        with contextlib.suppress(OSError):
            self.held.close()


class Processes:
    """`count` processes; `submit` takes the work on a device, and nothing else."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="psa device")
        self._idle: queue.SimpleQueue[_Process] = queue.SimpleQueue()
        self._all: set[_Process] = set()
        self._ended = threading.Event()

    def submit(
        self, work: Callable[[DeviceTask], DeviceOutcome], task: DeviceTask
    ) -> "Future[DeviceOutcome]":
        """Let the next free process do the work on a device."""
        if work is not work_on:
            raise MachineError("These processes do the work on devices only.")
        return self._pool.submit(self._done, task)

    def end(self) -> None:
        """Kill the processes, and leave out what has not begun."""
        self._ended.set()
        for process in list(self._all):
            kill(process.child)
        self._pool.shutdown(cancel_futures=True)
        for process in list(self._all):
            process.end()

    def _done(self, task: DeviceTask) -> DeviceOutcome:
        process = self._process()
        streams = cast("tuple[BinaryIO, BinaryIO]", (process.child.stdin, process.child.stdout))
        try:
            send(streams[0], task)
            outcome = cast("DeviceOutcome", receive(streams[1]))
        except (EOFError, OSError):
            code = process.child.wait()
            self._all.discard(process)
            process.end()
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            raise MachineError(
                f"The process that worked on this device ended ({how}): killed, out of memory, or"
                " crashed. The next run tries it again."
            ) from None
        self._idle.put(process)
        return outcome

    def _process(self) -> _Process:
        try:
            return self._idle.get_nowait()
        except queue.Empty:
            pass
        held = ExitStack()
        child = held.enter_context(
            started_python("psa_casadi.devices.worker", directory=None, **_THREADS)
        )
        process = _Process(child, held)
        self._all.add(process)
        if self._ended.is_set():
            kill(child)
        try:
            receive(cast("BinaryIO", child.stdout))
        except EOFError:
            said = child.stderr.read().decode(errors="replace")[-500:] if child.stderr else ""
            self._all.discard(process)
            process.end()
            raise MachineError(
                f"A process for devices cannot be started ({said.strip() or 'it ended at once'})."
            ) from None
        return process
