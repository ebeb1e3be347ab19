"""From the steps of the search to verdict, confidence, blind spots and what to do next."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.alternatives import alternatives
from psa_casadi.diagnosis.blind_spots import blind_spots, shown
from psa_casadi.diagnosis.budget import Budget, budget
from psa_casadi.diagnosis.corrections.correct import corrections
from psa_casadi.diagnosis.corrections.export import with_patch
from psa_casadi.diagnosis.corrections.patch import patch_of
from psa_casadi.diagnosis.evidence import diagnosis_evidence
from psa_casadi.diagnosis.held_out.confirmation import unconfirmed
from psa_casadi.diagnosis.held_out.coverage import coverage_notes
from psa_casadi.diagnosis.held_out.errors import (
    errors_of,
    gain_of,
    lost_elsewhere,
    whole_residuals,
)
from psa_casadi.diagnosis.held_out.generalisation import Excess, held_out_excess
from psa_casadi.diagnosis.judgement import (
    SMALL_NOTE,
    told_from,
    too_small,
    vague_note,
    verdict_of,
    withdrawn_names,
)
from psa_casadi.diagnosis.next_record import next_experiment
from psa_casadi.diagnosis.noise.floor import NoiseFloor, noise_floor, pooled_level
from psa_casadi.diagnosis.remedy.size import sizes
from psa_casadi.diagnosis.residual.misfit import FEWEST, Misfit, misfit
from psa_casadi.diagnosis.result import (
    Candidate,
    Cause,
    Diagnosis,
    Estimate,
    Remaining,
    Verdict,
)
from psa_casadi.diagnosis.search.contenders import contenders
from psa_casadi.diagnosis.search.hypothesis import Scale
from psa_casadi.diagnosis.search.steps import Step
from psa_casadi.diagnosis.task import same_curves
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.diagnosis.weighing import Balance
from psa_casadi.errors import InputError
from psa_casadi.identification.determinacy import Determinacy, determinacy
from psa_casadi.identification.identify import with_provenance
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.timings import stage

FloatArray = npt.NDArray[np.float64]

#: Verdicts that name causes.
NAMING: tuple[Verdict, ...] = ("cause_named", "partly_explained", "ambiguous")
_HELD_OUT = (
    "The held-out samples' error is {:.2f} times what the fitted ones let expect: something matters"
    " there that these do not show."
)


@stage("judging")
def conclude(
    steps: Sequence[Step],
    experiments: Sequence[Experiment],
    table: Sequence[Component],
    stiffness_given: bool,
    *,
    driven: bool = True,
    hidden: float = 0.0,
) -> Diagnosis:
    """Judge the steps of a search and return the diagnosis.

    Of records whose displacement is not `driven` by the voltage nothing more is said. `hidden` is
    the share of the readings that a saturated sensor has made.
    """
    first, last = steps[0], steps[-1]
    colour = last.screening.colour
    errors = whole_residuals(experiments, last.predicted)
    base_errors = whole_residuals(experiments, first.predicted)
    noise = noise_floor([e.record for e in experiments], errors)
    floor = pooled_level(noise, errors, colour)
    beyond = held_out_excess(first.fit, experiments, first.predicted, first.screening.colour, noise)
    unseen = Excess()
    if last is not first:
        unseen = held_out_excess(last.fit, experiments, last.predicted, colour, noise)
    missing = first.test.alarm or first.chosen is not None or bool(beyond)
    balance = Balance(experiments, Scale(first.view.of, colour, thresholds().price), floor)
    weighed = balance.weigh(first.view.of, last.view.of, beside=missing and driven)
    beaten = weighed.beaten_by()
    gain = gain_of(experiments, first.predicted, last.predicted)
    partly = last.test.alarm and len(steps) > 1
    whole = 100.0 * (1.0 - floor / max(first.view.of.holdout_rms, 1e-300))
    lost = lost_elsewhere(experiments, first.predicted, last.predicted, colour.inflation)
    doubt = unconfirmed(experiments, gain, whole=whole, lost=lost, partly=partly, hidden=hidden)
    vague = {} if beaten is not None or doubt else balance.vague(steps)
    verdict: Verdict = (
        "not_driven"
        if not driven
        else verdict_of(
            steps,
            missing=missing,
            withdrawn=bool(beaten or doubt),
            share=weighed.share,
            unseen=bool(unseen),
            unnamed=vague,
        )
    )
    weak = verdict == "unexplained" and not (beaten or doubt or vague) and weighed.adds
    kept = [s for s in steps if s.chosen] if verdict in NAMING or weak else []
    final = last if kept else first
    patch = patch_of(
        corrections(last.fit, experiments, colour) if kept else weighed.corrections,
        experiments,
        final.view.of.holdout_rms,
        colour,
    )
    found = determinacy(final.fit, experiments)
    missed = _misfits(experiments, base_errors, noise)
    spent = budget(
        experiments,
        first.predicted,
        final.predicted,
        [(s.cause.name, s.without.predicted) for s in kept if s.without is not None],
        None if patch is None else (patch.name, patch.predicted),
        floor,
    )
    model = with_provenance(
        final.fit.model,
        found,
        [e.record for e in experiments],
        stiffness_given,
        evidence=diagnosis_evidence(final.fit, found, experiments, final.predicted, spent),
    )
    named = kept if verdict in NAMING else []
    small = too_small([c for c in spent.causes if c.what not in vague]) if partly and named else ()
    unnamed = {*vague, *(c.what for c in small)}
    causes = tuple(
        _cause(s, model, found, spent, experiments) for s in named if s.cause.name not in unnamed
    )
    return Diagnosis(
        verdict=verdict,
        causes=causes,
        candidates=_candidates(first, floor, named=bool(named)),
        noise_floor_rms_m=floor,
        base_errors=errors_of(experiments, first.predicted),
        extended_errors=errors_of(experiments, final.predicted),
        gain=gain if kept else gain_of(experiments, first.predicted, final.predicted),
        blind_to=blind_spots(final, [e for e in table if e.name not in shown(steps)]),
        remaining=_remaining(final, unseen if kept else beyond),
        next_experiment=next_experiment(
            causes,
            verdict,
            same_curves(experiments, table, first.fit),
            [e.record for e in experiments],
            doubted=bool(doubt),
        ),
        doubt=doubt if verdict in ("adequate", "unexplained") else "",
        notes=(
            *model.provenance.notes,
            *(
                withdrawn_names(steps, weighed, beaten, vague, doubt)
                if verdict == "unexplained"
                else vague_note(vague)
            ),
            *(SMALL_NOTE.format(c.what, 100 * max(c.share, 0.0)) for c in small),
            *coverage_notes(experiments),
        ),
        experiments=tuple(experiments),
        base_fit=first.fit,
        extended_fit=final.fit,
        base=first.predicted,
        extended=final.predicted,
        model=model,
        noise=noise,
        misfit=missed,
        remainder=_misfits(experiments, errors, noise) if kept else missed,
        contenders=contenders(first, experiments) if verdict == "ambiguous" else (),
        budget=spent,
        patch=patch,
        alternatives=alternatives(
            kept, final.fit, experiments, table, stiffness_given=stiffness_given
        ),
    )


def patched_model(d: Diagnosis) -> Model:
    """Return the extended model with the unnamed correction fitted beside it, all values free.

    Raises InputError where a diagnosis has none, or one that no component stands for;
    SimulationError where it cannot be simulated.
    """
    if d.patch is None:
        raise InputError("No unnamed correction removes more than the extended model does.")
    found = with_patch(d.extended_fit, d.patch, d.experiments, d.extended)
    given = d.model.provenance.force_scale == "given"
    told = determinacy(found, d.experiments)
    evidence = diagnosis_evidence(found, told, d.experiments, found.predicted(d.experiments))
    records = [e.record for e in d.experiments]
    return with_provenance(found.model, told, records, given, evidence=evidence)


def _misfits(
    experiments: Sequence[Experiment],
    errors: Sequence[FloatArray],
    noise: Sequence[NoiseFloor],
) -> tuple[Misfit, ...]:
    return tuple(
        misfit(e.record, error, floor)
        for e, error, floor in zip(experiments, errors, noise, strict=True)
        if np.count_nonzero(np.isfinite(error)) >= FEWEST
    )


def _cause(
    s: Step, model: Model, found: Determinacy, spent: Budget, experiments: Sequence[Experiment]
) -> Cause:
    """State a cause: its probability, the share of the error that it removes, what it changes."""
    records = [e.record for e in experiments]
    estimates = {
        p.name: Estimate(
            model.values[p.name],
            p.unit,
            (found.intervals[p.name].low, found.intervals[p.name].high),
        )
        for p in s.cause.parameters
        if p.name in found.intervals
    }
    own = next((c for c in spent.causes if c.what == s.cause.name), None)
    return Cause(
        effect=s.cause.name,
        belongs_to=s.cause.belongs_to,
        confidence=float(min(0.99, s.probability[s.cause.name])),
        parameters=estimates,
        cannot_be_told_from=told_from(s),
        explained_share=0.0 if own is None else float(np.clip(own.share, 0.0, 1.0)),
        remedy=s.cause.what_now.code,
        sizes=sizes(s.cause, model, records, unit=records[0].displacement_unit),
    )


def _candidates(first: Step, floor: float, *, named: bool) -> tuple[Candidate, ...]:
    """Every effect tried, with its share of the training excess; estimated if not fitted.

    Where nothing is named no effect of the table has a probability.
    """
    base = float(np.mean(first.fit.residuals**2))
    excess = max(base - floor**2, 1e-300)
    rows = []
    scores = first.screening.best_by_effect()
    for name in dict.fromkeys((*scores, *first.fitted)):  # a series of modes was not screened
        known = first.fitted.get(name)
        if known is not None:
            gone = known.removes(first.view.of)
        else:
            level = first.screening.colour.level
            gone = scores[name].decrease * level**2 / len(first.fit.residuals)
        rows.append(
            Candidate(
                effect=name,
                explained_share=float(np.clip(gone / excess, 0.0, 1.0)),
                evidence=first.alone[name],
                fitted=known is not None,
                probability=first.probability.get(name, 0.0) if named else 0.0,
            )
        )
    return tuple(sorted(rows, key=lambda c: (-c.fitted, -c.evidence)))


def _remaining(r: Step, beyond: Excess) -> Remaining:
    """Describe what is left; `beyond` the fit where that leaves nothing to be seen."""
    where = "What remains cannot be distinguished from noise."
    if r.test.alarm:
        where = f"{r.test.where} {100 * r.test.excess:.0f} % of its power is above the noise."
    elif beyond:
        where = _HELD_OUT.format(beyond.factor)
    p_value = min(r.test.p_value, beyond.p_value)
    return Remaining(not (r.test.alarm or beyond), p_value, where)
