"""`psa batch` on workers of Dask on this machine, one of which can be killed in the middle."""

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from psa_casadi.devices.batch import BatchRun, batch
from psa_casadi.devices.executors import LOCAL, dask_client
from tests.benchmarks.outcome import Progress


@dataclass
class Killer:
    """Kills a worker, as a machine that is lost would be, when a share of the devices is there."""

    workers: dict[str, int]
    devices: int
    share: float = 1.0 / 3.0
    done: int = 0
    killed: list[int] = field(default_factory=list)

    def __call__(self, told: str, progress: Progress) -> None:
        """Count the devices by what is told after each; kill the first worker when it is time."""
        progress(told)
        self.done += " devices" in told
        if self.done >= self.share * self.devices and not self.killed:
            pid = min(self.workers.values())
            os.kill(pid, signal.SIGKILL)
            self.killed.append(pid)


def on_dask(
    records: Path, output: Path, workers: int, progress: Progress, *, kill: bool = False
) -> tuple[BatchRun, str]:
    """Return a batch on a new cluster of so many workers, and what became of them."""
    devices = len(list(records.glob("*.csv"))) - 1  # jobs.csv
    with dask_client(LOCAL, workers) as client:
        before = _processes(client)
        killer = Killer(before, devices)
        say: Callable[[str], None] = (lambda t: killer(t, progress)) if kill else progress
        found = batch(records, output, executor=client, progress=say)
        after = set(_processes(client).values())
    gone = sorted(set(before.values()) - after)
    if kill and gone != killer.killed:
        raise RuntimeError(f"Workers {killer.killed} were killed, and {gone} are gone.")
    new = len(after - set(before.values()))
    return found, f"{len(gone)} worker killed, {new} new in its place" if kill else ""


def _processes(client: Any) -> dict[str, int]:
    """Return the process of each worker by its address."""
    found: dict[str, int] = client.run(os.getpid)
    return found
