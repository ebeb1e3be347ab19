"""Many devices, each identified or diagnosed by itself, on whatever takes work.

The folder of a batch's results: a folder for each device, and tables over all of them.

    RESULTS/
      DEVICE/device.json          how its work ended, for which files and options
      DEVICE/identification.json  or diagnosis.json: the result
      DEVICE/model.json           the model
      summary.csv                 one row for each device; summary.parquet where pyarrow is

Every file is written whole or not at all, device.json last: without it a device is done again.
"""

import csv
import io
import os
import secrets
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from itertools import starmap
from pathlib import Path
from typing import Any

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_path, atomic_write, make_folder
from psa_casadi.common.interruption import interruptible_work
from psa_casadi.common.processes import Processes
from psa_casadi.common.progress import Progress, on_a_terminal, silent
from psa_casadi.common.strict_json import decode, json_text, read_json
from psa_casadi.devices.executors import Executor, make_ready, outcomes
from psa_casadi.devices.jobs import (
    DeviceOutcome,
    DeviceTask,
    Job,
    Jobs,
    Options,
    jobs_given,
    key_of,
)
from psa_casadi.documents.files import DEVICE_FORMAT as FORMAT
from psa_casadi.documents.files import DeviceFile, RecordUsed, copied, damage, hash_of
from psa_casadi.documents.findings import DEVICE_FILE, device_finding, finding_content
from psa_casadi.model.component import Component
from psa_casadi.model.user_effects import load_effects
from psa_casadi.population.population import Finding
from psa_casadi.version import __version__


