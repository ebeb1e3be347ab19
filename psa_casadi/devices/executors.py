"""The work on one device, and what takes it: processes of this package, or any executor.

The work runs in any process or thread, on one thread, with its error as result.

An executor is any object with `submit(function, argument)` that returns a future with
`add_done_callback`, `result` and `cancel`: those of `concurrent.futures`, a client of Dask,
mpi4py's. `psa_casadi.common.processes.Processes` is one, too: of it, a process that dies takes one
device with it instead of all.
"""

import asyncio
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from typing import Any, Protocol, cast

from psa_casadi.common.errors import InputError, MachineError, PsaError
from psa_casadi.common.interruption import Work, interruptible_work, raise_if_stopped
from psa_casadi.common.processes import ONE_THREAD
from psa_casadi.common.progress import silent
from psa_casadi.devices.jobs import DeviceOutcome, DeviceTask, Job, Options
from psa_casadi.documents.files import Status
from psa_casadi.faces import diagnose, identify
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.user_effects import known_effects, load_effects
from psa_casadi.records import Record, read_records, read_signals
from psa_casadi.records.signals import Signals
from psa_casadi.simulation.side_by_side import compiled, one_thread
from psa_casadi.simulation.start import is_stack

IDENTIFICATION, DIAGNOSIS, MODEL = "identification.json", "diagnosis.json", "model.json"
#: Works of this process by the run that they belong to, and runs that were stopped.
_RUNNING: dict[str, set[Work]] = {}
_STOPPED: set[str] = set()
_LOCK = threading.Lock()


def work_on(task: DeviceTask) -> DeviceOutcome:
    """Identify or diagnose a device; what goes wrong is its result.

    Raises KeyboardInterrupt where the run was stopped.
    """
    began = time.monotonic()
    status: Status = "refused"
    with interruptible_work() as work, one_thread():
        with _LOCK:
            if task.run in _STOPPED:
                raise KeyboardInterrupt
            _RUNNING.setdefault(task.run, set()).add(work)
        try:
            return _worked(task, began)
        except InputError as error:
            status, problems = "refused", error.problems
        except PsaError as error:
            status, problems = "refused", (str(error),)
        except Exception as error:  # noqa: BLE001 - no device may stop the others
            status, problems = "failed", (f"{type(error).__name__}: {error}",)
        finally:
            with _LOCK:
                _RUNNING[task.run].discard(work)
    return DeviceOutcome(task.job.device, status, time.monotonic() - began, problems=problems)


def stop(run: str) -> None:
    """End the works of a run in this process."""
    with _LOCK:
        _STOPPED.add(run)
        for work in _RUNNING.get(run, ()):
            work.stop()


def _worked(task: DeviceTask, began: float) -> DeviceOutcome:
    o, job = task.options, task.job
    effects = [c for module in o.modules for c in load_effects(module).values()]
    start = loads(o.model, effects=effects) if isinstance(o.model, str) else o.model
    table: dict[str, Any] = {"columns": o.columns, "sample_time": o.sample_time}
    inputs: tuple[Any, ...]
    words: dict[str, Any]
    records: Sequence[Record | Signals]
    if start is None or is_stack(start):
        records = read_records(job.files, need_excitation=True, **table)
        inputs = (records,)
        words = {"model": start, "stiffness": o.stiffness, "hysteresis": o.hysteresis}
        if o.work == "diagnose":
            words["effects"] = tuple(known_effects(effects).values())
    else:
        table |= {"inputs": start.input_names, "outputs": start.output_names}
        records = read_signals(job.files, **table)
        inputs, words = (start, records), dict(o.words)
    _refuse_same(records)
    work: Callable[..., Any] = diagnose if o.work == "diagnose" else identify
    result = work(*inputs, progress=silent, **words)
    if o.work == "identify" and (result.interrupted or result.fit.interrupted):
        raise KeyboardInterrupt
    files = [(DIAGNOSIS if o.work == "diagnose" else IDENTIFICATION, result.to_json())]
    if not result.model.structure.foreign:  # an imported FMU has no file of its model
        files.append((MODEL, dumps(result.model)))
    return DeviceOutcome(
        job.device, "done", time.monotonic() - began, tuple(files),
        records=tuple((r.name, r.sha256) for r in records),
    )  # fmt: skip


def _refuse_same(records: Sequence[Record | Signals]) -> None:
    """Refuse records that hold the same data. Raises InputError."""
    texts: dict[str, str] = {}
    for r in records:
        if r.sha256 in texts:
            raise InputError(
                f"{r.source}: holds the same data as {texts[r.sha256]}; a record counts once:"
                " remove one of the two."
            )
        texts[r.sha256] = r.source


def make_ready(job: Job, options: Options) -> None:
    """Compile what the first device will need; what fails is reported by the device's work.

    They lie in the cache of the user, where every process on this machine finds them.
    """
    with suppress(PsaError, MachineError):
        if isinstance(options.model, Model) and not is_stack(options.model):
            compiled([options.model])
            return
        records = read_records(job.files, columns=options.columns, sample_time=options.sample_time)
        start = starting_model(records, options.stiffness)
        models = [start]
        if options.work == "diagnose":
            effects = [c for module in options.modules for c in load_effects(module).values()]
            known = known_effects(effects).values()
            models += [start.with_effect(e) for e in known if not e.needs_column]
        compiled(models)


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
                    form = {"n_workers": workers, "threads_per_worker": 1}
                    cluster = distributed.LocalCluster(**form, dashboard_address=None)
                    where = held.enter_context(cluster)
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
