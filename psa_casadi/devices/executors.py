"""What takes the work on devices: processes of this package, or any executor, Dask's too.

An executor is any object with `submit(function, argument)` that returns a future with
`add_done_callback`, `result` and `cancel`: those of `concurrent.futures`, a client of Dask,
mpi4py's. `psa_casadi.processes.Processes` is one, too: of it, a process that dies takes one device
with it instead of all.
"""

import asyncio
import queue
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from typing import Any, Protocol, cast

from psa_casadi.devices.device import stop, work_on
from psa_casadi.devices.jobs import DeviceOutcome, DeviceTask
from psa_casadi.errors import InputError, MachineError
from psa_casadi.interruption import raise_if_stopped
from psa_casadi.processes import ONE_THREAD

#: The address that starts a cluster on this machine.
LOCAL = "local"
#: Time [s] that a scheduler may take to answer, and between two looks whether the run is to end.
_PATIENCE, _LOOK = 20, 0.2
#: What differs from Dask's defaults in a cluster made here. Dask has every worker give freed
#: memory back at once (MALLOC_TRIM_THRESHOLD_) and looks at its stack 100 times a second; the first
#: costs a device a quarter of its time, and nobody reads the second.
_OURS = {
    "distributed.nanny.pre-spawn-environ": ONE_THREAD,
    "distributed.worker.profile.enabled": False,
}
#: What Dask logs, with tracebacks, of a scheduler that is lost; the lost work reports it.
_SILENT = dict.fromkeys(("distributed", "distributed.client", "tornado.application"), "critical")


class Executor(Protocol):
    """What takes work: `submit` returns a future."""

    def submit(self, function: Callable[..., Any], argument: Any, /) -> Any:
        """Take the call of a function with an argument."""


def outcomes(
    tasks: Iterable[DeviceTask], executor: Executor, at_once: int
) -> Iterator[tuple[DeviceTask, DeviceOutcome]]:
    """Yield tasks with their outcomes in the order in which they end.

    At most `at_once` are submitted and not ended. At an interrupt, what has not started is
    cancelled and what runs in this process stopped.

    Raises:
        MachineError: the executor takes no more work, or has lost what it had.
    """
    ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
    pending: dict[Any, tuple[DeviceTask, float]] = {}
    waiting = iter(tasks)
    try:
        while True:
            while len(pending) < at_once and (task := next(waiting, None)) is not None:
                future = _submitted(executor, task)
                pending[future] = (task, time.monotonic())
                future.add_done_callback(ended.put)
            if not pending:
                return
            future = None
            while future is None:
                raise_if_stopped()
                with suppress(queue.Empty):
                    future = ended.get(timeout=_LOOK)
            yield pending[future][0], _outcome(future, *pending[future])
            del pending[future]
    finally:
        for future in pending:
            future.cancel()
        for run in {task.run for task, _ in pending.values()}:
            stop(run)


def _submitted(executor: Executor, task: DeviceTask) -> Any:
    try:
        return executor.submit(work_on, task)
    except (BrokenExecutor, RuntimeError) as error:
        raise MachineError(
            f"The executor takes no more work ({error}); what is done is kept. Run the same again"
            " with a new one."
        ) from error


def _outcome(future: Any, task: DeviceTask, began: float) -> DeviceOutcome:
    """Return how a device ended; a worker that was lost is the outcome of its device."""
    try:
        return cast("DeviceOutcome", future.result())
    except (BrokenExecutor, CancelledError) as error:  # nobody here has cancelled it
        why = (str(error) or type(error).__name__).partition("\n")[0].rstrip(".")
        raise MachineError(
            f"The executor was lost ({why}); what is done is kept, the same command goes on with"
            " a new one."
        ) from error
    except Exception as error:  # noqa: BLE001 - a cluster may raise anything for a lost worker
        kind = "" if isinstance(error, MachineError) else f"{type(error).__name__}: "
        seconds = time.monotonic() - began
        return DeviceOutcome(task.job.device, "failed", seconds, problems=(f"{kind}{error}",))


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
    with ExitStack() as held:
        try:
            where: Any = address
            if address == LOCAL:
                with config.set(_OURS):
                    where = held.enter_context(
                        distributed.LocalCluster(
                            n_workers=workers, threads_per_worker=1, dashboard_address=None
                        )
                    )
            else:
                with ThreadPoolExecutor(1) as pool:  # a notebook's thread has an event loop already
                    pool.submit(asyncio.run, _reach(distributed, address)).result()
            client = distributed.Client(where, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError, RuntimeError) as error:
            raise MachineError(
                f"The scheduler at {address} cannot be reached ({type(error).__name__}: {error});"
                " see that `dask scheduler` runs there, and give its address, such as"
                " tcp://HOST:8786."
            ) from error
        yield held.enter_context(client)


async def _reach(distributed: Any, address: str) -> None:
    """Raise what prevents a connection; a client that has not come about raises for 40 s more."""
    security = distributed.Security().get_connection_args("client")
    way = await distributed.comm.connect(address, timeout=_PATIENCE, **security)
    await way.close()
