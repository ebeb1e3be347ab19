"""Devices handed to an executor, few at a time, and their outcomes as they come.

An executor is any object with `submit(function, argument)` that returns a future with
`add_done_callback`, `result` and `cancel`: those of `concurrent.futures`, a client of Dask,
mpi4py's.
"""

import queue
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError
from typing import Any, Protocol

from psa_casadi.devices.device import stop, work_on
from psa_casadi.devices.jobs import DeviceOutcome, DeviceTask
from psa_casadi.errors import MachineError
from psa_casadi.interruption import raise_if_stopped

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
