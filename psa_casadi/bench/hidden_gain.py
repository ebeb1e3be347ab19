"""How often the interval of the gain holds the truth, by playing the hidden plant again."""

import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.bench.hidden_cases import ORDINARY, plants
from psa_casadi.bench.outcome import Progress, TitledTable
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.errors_of import gain_of
from psa_casadi.experiment.reading import read_record
from psa_casadi.experiment.split import Experiment
from psa_casadi.model.compose import Model
from psa_casadi.report.tables import Table
from psa_casadi.simulation.simulate import simulate_record

FloatArray = npt.NDArray[np.float64]

#: Further records that are held out, and those whose mean error counts as the truth.
HELD_OUT, TRUTH = 12, 36


@dataclass(frozen=True)
class Covered:
    """The true reduction of the error [%], and the intervals from blocks and from experiments."""

    effect: str
    true: float
    blocks: tuple[float, float]
    experiments: tuple[float, float]


def gain_table(known: Sequence[str], first: int, progress: Progress) -> TitledTable:
    """Diagnose one record with each effect and compare its gain with that of further records."""
    found: list[Covered] = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        jobs = [
            pool.submit(covered, effect, first + 100 * k) for k, effect in enumerate(known, start=1)
        ]
        for job in as_completed(jobs):
            one = job.result()
            if one is not None:
                found.append(one)
                progress(f"gain of {one.effect}: {one.true:.1f} %, {one.blocks}, {one.experiments}")
    rows = []
    for title, intervals in (
        ("eight blocks of one record's held-out quarter", [f.blocks for f in found]),
        (f"{HELD_OUT} held-out records", [f.experiments for f in found]),
    ):
        held = sum(low <= f.true <= high for f, (low, high) in zip(found, intervals, strict=True))
        width = float(np.median([high - low for low, high in intervals])) if found else np.nan
        rows.append((title, f"{held} of {len(found)}", f"{width:.1f} %"))
    return TitledTable(
        "Intervals of the gain (95 %)",
        Table(("interval from", "hold the truth", "median width"), tuple(rows)),
        f"The truth is the reduction of the rms over {TRUTH} further records of the same device,"
        " with other voltages and fresh noise.",
    )


def covered(effect: str, seed: int) -> Covered | None:
    """Diagnose one record of an effect; None where nothing is named, so that nothing is gained."""
    make_record, _, _ = plants()
    play_again = import_module("tests.plants.again").play_again
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        truth = make_record(effect, seed, path, visible=ORDINARY)
        found = diagnose([read_record(path)])
        if not found.causes:
            return None
        models = (found.base_fit.model, found.extended_fit.model)
        plays = [
            _play(play_again, truth, seed + k, path, models) for k in range(1, HELD_OUT + TRUTH + 1)
        ]
    held, rest = plays[:HELD_OUT], plays[HELD_OUT:]
    true = gain_of(*_columns(rest)).holdout_rms_reduction_percent
    return Covered(effect, true, found.gain.interval, gain_of(*_columns(held)).interval)


_Play = tuple[Experiment, FloatArray, FloatArray]


def _play(play_again: Any, truth: Any, seed: int, path: Path, models: tuple[Model, Model]) -> _Play:
    """Play the device again and predict it with both models, the offset from the first tenth."""
    play_again(truth, seed, path)
    record = read_record(path)
    lead = np.arange(record.n) < record.n // 10
    experiment = Experiment(record, record.mask & lead, record.mask & ~lead)
    y = np.asarray(record.displacement)
    predicted = []
    for model in models:
        moved = simulate_record(model, record).displacement
        predicted.append(moved + float(np.mean((y - moved)[experiment.used])))
    return experiment, predicted[0], predicted[1]


def _columns(plays: Sequence[_Play]) -> tuple[list[Experiment], list[FloatArray], list[FloatArray]]:
    return [p[0] for p in plays], [p[1] for p in plays], [p[2] for p in plays]
