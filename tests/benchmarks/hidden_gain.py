"""How often the interval of the gain holds the truth, by playing the hidden plant again."""

import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.held_out.errors import Gain, gain_of
from psa_casadi.model.compose import Model
from psa_casadi.records.read.reading import read_record
from psa_casadi.records.split import Experiment, judging
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.simulate import simulate_record
from tests.benchmarks.hidden_cases import ORDINARY
from tests.benchmarks.outcome import Progress, TitledTable, share
from tests.plants.again import play_again
from tests.plants.make import Truth, make_record

FloatArray = npt.NDArray[np.float64]

#: Further records of a device, and how many of them are held out together.
PLAYS, HELD_OUT = 96, 12


@dataclass(frozen=True)
class Covered:
    """Reductions of the error [%] over further records, and the intervals that should hold them.

    `blocks` is the interval from the diagnosed record's own blocks, for the reduction over all
    further records; `experiments` are those from so many further records, `others` the reductions
    over the rest of them.
    """

    effect: str
    reduction: float
    blocks: tuple[float, float]
    experiments: tuple[tuple[float, float], ...]
    others: tuple[float, ...]


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
                progress(f"gain of {one.effect}: {one.reduction:.1f} %, blocks {one.blocks}")
    return intervals_table(found)


def intervals_table(found: Sequence[Covered]) -> TitledTable:
    """Return how many intervals hold the reduction over records that they do not know."""
    rows = []
    for title, pairs in (
        (
            "eight blocks of one record's held-out quarter",
            [(f.blocks, f.reduction) for f in found],
        ),
        (
            f"{HELD_OUT} held-out records",
            [p for f in found for p in zip(f.experiments, f.others, strict=True)],
        ),
    ):
        held = sum(low <= true <= high for (low, high), true in pairs)
        width = float(np.median([high - low for (low, high), _ in pairs])) if pairs else np.nan
        rows.append((title, share(held, len(pairs)), f"{width:.1f} %"))
    return TitledTable(
        "Intervals of the gain (95 %)",
        Table(("interval from", "hold the truth", "median width"), tuple(rows)),
        f"The truth is the reduction of the rms over those of {PLAYS} further records of the same"
        " device, with other voltages and fresh noise, that the interval does not know.",
    )


def covered(effect: str, seed: int) -> Covered | None:
    """Diagnose one record of an effect; None where nothing is named, so that nothing is gained."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        truth = make_record(effect, seed, path, visible=ORDINARY)
        found = diagnose([read_record(path)])
        if not found.causes:
            return None
        models = (found.base_fit.model, found.extended_fit.model)
        plays = [_play(truth, seed + k, path, models) for k in range(1, PLAYS + 1)]
    groups = [range(k, k + HELD_OUT) for k in range(0, PLAYS, HELD_OUT)]
    rests = [[p for k, p in enumerate(plays) if k not in group] for group in groups]
    return Covered(
        effect,
        _gain(plays).holdout_rms_reduction_percent,
        found.gain.interval,
        tuple(_gain([plays[k] for k in group]).interval for group in groups),
        tuple(_gain(rest).holdout_rms_reduction_percent for rest in rests),
    )


_Play = tuple[Experiment, FloatArray, FloatArray]


def _play(truth: Truth, seed: int, path: Path, models: tuple[Model, Model]) -> _Play:
    """Play the device again and predict it with both models, the offset from the first tenth."""
    play_again(truth, seed, path)
    record = read_record(path)
    experiment = judging(record)
    y = np.asarray(record.displacement)
    predicted = []
    for model in models:
        moved = simulate_record(model, record).displacement
        predicted.append(moved + float(np.mean((y - moved)[experiment.known])))
    return experiment, predicted[0], predicted[1]


def _gain(plays: Sequence[_Play]) -> Gain:
    """Return the gain over some further records."""
    return gain_of([p[0] for p in plays], [p[1] for p in plays], [p[2] for p in plays])
