"""The measured micromanipulator: the paper's model and two effects, judged on held-out blocks.

And what `diagnose` finds in the records, one and both, and in one judged on the other; and what
the sine, of one amplitude, says of a cause that only the other records show.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from psa_casadi import datasets
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.held_out import Errors, errors_of
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import refit
from psa_casadi.identification.search import search
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.records.split import Experiment, split
from psa_casadi.report.plots.figures import narrow_figure
from psa_casadi.report.words.tables import Table
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
        experiments = [split(record)]
        progress(f"{record.name}: the paper's model")
        found = search(starting_model([record]), experiments, thorough=True).best
        names, fits = [], {"the paper's": found}
        for name, start in ADDED.items():
            names.append(name)
            progress(f"{record.name}: with {name}")
            model, states = found.model.with_effect(EFFECTS[name], start), found.starts()
            free = [*found.unknowns.names, *(p.name for p in EFFECTS[name].parameters)]
            how: Any = {"sigma": found.sigma, "start_states": states}
            found = refit(fit(model, experiments, free, **how), experiments, free)
            fits["with " + ", ".join(names)] = found
        for name, fitted in fits.items():
            e, share = _errors(fitted, experiments), 100.0 / record.range_m
            rms = (f"{share * x:.3f} %" for x in (e.train_rms_m, e.holdout_rms_m))
            rows.append((record.name, name, *rms, f"{share * e.holdout_max_m:.2f} %"))
    head = ("record", "model", "fitted, rms", "held out, rms", "held out, largest")
    tables, sine = ([], None) if quick else _diagnoses(progress)
    whole = TitledTable(
        "Micromanipulator of Y. N. Aye, percent of range",
        Table(head, tuple(rows)),
        "One of every four of 16 blocks between reversals is held out and never fitted.",
    )
    return Outcome((whole, *tables), None if sine is None else partial(narrow_figure, sine))


def _diagnoses(progress: Progress) -> tuple[list[TitledTable], Diagnosis]:
    """Diagnose what the table of `docs/measured.md` diagnoses; return the sine's as well."""
    sine, loops = datasets.micromanipulator()
    given = {
        "sine_1hz": ([sine], []), "minor_loops": ([loops], []), "both files": ([sine, loops], []),
        "minor_loops, judged on sine_1hz": ([loops], [sine]),
    }  # fmt: skip
    rows, diagnoses = [], {}
    for name, (records, held_out) in given.items():
        progress(f"{name}: the diagnosis")
        diagnoses[name] = found = diagnose(records, holdout=held_out)
        shares = [
            f"{e.holdout_nrmse_percent:.2f}" for e in (found.base_errors, found.extended_errors)
        ]
        causes = ", ".join(c.effect for c in found.causes)
        rows.append((name, *shares, found.verdict, causes))
    head = ("records", "base, held out", "extended, held out", "verdict", "causes")
    table = TitledTable("What diagnose finds, percent of range", Table(head, tuple(rows)))
    progress("the sine with causes of the others")
    others = {n: diagnoses[n] for n in ("minor_loops", "both files")}
    found = diagnoses["sine_1hz"]
    return [table, _said_of_others(found, others)], found


def _said_of_others(sine: Diagnosis, others: Mapping[str, Diagnosis]) -> TitledTable:
    """Fit the sine again with every cause that others have and it has not, as it is found there.

    And with its sign turned: where both are as good, the sine does not see the cause.
    """
    own = sine.extended_fit
    fits = [("as diagnosed", "", own)]
    there = {c.name for c in own.model.components}
    for name, found in others.items():
        values = found.extended_fit.model.values
        for cause in (EFFECTS[c.effect] for c in found.causes if c.effect not in there):
            for sign, told in ((1.0, cause.name), (-1.0, f"{cause.name}, sign turned")):
                given = {p.name: values[p.name] for p in cause.parameters}
                given |= {p: sign * values[p] for p in given if p == cause.gain}
                fixed = replace(own, model=own.model.with_effect(cause, given))
                again = refit(fixed, sine.experiments, own.unknowns.names)
                fits.append((told, name, again))
    rows = []
    for told, name, fitted in fits:
        e = _errors(fitted, sine.experiments)
        rows.append(
            (told, name, f"{1e9 * e.train_rms_m:.2f} nm", f"{1e9 * e.holdout_rms_m:.2f} nm")
        )
    head = ("the sine, fitted with", "as found in", "fitted, rms", "held out, rms")
    title = "What the sine says of causes of the other records"
    return TitledTable(title, Table(head, tuple(rows)))


def _errors(found: Fit, experiments: Sequence[Experiment]) -> Errors:
    return errors_of(experiments, found.predicted(experiments))
