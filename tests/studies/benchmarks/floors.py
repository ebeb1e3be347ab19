"""The benchmark `floors`: held-out errors of diagnoses of measured records, and the floor of each.

The floor is the held-out error of many features fitted together, none of them with a physical
meaning: what a model of the plant's kind could reach at best on the same samples.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

import psa_casadi as psa
from psa_casadi import datasets
from psa_casadi.diagnosis.held_out import Errors, errors_of
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records.split import Experiment
from tests.studies.benchmarks.floor_fit import Part, floor_of
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable


def run(progress: Progress, quick: bool, folder: Path | None = None) -> Outcome:
    """Diagnose the public records, or those of a folder; `quick` takes the shortest alone."""
    if folder is not None:
        paths = sorted(folder.glob("*.csv"))
        if not paths:
            raise psa.InputError(f"{folder}: holds no CSV file; name the folder with your records.")
        cases = [(r.name, [r]) for r in psa.read_records(paths)]
    else:
        sine, loops = datasets.micromanipulator()
        cases = [("minor loops", [loops])]
        if not quick:
            axis = datasets.load("steering_mirror")[0]
            cases += [("sine", [sine]), ("both", [sine, loops]), (axis.name, [axis])]
    rows, ratios = [], []
    for name, records in cases:

        def report(step: str, name: str = name) -> None:
            progress(f"{name}: {step}")

        d = psa.diagnose(records, progress=report)
        errors = (d.base_errors, d.extended_errors, floor_on(d.experiments, report))
        base, extended, floor = (e.holdout_nrmse_percent for e in errors)
        ratios.append(extended / floor)
        rows.append({
            "record": name, "base": f"{base:.3f}", "extended": f"{extended:.3f}",
            "floor": f"{floor:.3f}", "extended / floor": f"{ratios[-1]:.2f}", "verdict": d.verdict,
            "causes": ", ".join(c.effect for c in d.causes),
        })  # fmt: skip
    note = (
        "Held-out rms, percent of range, in the samples that `psa diagnose` holds out. The floor:"
        " plays with squares and cubes, relaxations over decades, modes, a fine curve over the"
        " displacement, linear in their weights, their prior sizes and their number by evidence."
        f" Extended over floor: median {np.median(ratios):.2f}, worst {max(ratios):.2f}."
    )
    return Outcome((TitledTable("Measured records and their floors", rows, note),))


def floor_on(experiments: Sequence[Experiment], progress: Progress) -> Errors:
    """Return the errors of the floor of experiments, in training and held-out samples."""
    voltages = np.concatenate([e.record.voltage for e in experiments])
    middle, half = 0.5 * (voltages.max() + voltages.min()), 0.5 * float(np.ptp(voltages))
    size = max(e.record.range_m for e in experiments)
    parts = [
        Part((e.record.voltage - middle) / half, measured(e.record) / size, e.used)
        for e in experiments
    ]
    return errors_of(experiments, [size * y for y in floor_of(parts, progress).predicted])
