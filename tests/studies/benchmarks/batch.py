"""`psa batch` on a population with hidden defects: what is found, what it costs, what is kept.

All devices are worked on by four workers of Dask, one of which is killed after a third of them.
"""

import os
import resource
import signal
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import mannwhitneyu

import psa_casadi as psa
from psa_casadi.devices.executors import LOCAL, dask_client
from psa_casadi.population.population import Population, population
from psa_casadi.report.words.phrases import number
from psa_casadi.units import FloatArray
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, share
from tests.studies.plants.base import simulate_base
from tests.studies.plants.make import write_csv
from tests.studies.plants.stack import Stack, draw_stack


def on_dask(
    records: Path, output: Path, workers: int, progress: Progress, *, kill: bool = False
) -> tuple[psa.BatchRun, str]:
    """Return a batch on a new cluster of so many workers, and what became of them.

    With `kill` a worker is killed, as a machine that is lost would be, when a third of the devices
    is there, by what is told after each.
    """
    devices, done, killed = len(list(records.glob("*.csv"))) - 1, 0, list[int]()  # one is jobs.csv
    with dask_client(LOCAL, workers) as client:
        before: set[int] = set(client.run(os.getpid).values())

        def say(text: str) -> None:
            nonlocal done
            progress(text)
            done += " devices" in text
            if kill and 3 * done >= devices and not killed:
                killed.append(min(before))
                os.kill(killed[0], signal.SIGKILL)

        result = psa.batch(records, output, executor=client, progress=say)
        after = set(client.run(os.getpid).values())
    if kill and sorted(before - after) != killed:
        raise RuntimeError(f"Workers {killed} were killed, and {before - after} are gone.")
    new = len(after - before)
    return result, f", {len(killed)} worker killed, {new} new in its place" if kill else ""


#: Samples of a record, time between them [s], noise over the stroke.
SAMPLES, STEP, NOISE = 600, 5e-3, 2e-4
#: Standard deviation of ln of a sound device's parameters.
SPREAD = 0.02
#: What is wrong with a device, and how large: a factor on what is named.
DEFECTS: dict[str, Callable[[Stack], Stack]] = {
    "weak (force per volt 0.94)": lambda s: replace(s, k_l=0.94 * s.k_l),
    "wide loop (hysteresis 1.08)": lambda s: _hysteresis(s, 1.08),
    "stiff (compliance 0.94)": lambda s: replace(
        s, k_p=s.k_p / 0.94, k_b=s.k_b / 0.94, m_p=s.m_p / 0.94, m_b=s.m_b / 0.94
    ),
    "sharp bend (n 1.08)": lambda s: replace(s, n=1.08 * s.n),
}


