"""`psa diagnose` on the measured micromanipulator: a record, both, and one on the other."""

from functools import partial

import psa_casadi as psa
from psa_casadi import datasets
from psa_casadi.report.plots.figures import narrow_figure
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose the records; `quick` takes the sine alone, whose picture is that of README.md."""
    sine, loops = datasets.micromanipulator()
    cases = {
        "sine_1hz": ([sine], []), "minor_loops": ([loops], []), "both files": ([sine, loops], []),
        "minor_loops, judged on sine_1hz": ([loops], [sine]),
    }  # fmt: skip
    rows, diagnoses = [], list[psa.StackDiagnosis]()
    for name in list(cases)[: 1 if quick else None]:
        progress(name)
        d = psa.diagnose(cases[name][0], holdout=cases[name][1])
        diagnoses.append(d)
        rows.append({
            "records": name, "base, held out": f"{d.base_errors.holdout_nrmse_percent:.2f}",
            "extended, held out": f"{d.extended_errors.holdout_nrmse_percent:.2f}",
            "verdict": d.verdict, "causes": ", ".join(c.effect for c in d.causes),
        })  # fmt: skip
    table = TitledTable("Micromanipulator of Y. N. Aye, rms in percent of range", rows)
    return Outcome([table], partial(narrow_figure, diagnoses[0]))
