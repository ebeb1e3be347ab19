"""The benchmark `floors`: a diagnosis of measured records beside the floor of each of them.

The floor is the held-out error of many features fitted together, none of them with a physical
meaning: what a model of the plant's kind could reach at best on the same samples.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from psa_casadi import datasets
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.held_out import Errors, errors_of
from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records import read_records
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.floor_fit import Floor, Part, floor_of
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

_HEAD = ("record", "base", "extended", "floor", "extended / floor", "verdict", "causes")
_NOTE = (
    "Held-out rms, percent of range, in the samples that `psa diagnose` holds out. The floor: plays"
    " with squares and cubes, relaxations over decades, modes, a fine curve over the displacement,"
    " linear in their weights, their prior sizes and their number by evidence."
)


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose the public records; `quick` takes the shortest one alone."""
    sine, loops = datasets.micromanipulator()
    cases = [("minor loops", [loops])]
    if not quick:
        axis = datasets.load("steering_mirror")[0]
        cases += [("sine", [sine]), ("both", [sine, loops]), (axis.name, [axis])]
    return _outcome(cases, progress)


def run_on(progress: Progress, folder: Path) -> Outcome:
    """Diagnose every record of a folder by itself."""
    paths = sorted(p for p in folder.glob("*.csv"))
    if not paths:
        raise InputError(f"{folder}: holds no CSV file; name the folder with your records.")
    return _outcome([(r.name, [r]) for r in read_records(paths)], progress)


def floor_on(experiments: Sequence[Experiment], progress: Progress) -> tuple[Floor, Errors]:
    """Return the floor of experiments and its errors, in training and held-out samples."""
    voltages = [e.record.voltage for e in experiments]
    high, low = max(float(v.max()) for v in voltages), min(float(v.min()) for v in voltages)
    middle, half = 0.5 * (high + low), 0.5 * (high - low)
    size = max(e.record.range_m for e in experiments)
    parts = [
        Part((v - middle) / half, measured(e.record) / size, e.used)
        for v, e in zip(voltages, experiments, strict=True)
    ]
    floor = floor_of(parts, progress)
    return floor, errors_of(experiments, [size * y for y in floor.predicted])


def _outcome(cases: Sequence[tuple[str, Sequence[Record]]], progress: Progress) -> Outcome:
    rows, ratios = [], []
    for name, records in cases:

        def tell(step: str, name: str = name) -> None:
            progress(f"{name}: {step}")

        found = diagnose(records, progress=tell)
        errors = floor_on(found.experiments, tell)[1]
        base, extended, floor = (
            e.holdout_nrmse_percent for e in (found.base_errors, found.extended_errors, errors)
        )
        ratios.append(extended / floor)
        causes = ", ".join(c.effect for c in found.causes)
        rows.append(
            (name, *(f"{x:.3f}" for x in (base, extended, floor)), f"{ratios[-1]:.2f}",
             found.verdict, causes)
        )  # fmt: skip
    worst = f" Extended over floor: median {np.median(ratios):.2f}, worst {max(ratios):.2f}."
    return Outcome(
        (
            TitledTable(
                "Measured records and their floors", Table(_HEAD, tuple(rows)), _NOTE + worst
            ),
        )
    )
