"""What takes the work on devices: processes of this package, or any executor, Dask's too.

A process that works on one device after another: tasks come on standard input, pickled.

It ends when the process that started it does, and when its input is closed.

An executor of processes that are this package's own, each with one thread.

Unlike the executor of the standard library it needs no guard around the main program, and a process
that dies takes one device with it instead of all.

Devices handed to an executor, few at a time, and their outcomes as they come.

An executor is any object with `submit(function, argument)` that returns a future with
`add_done_callback`, `result` and `cancel`: those of `concurrent.futures`, a client of Dask,
mpi4py's.
"""

import asyncio
import contextlib
import os
import pickle
import queue
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, BinaryIO, Protocol, cast

from psa_casadi.children import Child, close_pipes, end_with_parent, kill, started_python
from psa_casadi.devices.device import stop, work_on
from psa_casadi.devices.jobs import DeviceOutcome, DeviceTask
from psa_casadi.errors import InputError, MachineError
from psa_casadi.interruption import raise_if_stopped
from psa_casadi.scratch import abandon, answer_requests_to_end
from psa_casadi.simulation.side_by_side import VARIABLE

LENGTH = struct.Struct("<Q")


def send(stream: BinaryIO, content: object) -> None:
    """Write an object with its length before it."""
    data = pickle.dumps(content)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def receive(stream: BinaryIO) -> object:
    """Return the next object of a stream, which a process of our own wrote. Raises EOFError."""
    (length,) = LENGTH.unpack(_exactly(stream, LENGTH.size))
    return pickle.loads(_exactly(stream, length))


def _exactly(stream: BinaryIO, count: int) -> bytes:
    parts = []
    while count:
        part = stream.read(count)
        if not part:
            raise EOFError
        parts.append(part)
        count -= len(part)
    return b"".join(parts)


def _listen(tasks: "queue.SimpleQueue[object]") -> None:
    """Hand on what is to be done; end the process, working or not, with its input."""
    try:
        while True:
            tasks.put(receive(sys.stdin.buffer))
    except EOFError:
        abandon()
        os._exit(0)


def main() -> None:
    """Work until the input ends."""
    end_with_parent()
    answer_requests_to_end()
    results = os.fdopen(os.dup(1), "wb")
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)  # what a library prints is no result
    send(results, "ready")
    os.dup2(silent, 2)
    tasks: queue.SimpleQueue[object] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()
    while True:
        send(results, work_on(tasks.get()))  # type: ignore[arg-type]


if __name__ == "__main__":
    main()


#: Time [s] between two looks whether the run is to end.
_LOOK = 0.2


class Executor(Protocol):
    """What takes work: `submit` returns a future."""

    def submit(self, function: Callable[..., Any], argument: Any, /) -> Any:
        """Take the call of a function with an argument."""


def outcomes(
    tasks: Iterable[DeviceTask], executor: Executor, at_once: int
) -> Iterator[tuple[DeviceTask, DeviceOutcome]]:
    """Yield tasks with their outcomes in the order in which they end.

    At most `at_once` are submitted and not ended. At an interrupt, what has not begun is cancelled
    and what runs in this process stopped.

    Raises:
        MachineError: the executor takes no more work, or has lost what it had.
    """
    ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
    pending: dict[Any, tuple[DeviceTask, float]] = {}
    waiting = iter(tasks)
    runs: set[str] = set()
    try:
        while True:
            while len(pending) < at_once and (task := next(waiting, None)) is not None:
                runs.add(task.run)
                future = _submitted(executor, task)
                pending[future] = (task, time.monotonic())
                future.add_done_callback(ended.put)
            if not pending:
                return
            future = _next(ended)
            task, began = pending.pop(future)
            yield task, _outcome(future, task, began)
    finally:
        for future in pending:
            future.cancel()
        for run in runs if pending else ():
            stop(run)


def _submitted(executor: Executor, task: DeviceTask) -> Any:
    try:
        return executor.submit(work_on, task)
    except (BrokenExecutor, RuntimeError) as error:
        raise MachineError(
            f"The executor takes no more work ({error}); what is done is kept. Run the same again"
            " with a new one."
        ) from error


def _next(ended: "queue.SimpleQueue[Any]") -> Any:
    while True:
        raise_if_stopped()
        try:
            return ended.get(timeout=_LOOK)
        except queue.Empty:
            continue


def _outcome(future: Any, task: DeviceTask, began: float) -> DeviceOutcome:
    """Return how a device ended; a worker that was lost is the outcome of its device."""
    try:
        found = future.result()
    except (BrokenExecutor, CancelledError) as error:  # nobody here has cancelled it
        why = (str(error) or type(error).__name__).partition("\n")[0].rstrip(".")
        raise MachineError(
            f"The executor was lost ({why}); what is done is kept, the same command goes on with"
            " a new one."
        ) from error
    except Exception as error:  # noqa: BLE001 - a cluster may raise anything for a lost worker
        told = str(error) if isinstance(error, MachineError) else f"{type(error).__name__}: {error}"
        found = DeviceOutcome(task.job.device, "failed", time.monotonic() - began, problems=(told,))
    if not isinstance(found, DeviceOutcome):
        raise MachineError(f"The executor returned {type(found).__name__} in place of a result.")
    return found


#: The address that starts a cluster on this machine.
LOCAL = "local"
#: Time [s] that a scheduler may take to answer.
_PATIENCE = 20
#: What differs from Dask's own choices in a cluster made here. Dask has every worker give freed
#: memory back at once (MALLOC_TRIM_THRESHOLD_) and looks at its stack 100 times a second; the first
#: costs a device a quarter of its time, and nobody reads the second.
_OURS = {
    "distributed.nanny.pre-spawn-environ": {
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    },
    "distributed.worker.profile.enabled": False,
}
#: What Dask logs, with tracebacks, of a scheduler that is lost; the work that is lost tells it.
_SILENT = dict.fromkeys(("distributed", "distributed.client", "tornado.application"), "critical")


@contextmanager
def dask_client(address: str, workers: int | None = None) -> Iterator[Any]:
    """Yield a client of the scheduler at `address` (tcp://HOST:8786), or of a cluster made here.

    `local` starts a cluster of `workers` processes on this machine, with one thread each.

    Raises:
        InputError: Dask is not installed.
        MachineError: the scheduler does not answer.
    """
    try:
        config = import_module("dask.config")
        with config.set({"logging": _SILENT}):
            distributed = import_module("distributed")
    except ImportError as error:
        raise InputError(
            "--dask needs Dask, which is not installed; run `pip install 'psa-casadi[dask]'`, or"
            " leave --dask out: one machine needs no cluster."
        ) from error
    try:
        if address == LOCAL:
            with config.set(_OURS):
                where: Any = distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
                )
        else:
            where = address
            with ThreadPoolExecutor(1) as pool:  # a notebook has a loop of its own in this thread
                pool.submit(asyncio.run, _reach(distributed, address)).result()
        client = distributed.Client(where, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise MachineError(
            f"The scheduler at {address} cannot be reached ({type(error).__name__}: {error}); see"
            " that `dask scheduler` runs there, and give its address, such as tcp://HOST:8786."
        ) from error
    with client:
        try:
            yield client
        finally:
            if address == LOCAL:
                where.close()


async def _reach(distributed: Any, address: str) -> None:
    """Raise what prevents a connection; a client that has not come about raises for 40 s more."""
    security = distributed.Security().get_connection_args("client")
    way = await distributed.comm.connect(address, timeout=_PATIENCE, **security)
    await way.close()


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
            started_python("psa_casadi.devices.executors", directory=None, **_THREADS)
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
