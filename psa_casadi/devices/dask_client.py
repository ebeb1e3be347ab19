"""A client of Dask as an executor, loaded where it is asked for."""

import asyncio
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from psa_casadi.errors import InputError, MachineError

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
