"""The measured micromanipulator: the paper's model and two effects, judged on held-out blocks.

And what `diagnose` finds in the records, one and both, and in one judged on the other; and what
the sine, of one amplitude, says of a cause that only the other records show.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import psa_casadi as psa
from psa_casadi import datasets
from psa_casadi.diagnosis.held_out import Errors, errors_of
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import refit
from psa_casadi.identification.search import search
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.records.split import Experiment, split
from psa_casadi.report.plots.figures import narrow_figure
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

#: What is added to the paper's model, one after the other, and where the gains start.
ADDED = {"rate_independent_asymmetry": {"delta_r": 0.01}, "sensor_delay": {"sensor_delay": 1e-3}}


def run(progress: Progress, quick: bool) -> Outcome:
    """Fit every measured record by itself; `quick` takes the shorter one alone.

    The picture is that of README.md: the diagnosis of the sine.
    """
    rows = []
    records = sorted(datasets.micromanipulator(), key=lambda r: r.n)
    for record in records[: 1 if quick else None]:
        experiments, name = [split(record)], "the paper's"
        progress(f"{record.name}: {name} model")
        fits = {name: search(starting_model([record]), experiments, thorough=True).best}
        for effect, start in ADDED.items():
            result = fits[name]
            name = f"{name}, {effect}" if len(fits) > 1 else f"with {effect}"
            progress(f"{record.name}: {name}")
            model, states = result.model.with_effect(psa.EFFECTS[effect], start), result.starts()
            more = (p.name for p in psa.EFFECTS[effect].parameters)
            free = [*result.unknowns.names, *more]
            how: Any = {"sigma": result.sigma, "start_states": states}
            fits[name] = refit(fit(model, experiments, free, **how), experiments, free)
        for name, fitted in fits.items():
            e, share = _errors(fitted, experiments), 100.0 / record.range_m
            rows.append({
                "record": record.name, "model": name,
                "fitted, rms": f"{share * e.train_rms_m:.3f} %",
                "held out, rms": f"{share * e.holdout_rms_m:.3f} %",
                "held out, largest": f"{share * e.holdout_max_m:.2f} %",
            })  # fmt: skip
    note = "One of every four of 16 blocks between reversals is held out and never fitted."
    whole = TitledTable("Micromanipulator of Y. N. Aye, percent of range", rows, note)
    if quick:
        return Outcome((whole,))
    tables, sine = _diagnoses(progress)
    return Outcome((whole, *tables), partial(narrow_figure, sine))


def _diagnoses(progress: Progress) -> tuple[list[TitledTable], psa.StackDiagnosis]:
    """Diagnose what the table of `docs/evidence.md` diagnoses; return the sine's as well.

    And fit the sine again with every cause that others have and it has not, as it is found there,
    and with its sign turned: where both are as good, the sine does not see the cause.
    """
    sine, loops = datasets.micromanipulator()
    table = {
        "sine_1hz": ([sine], []), "minor_loops": ([loops], []), "both files": ([sine, loops], []),
        "minor_loops, judged on sine_1hz": ([loops], [sine]),
    }  # fmt: skip
    rows, diagnoses = [], {}
    for name, (records, held_out) in table.items():
        progress(f"{name}: the diagnosis")
        diagnoses[name] = d = psa.diagnose(records, holdout=held_out)
        rows.append({
            "records": name, "base, held out": f"{d.base_errors.holdout_nrmse_percent:.2f}",
            "extended, held out": f"{d.extended_errors.holdout_nrmse_percent:.2f}",
            "verdict": d.verdict, "causes": ", ".join(c.effect for c in d.causes),
        })  # fmt: skip
    progress("the sine with causes of the others")
    result = diagnoses["sine_1hz"]
    item = result.extended_fit
    fits, there = [("as diagnosed", "", item)], {c.name for c in item.model.components}
    for name in ("minor_loops", "both files"):
        values = diagnoses[name].extended_fit.model.values
        causes = (psa.EFFECTS[c.effect] for c in diagnoses[name].causes if c.effect not in there)
        for cause in causes:
            for sign, output in ((1.0, cause.name), (-1.0, f"{cause.name}, sign turned")):
                fixed = {p.name: values[p.name] for p in cause.parameters}
                fixed |= {p: sign * values[p] for p in fixed if p == cause.gain}
                start = replace(item, model=item.model.with_effect(cause, fixed))
                again = refit(start, result.experiments, item.unknowns.names)
                fits.append((output, name, again))
    told_by_sine = []
    for output, name, fitted in fits:
        e = _errors(fitted, result.experiments)
        told_by_sine.append({
            "the sine, fitted with": output, "as found in": name,
            "fitted, rms": f"{1e9 * e.train_rms_m:.2f} nm",
            "held out, rms": f"{1e9 * e.holdout_rms_m:.2f} nm",
        })  # fmt: skip
    return [
        TitledTable("What diagnose finds, percent of range", rows),
        TitledTable("What the sine says of causes of the other records", told_by_sine),
    ], result


def _errors(found: Fit, experiments: Sequence[Experiment]) -> Errors:
    return errors_of(experiments, found.predicted(experiments))