class Results:
    """The results in a folder, which is made where it is not there.

    Raises:
        InputError: the folder cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        make_folder(folder)

    def kept(self, job: Job, key: str) -> DeviceFile | None:
        """Return how a device ended if that holds for the same files and options, else None.

        With the batch and date that it has now, which are written too.
        """
        ended, folder = self.device_file(job.device), self.folder / job.device
        if ended is None or ended.key != key or ended.status == "failed":
            return None
        if len(ended.sha256) != len(ended.files) or damage(folder, ended):
            return None
        day = job.day.isoformat() if job.day else ""
        if (ended.batch, ended.date) != (job.batch, day):
            ended = replace(ended, batch=job.batch, date=day)
            atomic_write(folder / DEVICE_FILE, json_text(asdict(ended)))
        return ended

    def device_file(self, device: str) -> DeviceFile | None:
        """Return how a device ended, None where that is not known."""
        path = self.folder / device / DEVICE_FILE
        try:
            content = read_json(path, "the device is done again.")
            return decode(DeviceFile, content, str(path))
        except InputError:  # never done, or damaged
            return None

    def write(self, job: Job, options: Options, key: str, outcome: DeviceOutcome) -> DeviceFile:
        """Write the files of a device, and last how it ended.

        Raises:
            InputError: they cannot be written.
        """
        here = self.folder / job.device
        make_folder(here)
        (here / DEVICE_FILE).unlink(missing_ok=True)
        for name, text in outcome.files:
            atomic_write(here / name, text)
        device_file = copied(
            DeviceFile, outcome, format=FORMAT, batch=job.batch, work=options.work, key=key,
            date=job.day.isoformat() if job.day else "", seconds=round(outcome.seconds, 3),
            package_version=__version__, records=tuple(starmap(RecordUsed, outcome.records)),
            files=tuple(name for name, _ in outcome.files),
            sha256=tuple(hash_of(text.encode()) for _, text in outcome.files),
        )  # fmt: skip
        atomic_write(here / DEVICE_FILE, json_text(asdict(device_file)))
        return device_file

    def findings(
        self, devices: Sequence[DeviceFile], effects: Sequence[Component] = ()
    ) -> Iterator[tuple[DeviceFile, Finding | None]]:
        """Yield devices with their findings, None without one.

        A device whose files are damaged has failed, with what is wrong among its problems.
        """
        for d in devices:
            try:
                is_done = d.status == "done"
                yield d, device_finding(self.folder / d.device, d, effects) if is_done else None
            except ValueError as error:
                yield replace(d, status="failed", problems=(str(error),)), None


def read_results(
    folder: Path, effects: Sequence[Component] = ()
) -> tuple[tuple[Finding, ...], tuple[tuple[str, str, str], ...]]:
    """Return the findings in a folder of results, and device, status and problems of the others.

    Raises:
        InputError: there are no devices in it.
    """
    results = Results(folder)
    names = sorted(d.name for d in folder.iterdir() if (d / DEVICE_FILE).is_file())
    if not names:
        raise InputError(
            f"{folder}: holds no results of devices; give the folder that `psa batch` wrote to, or"
            " two files or more."
        )
    devices = {name: results.device_file(name) for name in names}
    rows = list(results.findings([d for d in devices.values() if d is not None], effects))
    lost = [(d.device, d.status, " ".join(d.problems)) for d, f in rows if f is None]
    lost += [
        (n, "failed", f"{folder / n / DEVICE_FILE}: is damaged; run `psa batch` again.")
        for n, d in devices.items()
        if d is None
    ]
    return tuple(f for _, f in rows if f is not None), tuple(sorted(lost))


CSV, PARQUET = "summary.csv", "summary.parquet"
#: Columns that hold no numbers.
_TEXTS = ("device", "batch", "date", "work", "status", "verdict", "cause", "problems")


def write_summary(
    folder: Path, rows: Iterable[tuple[DeviceFile, Finding | None]]
) -> tuple[Path, ...]:
    """Write the tables of devices; return the files.

    A parameter has the columns `NAME [UNIT]`, `NAME low` and `NAME high` (95 % interval, SI units),
    empty where the records of a device do not determine it. A column of numbers with a unit that no
    device fills is left out.
    """
    names = ("device", "batch", "date", "work", "status", "seconds")
    table: list[dict[str, Any]] = [
        {name: getattr(device, name) for name in names}
        | {"problems": " ".join(device.problems)}
        | (finding_content(finding) if finding else {})
        for device, finding in rows
    ]
    filled = {name for row in table for name, value in row.items() if value is not None}
    every = dict.fromkeys(name for row in table for name in row)
    columns = [name for name in every if name in filled or not name.endswith("]")]
    table = [{name: row[name] for name in columns if name in row} for row in table]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    atomic_write(folder / CSV, text.getvalue())
    if find_spec("pyarrow") is None:
        return (folder / CSV,)
    arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    kinds = {n: arrow.string() if n in _TEXTS else arrow.float64() for n in columns}
    content = arrow.Table.from_pylist(table, schema=arrow.schema(kinds.items()))
    with atomic_path(folder / PARQUET) as temporary:
        parquet.write_table(content, temporary)
    return (folder / CSV, folder / PARQUET)


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
@on_a_terminal
def batch(
    jobs: Jobs,
    output: str | os.PathLike[str],
    *,
    options: Options | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    at_once: int | None = None,
    progress: Progress = silent,
) -> BatchRun:
    """Identify or diagnose many devices; write each result to the folder `output` when it is there.

    `jobs` is a folder of records, a table of jobs (`jobs.csv`) or a list of `Job`. `options` say
    what is done with every device, and with which model, a stack's or any other. `executor`
    is any object with `submit`: an executor of `concurrent.futures`, a client of Dask, mpi4py's;
    without one, `workers` processes (one for each core) do the work, each on one thread. At most
    `at_once` devices are submitted at a time.

    A device that fails is a result, and the others go on. A run that was cut off goes on where it
    stopped: a result whose files and options are still the same is kept, unless it had failed for
    another reason than its records. Where `executor` works on other machines they must see the
    files under the same names.

    Raises:
        InputError: the jobs cannot be understood, or the results cannot be written.
        MachineError: the executor takes no more work; what is done is kept.
        KeyboardInterrupt: the run was interrupted; its message states how much is done and kept.
    """
    began, o = time.monotonic(), options or Options()
    inputs = jobs_given(jobs)
    effects = [c for module in o.modules for c in load_effects(module).values()]
    results = Results(Path(output))
    try:
        keys = {job.device: key_of(job, o) for job in inputs}
    except OSError as error:
        raise InputError(
            f"{error.filename}: cannot be read ({error.strerror}); correct its permissions."
        ) from error
    ended: dict[str, DeviceFile] = {}
    for job in inputs:
        if known := results.kept(job, keys[job.device]):
            ended[job.device] = known
    kept = len(ended)
    waiting = [job for job in inputs if job.device not in ended]
    started = time.monotonic()
    try:
        with _executor(executor, workers, len(waiting)) as (where, most):
            if executor is None and waiting:
                progress("compiling models")
                make_ready(waiting[0], o)
            run = secrets.token_hex(8)
            tasks = (DeviceTask(job, o, run) for job in waiting)
            for task, outcome in outcomes(tasks, where, at_once or most):
                report = results.write(task.job, o, keys[outcome.device], outcome)
                ended[outcome.device] = report
                elapsed = (time.monotonic() - started) / (len(ended) - kept)
                progress(_line(report, list(ended.values()), kept, len(inputs), elapsed))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"{len(ended)} of {len(inputs)} devices are done. Kept: {output}. The same command goes"
            " on where it stopped."
        ) from None
    progress("writing the tables")
    rows = list(results.findings([ended[job.device] for job in inputs], effects))
    files = write_summary(results.folder, rows)
    findings = tuple(f for _, f in rows if f is not None)
    devices = tuple(report for report, _ in rows)
    return BatchRun(results.folder, devices, findings, kept, time.monotonic() - began, files)


@contextmanager
def _executor(
    executor: Executor | None, workers: int | None, jobs: int
) -> Iterator[tuple[Executor, int]]:
    """Yield what takes the work, and how many devices it gets at a time."""
    cores = os.cpu_count() or 1
    if executor is not None:
        nthreads = getattr(executor, "nthreads", None)  # of a client of Dask: threads by worker
        yield executor, _AHEAD * (sum(nthreads().values()) if nthreads else cores)
        return
    processes = Processes(max(1, min(workers or cores, jobs)))
    try:
        yield processes, _AHEAD * processes.count
    finally:
        processes.end()


def _line(
    last: DeviceFile, ended: Sequence[DeviceFile], kept: int, total: int, seconds: float
) -> str:
    """Return the line on the progress of a batch; `seconds` is the time that a device takes."""
    there, left = len(ended), (total - len(ended)) * seconds
    failed = sum(d.status != "done" for d in ended[kept:])
    lost = f", {failed} without a result" if failed else ""
    rest = f", about {_duration(left)} left" if there < total else ""
    return f"{there} of {total} devices{lost}{rest} ({last.device}: {last.status})"


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"