def write_devices(folder: Path, count: int, defects: int, seed: int = 20) -> dict[str, str]:
    """Write a record for each device, and a table of jobs; return the defects by name, "" for none.

    A sound device has its own force, hysteresis, asymmetry and bend. The voltage has loops that
    shrink: every one turns at voltages of its own. The same seed gives the same bytes.
    """
    folder.mkdir()
    rng, usual = np.random.default_rng(seed), draw_stack(np.random.default_rng(7))
    times: FloatArray = STEP * np.arange(SAMPLES, dtype=np.float64)
    swing = (1.0 - np.cos(4.0 * np.pi * times)) * np.exp(-0.25 * times)
    bad = dict(zip(sorted(rng.choice(count, defects, replace=False).tolist()),
                   list(DEFECTS) * count, strict=False))  # fmt: skip
    texts, rows = {}, ["device,batch,date,files"]
    for k in range(count):
        force, wide, skew, bend = np.exp(SPREAD * rng.standard_normal(4)).tolist()
        stack = _hysteresis(usual, wide)
        stack = replace(
            stack, k_l=usual.k_l * force, delta=stack.delta * skew,
            n=usual.n * bend if usual.n > 1.1 else usual.n,
        )  # fmt: skip
        name, defect = f"S{k:04d}", bad.get(k, "")
        stack = DEFECTS[defect](stack) if defect else stack
        run = simulate_base(stack, times, np.asarray(0.5 * usual.u_rated * swing))
        noise = NOISE * usual.stroke * rng.standard_normal(SAMPLES)
        write_csv(folder / f"{name}.csv", times, run.command, run.displacement + noise)
        rows.append(f"{name},B{k * 10 // count},2026-{k * 12 // count + 1:02d}-15,{name}.csv")
        texts[name] = defect
    (folder / "jobs.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return texts


def _hysteresis(s: Stack, factor: float) -> Stack:
    """Scale the hysteresis force; its reference force too, so that the loop keeps its shape."""
    a, b, g, h = (factor * x for x in (s.a, s.beta, s.gamma, s.h_ref))
    return replace(s, a=a, beta=b, gamma=g, h_ref=h)


#: Devices, of which one in twenty has a defect; devices of the runs with one, two and four workers.
DEVICES, QUICK, PART = 100, 24, 24
#: Workers of Dask; without Dask all devices are worked on by this machine's processes.
WORKERS = 4


def run(progress: Progress, quick: bool, size: int = DEVICES) -> Outcome:
    """Return the tables for `size` devices."""
    count = QUICK if quick else size

    def own(what: str, records: Path, output: Path, workers: int) -> _Cost:
        work = partial(psa.batch, records, output, workers=workers, progress=progress)
        return _measured(what, lambda: (work(), ""))

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        records, part, results = folder / "records", folder / "part", folder / "results"
        progress("making the devices")
        devices = write_devices(records, count, max(4, count // 20))
        write_devices(part, PART, 0, seed=21)
        psa.batch(part, folder / "warm", progress=progress)  # compiles
        costs = [
            own(f"{n} process{'es' if n > 1 else ''}", part, folder / f"with{n}", n)
            for n in (1, 2, WORKERS)
        ]
        if find_spec("distributed") is None:
            many = os.cpu_count() or 1
            costs.append(own(f"{many} processes", records, results, many))
        else:
            by = f"{WORKERS} workers of Dask"
            dask = partial(on_dask, workers=WORKERS, progress=progress)
            costs.append(_measured(by, partial(dask, part, folder / "dask")))
            costs.append(_measured(by, partial(dask, records, results, kill=True)))
        whole = costs[-1].run
        costs.append(own("all kept", records, results, 1))
    return Outcome((_roc(devices, population(whole.findings)), _cost(costs)))


class _Cost(NamedTuple):
    """A run with its wall and processor times [s], a device's, and largest memories [MiB].

    `worker` is that of a worker, `own` that of the process that hands out the work; so far.
    """

    what: str
    run: psa.BatchRun
    wall: float
    processor: float
    each: float
    worker: float
    own: float


def _measured(by: str, work: Callable[[], tuple[psa.BatchRun, str]]) -> _Cost:
    who = (resource.RUSAGE_CHILDREN, resource.RUSAGE_SELF)

    def processor() -> float:
        """Return the processor time of this process and of all that it has waited for [s]."""
        return sum(r.ru_utime + r.ru_stime for r in map(resource.getrusage, who))

    before, began = processor(), time.perf_counter()
    result, remark = work()
    wall, spent = time.perf_counter() - began, processor() - before
    memory = (resource.getrusage(w).ru_maxrss / 1024.0 for w in who)
    count = len(result.devices)
    return _Cost(f"{count} devices, {by}{remark}", result, wall, spent, spent / count, *memory)


def _cost(costs: Sequence[_Cost]) -> TitledTable:
    rows = [
        {"run": c.what, "wall [s]": number(c.wall), "processor [s]": number(c.processor),
         "for a device [s]": number(c.each, 2),
         "over one process": number(c.each / costs[0].each, 2),
         "ended": ", ".join(f"{n} {status}" for status, n in c.run.counts.items()),
         "largest worker [MiB]": number(c.worker), "own process [MiB]": number(c.own)}
        for c in costs
    ]  # fmt: skip
    return TitledTable(
        "Cost",
        rows,
        "Processor times are of all processes, their start included, and do not depend on what else"
        " the machine does, as wall times do. Over one process: what a device costs more with more"
        " workers; its inverse bounds the parallel efficiency where every worker has a core of its"
        f" own (here {os.cpu_count()} cores). Memory is the largest so far.",
    )


def _roc(devices: Mapping[str, str], found: Population) -> TitledTable:
    """Return how well the tests for outliers tell devices with defects from sound ones."""
    smallest = dict.fromkeys(devices, 1.0)
    for s in found.spreads:
        for k, p in zip(s.estimates.places, s.far.p, strict=True):
            name = found.findings[k].device
            smallest[name] = min(smallest[name], float(p))
    output = {o.device for o in found.outliers}
    groups = {"any": [n for n, defect in devices.items() if defect]}
    groups |= {kind: [n for n, defect in devices.items() if defect == kind] for kind in DEFECTS}
    sound = [name for name, defect in devices.items() if not defect]
    rows = []
    for kind, item in groups.items():
        auc, error = _auc(*([-smallest[n] for n in names] for names in (item, sound)))
        rows.append({"defect": kind, "told": share(n in output for n in item),
                     "area under the ROC curve": f"{auc:.3f} ± {1.96 * error:.3f}"})  # fmt: skip
    return TitledTable(
        f"Defects among {len(devices)} devices",
        rows,
        f"False alarms: {share(n in output for n in sound)} of the sound devices."
        " Told: p below 0.05, adjusted by Benjamini and Hochberg over all devices and parameters."
        " The area under the ROC curve is of the smallest p of a device (interval: Hanley and"
        " McNeil 1982).",
    )


def _auc(bad: Sequence[float], good: Sequence[float]) -> tuple[float, float]:
    """Return the area under the ROC curve (Mann and Whitney) and its standard error."""
    m, n = len(bad), len(good)
    if not m or not n:
        return float("nan"), float("nan")
    a = float(mannwhitneyu(bad, good).statistic) / (m * n)
    q1, q2 = a / (2.0 - a), 2.0 * a**2 / (1.0 + a)
    variance = (a * (1 - a) + (m - 1) * (q1 - a**2) + (n - 1) * (q2 - a**2)) / (m * n)
    return a, float(np.sqrt(max(0.0, variance)))
