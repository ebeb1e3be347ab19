"""Whole fits and diagnoses with exact steps: wall and processor time, and simulations.

The demonstration is also diagnosed, and the long record identified, by the stepper alone, which is
the peer of the same run.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.identification.identify import identify
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import (
    Record,
    concatenate,
    decaying_triangle,
    read_record,
    steps,
    time_grid,
    triangle,
)
from psa_casadi.report.words.phrases import number, plain
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation import ways
from psa_casadi.simulation.exact.run import NotExact
from psa_casadi.simulation.simulate import simulate
from psa_casadi.simulation.timings import timed
from tests.benchmarks.outcome import Progress, TitledTable
from tests.plants.again import play_again
from tests.plants.make import make_record

#: Causes hidden in a device of the independent plants each, of which there are six records.
HIDDEN = ("hysteresis_memory", "structural_mode", "slow_creep")
_RECORDS = 6
_FIRST_SEED, _NOISE, _SAMPLE_TIME = 271828, 1e-3, 1e-4
_LONG, _QUICK_LONG = 180_000, 12_000
#: Samples of a step of the long record; samples of a record of the plants that are diagnosed.
_HELD, _CUT = 600, 2400
_HEAD = (
    "work", "samples", "wall [s]", "processor [s]", "processor, over the stepper's",
    "simulations", "with derivatives", "found",
)  # fmt: skip
_NOTE = (
    "Models are compiled and cached before the diagnoses that count. Wall times are those of a"
    " machine that other work may share."
)


@dataclass(frozen=True)
class Spent:
    """A piece of work: times [s], simulations, those with derivatives, and what it found.

    `peer` is the processor time by the stepper alone, None where it was not tried.
    """

    work: str
    samples: str
    wall: float
    processor: float
    runs: int
    differentiated: int
    found: str
    peer: float | None = None


def diagnosis_table(demo: Record, progress: Progress, quick: bool) -> TitledTable:
    """Diagnose the demonstration and hidden causes, identify a long record."""
    rows = [*_demonstration(demo, progress)]
    rows += [_hidden(cause, progress) for cause in (HIDDEN[:1] if quick else HIDDEN)]
    rows += _long(_QUICK_LONG if quick else _LONG, progress)
    return spent_table(rows)


def spent_table(rows: Sequence[Spent]) -> TitledTable:
    """Return the work with its times, and its share of the stepper's where that was tried."""
    cells = tuple(
        (
            r.work, r.samples, number(r.wall), number(r.processor),
            "" if r.peer is None else number(r.processor / r.peer, 2),
            str(r.runs), str(r.differentiated), r.found,
        )
        for r in rows
    )  # fmt: skip
    said = [
        f"{r.work} takes 1/{number(r.peer / r.processor, 2)} of the stepper's processor time."
        for r in rows
        if r.peer is not None and r.peer != r.processor
    ]
    note = " ".join((*said, _NOTE))
    return TitledTable("Whole fits and diagnoses", Table(_HEAD, cells), note)


@contextmanager
def stepper_alone() -> Iterator[None]:
    """Leave exact steps out: every model counts as one that they do not fit."""

    def refuse(*_: Any, **__: Any) -> Any:
        raise NotExact("left out for a benchmark")

    name = "run_exact"  # where `trace` and `accurate` look it up
    kept = getattr(ways, name)
    setattr(ways, name, refuse)
    try:
        yield
    finally:
        setattr(ways, name, kept)


def _spent(work: str, samples: str, do: Callable[[], str]) -> Spent:
    wall, processor = time.perf_counter(), time.process_time()
    with timed() as timings:
        found = do()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    runs, differentiated = (
        sum(getattr(s, of) for s in timings.stages) for of in ("runs", "differentiated")
    )
    return Spent(work, samples, wall, processor, runs, differentiated, found)


def _diagnosed(records: Sequence[Record]) -> str:
    found = diagnose(records)
    return ", ".join(plain(c.effect) for c in found.causes) or str(found.verdict)


def _both_ways(
    work: str, samples: str, do: Callable[[], str], progress: Progress
) -> tuple[Spent, Spent]:
    """Return the work with exact steps and by the stepper alone."""
    progress(work)
    ours = _spent(work, samples, do)
    progress(f"{work}, by the stepper alone")
    with stepper_alone():
        theirs = _spent(f"{work}, by the stepper alone", samples, do)
    return replace(ours, peer=theirs.processor), replace(theirs, peer=theirs.processor)


def _demonstration(record: Record, progress: Progress) -> tuple[Spent, Spent]:
    """Diagnose the demonstration both ways, once before it counts: models get compiled."""

    def diagnosed() -> str:
        return _diagnosed([record])

    _both_ways("diagnose, demonstration (first use)", "", diagnosed, progress)
    return _both_ways("diagnose, demonstration", str(record.n), diagnosed, progress)


def _hidden(cause: str, progress: Progress) -> Spent:
    """Diagnose six records of one device that hides a cause, once before it counts."""
    records = six_records(cause)

    def diagnosed() -> str:
        return _diagnosed(records)

    work = f"diagnose, {_RECORDS} records, hidden {plain(cause)}"
    progress(f"{work} (first use)")
    diagnosed()
    progress(work)
    return _spent(work, f"{_RECORDS} x {_CUT}", diagnosed)


def six_records(cause: str) -> list[Record]:
    """Return records of one device of the independent plants, each with a voltage of its own."""
    records = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        truth = make_record(cause, _FIRST_SEED, path, visible=(1.0, 3.0))
        for k in range(_RECORDS):
            path = Path(folder) / f"record_{k}.csv"
            play_again(truth, _FIRST_SEED + k, path)
            records.append(read_record(path).slice(0, _CUT))
    return records


def long_record(samples: int) -> Record:
    """Return loops and steps with noise, of this package's own simulation."""
    model = stack_model("WYDS0808020")
    top, part = model.values["u_rated"], samples // 3
    t = time_grid(part * _SAMPLE_TIME, _SAMPLE_TIME)
    rng = np.random.default_rng(1)
    levels = top * rng.uniform(0.0, 1.0, max(6, part // _HELD))
    parts = [
        triangle(t, 0.0, top, 4.0 / (part * _SAMPLE_TIME)),
        decaying_triangle(t, 0.0, top, 6, centre=0.0),
        steps(t, levels),
    ]
    wave = concatenate(parts, _SAMPLE_TIME)
    x = simulate(model, wave.time, wave.voltage).displacement
    noise = _NOISE * np.ptp(x) * rng.standard_normal(x.size)
    return Record(
        name=f"{x.size} samples", time=wave.time, voltage=wave.voltage, displacement=x + noise
    )


def _long(samples: int, progress: Progress) -> tuple[Spent, Spent]:
    record = long_record(samples)

    def fit() -> str:
        found = identify([record]).fit
        return f"rms {number(100.0 * found.rms / record.range_m, 2)} % of range"

    return _both_ways("identify, loops and steps", str(record.n), fit, progress)
