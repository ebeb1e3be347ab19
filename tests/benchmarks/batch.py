"""`psa batch` on a population with hidden defects: what is found, what it costs, what is kept."""

import os
import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psa_casadi.devices.batch import BatchRun, batch
from psa_casadi.population.population import Population, population
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from tests.benchmarks.batch_devices import DEFECTS, Device, write_devices
from tests.benchmarks.outcome import Outcome, Progress, TitledTable, share

#: Devices, of which one in twenty has a defect; devices of the runs with one and two processes.
DEVICES, QUICK, PART = 100, 24, 40


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
        costs = [_measured(part, folder / f"with{n}", n, progress) for n in (1, 2)]
        whole = _measured(records, folder / "results", None, progress)
        again = _measured(records, folder / "results", None, progress)
    found = population(whole.run.findings)
    return Outcome((_roc(devices, found), _cost([*costs, whole, again])))


@dataclass(frozen=True)
class _Cost:
    """A run with its wall and processor times [s] and the largest memory of a process [MiB]."""

    what: str
    run: BatchRun
    wall: float
    processor: float
    memory: float


def _measured(records: Path, output: Path, workers: int | None, progress: Progress) -> _Cost:
    before, began = _processor(), time.perf_counter()
    found = batch(records, output, workers=workers, progress=progress)
    wall, spent = time.perf_counter() - began, _processor() - before
    count = workers or os.cpu_count() or 1
    what = f"{len(found.devices)} devices, {count} process{'es' if count > 1 else ''}"
    what += ", again" if found.kept == len(found.devices) else ""
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    return _Cost(what, found, wall, spent, memory)


def _processor() -> float:
    """Return the processor time of this process and of all that it has waited for [s]."""
    rows = [resource.getrusage(r) for r in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(r.ru_utime + r.ru_stime for r in rows)


def _cost(costs: Sequence[_Cost]) -> TitledTable:
    one, two = costs[:2]
    rows = tuple(
        (
            c.what,
            number(c.wall),
            number(c.processor),
            number(c.processor / len(c.run.devices), 2),
            ", ".join(f"{n} {status}" for status, n in c.run.counts.items()),
            number(c.memory),
        )
        for c in costs
    )
    note = (
        f"Processor time with one process over that with two: {one.processor / two.processor:.2f}"
        " (1: two processes do no more work than one). Wall times are of a machine that others use"
        f" too: {one.wall / two.wall:.2f} times faster with two. Both with the start of processes."
    )
    head = (
        "run",
        "wall [s]",
        "processor [s]",
        "for a device [s]",
        "ended",
        "largest process [MiB]",
    )
    return TitledTable("Cost", Table(head, rows), note)


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
