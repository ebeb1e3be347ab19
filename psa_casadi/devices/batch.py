"""Many devices, each identified or diagnosed by itself, on whatever takes work."""

import os
import secrets
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from psa_casadi.devices.device import make_ready
from psa_casadi.devices.executors import Executor, Processes, outcomes
from psa_casadi.devices.jobs import DeviceTask, Job, Jobs, Options, jobs_given, key_of
from psa_casadi.devices.results import Results
from psa_casadi.devices.summary import write_summary
from psa_casadi.errors import InputError
from psa_casadi.identification.refitting import Progress
from psa_casadi.interruption import interruptible_work
from psa_casadi.model.own_effects import own_effects
from psa_casadi.population.finding import Finding
from psa_casadi.report.documents.device_file import DeviceFile

#: Devices that are submitted for each that can run at once: none waits for the next.
_AHEAD = 2


@dataclass(frozen=True)
class BatchRun:
    """How the devices of a batch ended, in the order of its jobs.

    `kept` is how many were done before and kept. `findings` are of those that were done; `files`
    the tables over all devices.
    """

    folder: Path
    devices: tuple[DeviceFile, ...]
    findings: tuple[Finding, ...]
    kept: int
    seconds: float
    files: tuple[Path, ...]

    @property
    def counts(self) -> dict[str, int]:
        """How many devices ended in each way: done, refused, failed."""
        return dict(Counter(d.status for d in self.devices))


@interruptible_work()
def batch(
    jobs: Jobs,
    output: str | os.PathLike[str],
    *,
    options: Options | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    at_once: int | None = None,
    progress: Progress = lambda _: None,
) -> BatchRun:
    """Identify or diagnose many devices; write each result to the folder `output` when it is there.

    `jobs` is a folder of records, a table of jobs (`jobs.csv`) or a list of `Job`. `options` say
    what is done with every device. `executor` is any object with `submit`: an executor of
    `concurrent.futures`, a client of Dask, mpi4py's; without one, `workers` processes (one for each
    core) do the work, each on one thread. At most `at_once` devices are submitted at a time.

    A device that fails is a result, and the others go on. A run that was cut off goes on where it
    stopped: a result whose files and options are still the same is kept, unless it had failed for
    another reason than its records. Where `executor` works on other machines they must see the
    files under the same names.

    Raises:
        InputError: the jobs cannot be understood, or the results cannot be written.
        MachineError: the executor takes no more work; what is done is kept.
        KeyboardInterrupt: the run was interrupted; what is done is kept, its message says how much.
    """
    began, o = time.monotonic(), options or Options()
    given = jobs_given(jobs)
    effects = [c for module in o.modules for c in own_effects(module).values()]
    results = Results(Path(output))
    keys = _keys(given, o)
    ended: dict[str, DeviceFile] = {}
    for job in given:
        told = results.kept(job, keys[job.device])
        if told is not None:
            ended[job.device] = results.restated(job, told)
    kept = len(ended)
    waiting = [job for job in given if job.device not in ended]
    pace = _Pace(len(given), kept)
    try:
        with _executor(executor, workers, len(waiting)) as (where, most):
            if executor is None and waiting:
                progress("compiling models")
                make_ready(waiting[0], o)
            run = secrets.token_hex(8)
            tasks = (DeviceTask(job, o, run) for job in waiting)
            for task, outcome in outcomes(tasks, where, at_once or most):
                told = results.write(task.job, o, keys[outcome.device], outcome)
                ended[outcome.device] = told
                progress(pace.told(told))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"{len(ended)} of {len(given)} devices are done. Kept: {output}. The same command goes"
            " on where it stopped."
        ) from None
    progress("writing the tables")
    rows = list(results.findings([ended[job.device] for job in given], effects))
    files = write_summary(results.folder, rows)
    found = tuple(f for _, f in rows if f is not None)
    devices = tuple(told for told, _ in rows)
    return BatchRun(results.folder, devices, found, kept, time.monotonic() - began, files)


def _keys(jobs: Sequence[Job], options: Options) -> dict[str, str]:
    try:
        return {job.device: key_of(job, options) for job in jobs}
    except OSError as error:
        raise InputError(
            f"{error.filename}: cannot be read ({error.strerror}); correct its permissions."
        ) from error


@contextmanager
def _executor(
    given: Executor | None, workers: int | None, jobs: int
) -> Iterator[tuple[Executor, int]]:
    """Yield what takes the work, and how many devices it gets at a time."""
    cores = os.cpu_count() or 1
    if given is not None:
        nthreads = getattr(given, "nthreads", None)  # a client of Dask knows its workers' threads
        yield given, _AHEAD * (sum(nthreads().values()) if nthreads else cores)
        return
    own = Processes(max(1, min(workers or cores, jobs)))
    try:
        yield own, _AHEAD * own.count
    finally:
        own.end()


class _Pace:
    """How far a batch is, and how long the rest will take at the pace so far."""

    def __init__(self, total: int, kept: int) -> None:
        self._began, self._total, self._kept, self._done = time.monotonic(), total, kept, 0
        self._lost = 0

    def told(self, last: DeviceFile) -> str:
        """Count a device that ended and return the line that tells it."""
        self._done += 1
        self._lost += last.status != "done"
        there = self._kept + self._done
        elapsed = time.monotonic() - self._began
        left = (self._total - there) * elapsed / self._done
        lost = f", {self._lost} without a result" if self._lost else ""
        rest = f", about {_duration(left)} left" if there < self._total else ""
        return f"{there} of {self._total} devices{lost}{rest} ({last.device}: {last.status})"


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"
