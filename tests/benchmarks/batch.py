"""`psa batch` on a population with hidden defects: what is found, what it costs, what is kept.

All devices are worked on by four workers of Dask, one of which is killed after a third of them.
"""

import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from psa_casadi.devices.batch import BatchRun, batch
from psa_casadi.population.population import Population, population
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from tests.benchmarks.batch_dask import on_dask
from tests.benchmarks.batch_devices import DEFECTS, Device, write_devices
from tests.benchmarks.outcome import Outcome, Progress, TitledTable, share

#: Devices, of which one in twenty has a defect; devices of the runs with one, two and four workers.
DEVICES, QUICK, PART = 100, 24, 24
#: Workers of Dask; without Dask all devices are worked on by this machine's processes.
WORKERS = 4


def run(progress: Progress, quick: bool) -> Outcome:
    """Return the tables for the usual number of devices."""
    return run_sized(progress, QUICK if quick else DEVICES)


def run_sized(progress: Progress, count: int) -> Outcome:
    """Return the tables for `count` devices."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        records = folder / "records"
        records.mkdir()
        progress("making the devices")
        devices = write_devices(records, count, max(4, count // 20))
        part = folder / "part"
        part.mkdir()
        write_devices(part, PART, 0, seed=21)
        batch(part, folder / "warm", progress=progress)  # compiles
        own = partial(_own, progress=progress)
        costs = [
            _measured(_processes(n), partial(own, part, folder / f"with{n}", n))
            for n in (1, 2, WORKERS)
        ]
        results = folder / "results"
        if find_spec("distributed") is None:
            many = os.cpu_count() or 1
            costs.append(_measured(_processes(many), partial(own, records, results, many)))
        else:
            by = f"{WORKERS} workers of Dask"
            dask = partial(on_dask, workers=WORKERS, progress=progress)
            costs.append(_measured(by, partial(dask, part, folder / "dask")))
            costs.append(_measured(by, partial(dask, records, results, kill=True)))
        whole = costs[-1].run
        costs.append(_measured("all kept", partial(own, records, results, 1)))
    found = population(whole.findings)
    return Outcome((_roc(devices, found), _cost(costs)))


@dataclass(frozen=True)
class _Cost:
    """A run with its wall and processor times [s] and the largest memory of processes [MiB].

    `memory` is that of a worker, `own` that of the process that hands out the work. Each is the
    largest so far.
    """

    what: str
    run: BatchRun
    wall: float
    processor: float
    memory: float
    own: float


def _own(records: Path, output: Path, workers: int, progress: Progress) -> tuple[BatchRun, str]:
    return batch(records, output, workers=workers, progress=progress), ""


def _processes(count: int) -> str:
    return f"{count} process{'es' if count > 1 else ''}"


def _measured(by: str, work: Callable[[], tuple[BatchRun, str]]) -> _Cost:
    before, began = _processor(), time.perf_counter()
    found, remark = work()
    wall, spent = time.perf_counter() - began, _processor() - before
    what = f"{len(found.devices)} devices, {by}{f', {remark}' if remark else ''}"
    own, children = (
        resource.getrusage(who).ru_maxrss / 1024.0
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return _Cost(what, found, wall, spent, children, own)


def _processor() -> float:
    """Return the processor time of this process and of all that it has waited for [s]."""
    rows = [resource.getrusage(r) for r in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(r.ru_utime + r.ru_stime for r in rows)


def _cost(costs: Sequence[_Cost]) -> TitledTable:
    one = costs[0]
    rows = tuple(
        (
            c.what,
            number(c.wall),
            number(c.processor),
            number(c.processor / len(c.run.devices), 2),
            number(_per_device(c) / _per_device(one), 2),
            ", ".join(f"{n} {status}" for status, n in c.run.counts.items()),
            number(c.memory),
            number(c.own),
        )
        for c in costs
    )
    note = (
        "Processor times are of all processes, their start included, and do not depend on what else"
        " the machine does, as wall times do. Over one process: what a device costs more with more"
        " workers; its inverse bounds the parallel efficiency where every worker has a core of its"
        f" own (here {os.cpu_count()} cores). Memory is the largest so far."
    )
    head = (
        "run",
        "wall [s]",
        "processor [s]",
        "for a device [s]",
        "over one process",
        "ended",
        "largest worker [MiB]",
        "own process [MiB]",
    )
    return TitledTable("Cost", Table(head, rows), note)


def _per_device(c: _Cost) -> float:
    return c.processor / len(c.run.devices)


def _roc(devices: Sequence[Device], found: Population) -> TitledTable:
    """Return how well the tests for outliers tell devices with defects from sound ones."""
    smallest = dict.fromkeys((d.name for d in devices), 1.0)
    for s in found.spreads:
        for k, p in zip(s.estimates.places, s.far.p, strict=True):
            name = found.findings[k].device
            smallest[name] = min(smallest[name], float(p))
    score = {name: -np.log(max(p, 1e-300)) for name, p in smallest.items()}
    told = {o.device for o in found.outliers}
    sound = [d.name for d in devices if not d.defect]
    rows = []
    for defect in ("", *DEFECTS):
        those = [d.name for d in devices if d.defect and defect in ("", d.defect)]
        auc, error = _auc([score[n] for n in those], [score[n] for n in sound])
        rows.append(
            (
                defect or "any",
                share(sum(n in told for n in those), len(those)),
                f"{auc:.3f} ± {1.96 * error:.3f}",
            )
        )
    false = sum(n in told for n in sound)
    note = (
        f"False alarms: {share(false, len(sound))} of the sound devices. Told: p below"
        " 0.05, adjusted by Benjamini and Hochberg over all devices and parameters. The area under"
        " the ROC curve is of the smallest p of a device (interval: Hanley and McNeil 1982)."
    )
    head = ("defect", "told", "area under the ROC curve")
    return TitledTable(f"Defects among {len(devices)} devices", Table(head, tuple(rows)), note)


def _auc(bad: Sequence[float], good: Sequence[float]) -> tuple[float, float]:
    """Return the area under the ROC curve (Mann and Whitney) and its standard error."""
    if not bad or not good:
        return float("nan"), float("nan")
    difference = np.subtract.outer(np.array(bad), np.array(good))
    a = float(np.mean((difference > 0) + 0.5 * (difference == 0)))
    q1, q2 = a / (2.0 - a), 2.0 * a**2 / (1.0 + a)
    m, n = len(bad), len(good)
    variance = (a * (1 - a) + (m - 1) * (q1 - a**2) + (n - 1) * (q2 - a**2)) / (m * n)
    return a, float(np.sqrt(max(0.0, variance)))
