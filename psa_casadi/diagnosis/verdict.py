"""From the steps of a search to the diagnosis: verdict, blind spots, rivals, next record.

What belongs to the sensor or the environment stays out of an exported plant. Where the records
cannot tell such a cause from one of the plant, which of the two is exported is not theirs to say.
So there are two models, and the difference of their plants' displacements is told.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.confirmation import Excess, coverage_notes, held_out_excess, unconfirmed
from psa_casadi.diagnosis.corrections import corrections
from psa_casadi.diagnosis.held_out import (
    Budget,
    Share,
    budget,
    errors_of,
    gain_of,
    held_out_parts,
    jackknife,
    lost_elsewhere,
    whole_residuals,
)
from psa_casadi.diagnosis.judgement import (
    Balance,
    told_from,
    too_small,
    vague_note,
    verdict_by,
    withdrawn_names,
)
from psa_casadi.diagnosis.misfit import FEWEST, Misfit, misfit
from psa_casadi.diagnosis.noise import NoiseFloor, noise_floor, pooled_level
from psa_casadi.diagnosis.pack import Task
from psa_casadi.diagnosis.patch import patch_of, with_patch
from psa_casadi.diagnosis.remedy import sizes
from psa_casadi.diagnosis.result import (
    Alternative,
    BlindSpot,
    Candidate,
    Cause,
    Diagnosis,
    NextExperiment,
    Remaining,
    Verdict,
    estimates,
)
from psa_casadi.diagnosis.search.fits import to_end, with_cause
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale
from psa_casadi.diagnosis.search.steps import Step, contenders
from psa_casadi.diagnosis.task import Thresholds, same_curves
from psa_casadi.errors import InputError, PsaError
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.evidence import evidence_of
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.identify import with_provenance
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import ErrorBudget, ErrorShare, HeldOut
from psa_casadi.notes import Note, note
from psa_casadi.records.record import Record
from psa_casadi.records.repeats import held, repeats
from psa_casadi.records.split import Experiment, counts, loop_sizes
from psa_casadi.simulation.simulate import simulate_record
from psa_casadi.simulation.start import memory_names
from psa_casadi.simulation.timings import stage
from psa_casadi.variables import Interval


def blind_spots(
    steps: Sequence[Step], final: Step, table: Sequence[Component], limits: Thresholds
) -> tuple[BlindSpot, ...]:
    """Return effects whose smallest gain that shows on these records is more than ordinary.

    Not those that the records do show, fitted with evidence, or as likely as a cause.
    """
    spots = []
    present = {c.name for c in final.fit.model.components}
    present |= {n for s in steps for n in s.fitted if s.evidence.get(n, -np.inf) > limits.price}
    present |= {n for s in steps for n in told_from(s, limits)}
    factor = np.sqrt(final.screening.threshold)
    for effect in [e for e in table if e.name not in present]:
        scores = [s for s in final.screening.scores if s.direction.effect is effect]
        gain = next(p for p in effect.parameters if p.name == effect.gain)
        practical = gain.typical(final.fit.model.with_effect(effect, {gain.name: 0.0}).values)
        smallest = min((factor * s.detectable_gain for s in scores), default=np.inf)
        if smallest > practical:
            why = note(
                "blind_spot" if np.isfinite(smallest) else "blind",
                effect=effect.name, gain=gain.name,
                smallest=(smallest, gain.unit), ordinary=(practical, gain.unit),
            )  # fmt: skip
            spots.append(BlindSpot(effect.name, float(min(smallest, 1e300)), gain.unit, why))
    return tuple(spots)


#: A hold lasts so long [s]; the durations of the largest rises lie in so many bands, each a factor
#: of four wide, and loops have so many sizes.
_HOLD, _RATES, _SIZES = 3.0, 2, 3


def next_experiment(
    causes: Sequence[Cause],
    verdict: Verdict,
    alike: Sequence[Sequence[str]],
    records: Sequence[Record],
    *,
    doubted: bool,
) -> NextExperiment:
    """Return what to do next; `alike` are groups of effects that only a resonance tells apart."""
    if verdict == "not_driven":
        return NextExperiment(None, (), (note("correct_columns"),))
    if doubted:
        return NextExperiment(None, (), (note("record_again"),))
    open_ones = [(c.effect, *c.cannot_be_told_from) for c in causes if c.cannot_be_told_from]
    rivals = tuple(dict.fromkeys(n for own in open_ones for n in own))
    same = [own for own in open_ones if any(set(own) <= set(group) for group in alike)]
    steps = [note("same_curve", effects=own) for own in same]
    if verdict in ("unexplained", "partly_explained") or len(same) < len(open_ones):
        steps.append(useful_records(records))
    if steps:
        return NextExperiment(None, rivals, tuple(steps))
    return NextExperiment(None, (), (note("no_next"),))


def useful_records(records: Sequence[Record]) -> Note:
    """Return what to record next: what of holds, rates, amplitudes and repeats is lacking.

    Where nothing is, other conditions or quantities must decide.
    """
    span = max(float(np.ptp(r.voltage)) for r in records)
    kinds = counts(records, [np.ones(r.n, dtype=bool) for r in records], span)
    moves = [k for k in kinds if k.way]
    largest = max((k.size for k in moves), default=0)
    holds = max((float(r.time[b - 1] - r.time[a]) for r in records for a, b in held(r)), default=0)
    there = {
        "hold": holds >= _HOLD,
        "rates": len({k.band for k in moves if k.size == largest}) >= _RATES,
        "amplitudes": loop_sizes(records, span) >= _SIZES,
        "repeats": any(repeats(r) is not None for r in records),
    }
    lacking = tuple(what for what, found in there.items() if not found)
    return note("lacking", what=lacking) if lacking else note("other_conditions")


def alternatives(
    named: Sequence[Step], final: Fit, task: Task, *, stiffness_given: bool
) -> tuple[Alternative, ...]:
    """Return, for each cause that may lie on the other side of the sensor, the model with that one.

    Of several such effects the likeliest that can be fitted and simulated.
    """
    effects, experiments = {e.name: e for e in task.table}, task.experiments
    found = []
    for step in named:
        for name in sorted(
            told_from(step, task.limits), key=lambda n: -step.probability.get(n, 0.0)
        ):
            if name not in effects or effects[name].in_plant == step.cause.in_plant:
                continue
            fitted = _fitted(step, name, experiments)
            if fitted is None:
                continue
            try:
                differs = _difference(final, fitted.fit, experiments)
            except PsaError:
                continue
            model = diagnosed_model(fitted.fit, experiments, fitted.predicted, stiffness_given)
            found.append(
                Alternative(step.cause.name, name, model, fitted.fit.rms / final.rms, *differs)
            )
            break
    return tuple(found)


def _fitted(step: Step, name: str, experiments: Sequence[Experiment]) -> Hypothesis | None:
    """Return the hypothesis with another effect in a cause's place, fitted to its end."""
    known = step.instead.get(name)
    if known is None and step.beside is not None:
        starts = step.beside.starts_of(name)
        known = with_cause(step.beside.of, experiments, starts) if starts else None
    return known if known is None or known.final else to_end(known, experiments)


def _difference(one: Fit, other: Fit, experiments: Sequence[Experiment]) -> tuple[float, float]:
    """Return by how much the plants of two fits differ on the records: most [m], and % of range.

    About the mean difference of each record, as the sensor's zero is free.
    """
    most = span = 0.0
    for k, e in enumerate(experiments):
        moved = []
        for fit in (one, other):
            plant = fit.model.plant()
            names = memory_names(plant.structure)
            memory = {n: v for n, v in fit.starts()[k].items() if n in names}
            moved.append(simulate_record(plant, e.record, memory).outputs["displacement"])
        apart = moved[0] - moved[1]
        most = max(most, float(np.max(np.abs(apart - np.mean(apart)))))
        span = max(span, e.record.range_m)
    return most, 100.0 * most / span


FloatArray = npt.NDArray[np.float64]

#: Verdicts that name causes.
NAMING: tuple[Verdict, ...] = ("cause_named", "partly_explained", "ambiguous")


def diagnosed_model(
    fit: Fit,
    experiments: Sequence[Experiment],
    predicted: Sequence[FloatArray],
    stiffness_given: bool,
    spent: Budget | None = None,
) -> Model:
    """Return a model of a diagnosis with what stands behind it; `spent` is its error's budget."""
    found = determinacy(fit, experiments)
    told = replace(
        evidence_of(fit, found, experiments, predicted, by="psa diagnose"),
        held_out=_held_out(experiments, predicted),
        budget=None
        if spent is None
        else ErrorBudget(
            base_m=spent.excess_rms_m,
            noise_m=spent.noise_rms_m,
            remains_m=spent.remains_rms_m,
            remains_percent=spent.remains_percent,
            causes=tuple(_share(s) for s in spent.causes),
            unnamed=None if spent.unnamed is None else _share(spent.unnamed),
        ),
    )
    records = [e.record for e in experiments]
    return with_provenance(fit.model, found, records, stiffness_given, evidence=told)


def _held_out(experiments: Sequence[Experiment], predicted: Sequence[FloatArray]) -> HeldOut | None:
    """Return the held-out error with the jackknife interval of its logarithm over the parts."""
    sums, counts = held_out_parts(experiments, predicted)
    if not len(counts):
        return None
    errors = errors_of(experiments, predicted)

    def of(kept: npt.NDArray[np.bool_]) -> float:
        power = float(np.sum(sums[kept])) / max(int(np.sum(counts[kept])), 1)
        return 0.5 * float(np.log(max(power, 1e-300)))

    centre, half = jackknife(of, len(counts))
    records = sum(bool(e.held_out.any()) for e in experiments)
    return HeldOut(
        rms_m=errors.holdout_rms_m,
        interval_m=Interval(float(np.exp(centre - half)), float(np.exp(centre + half))),
        max_m=errors.holdout_max_m,
        nrmse_percent=errors.holdout_nrmse_percent,
        records=records if len(counts) == records else 0,
    )


def _share(s: Share) -> ErrorShare:
    return ErrorShare(s.what, s.share, Interval(*s.interval))


@stage("judging")
def conclude(
    steps: Sequence[Step], task: Task, stiffness_given: bool, *, driven: bool = True
) -> Diagnosis:
    """Judge the steps of a search and return the diagnosis.

    Of records whose displacement is not `driven` by the voltage nothing more is said.
    """
    experiments, table, limits = task.experiments, task.table, task.limits
    first, last = steps[0], steps[-1]
    colour = last.screening.colour
    errors = whole_residuals(experiments, last.predicted)
    base_errors = whole_residuals(experiments, first.predicted)
    noise = noise_floor([e.record for e in experiments], errors)
    floor = pooled_level(noise, errors, colour)
    beyond = held_out_excess(
        first.fit, experiments, first.predicted, first.screening.colour, noise, limits
    )
    unseen = (
        Excess()
        if last is first
        else held_out_excess(last.fit, experiments, last.predicted, colour, noise, limits)
    )
    missing = first.test.alarm or first.chosen is not None or bool(beyond)
    balance = Balance(experiments, Scale(first.view.of, colour, limits), floor)
    weighed = balance.weigh(first.view.of, last.view.of, beside=missing and driven)
    beaten = weighed.beaten_by()
    gain = gain_of(experiments, first.predicted, last.predicted)
    partly = last.test.alarm and len(steps) > 1
    whole = 100.0 * (1.0 - floor / max(first.view.of.holdout_rms, 1e-300))
    lost = lost_elsewhere(experiments, first.predicted, last.predicted, colour.inflation)
    doubt = unconfirmed(
        experiments, gain, whole=whole, lost=lost, partly=partly, hidden=task.hidden, limits=limits
    )
    stands = beaten is None and doubt is None
    vague = balance.vague(steps) if stands else {}
    found = [s for s in steps if s.chosen is not None and s.cause.name not in vague]
    little = last.test.alarm and weighed.share < limits.enough
    verdict: Verdict = "not_driven"
    if driven:
        verdict = verdict_by(
            missing=missing,
            withdrawn=not stands or not found or little,
            ambiguous=bool(found and told_from(found[0], limits)),
            more=last.test.alarm or bool(unseen) or bool(vague),
        )
    weak = verdict == "unexplained" and stands and not vague and weighed.adds
    kept = [s for s in steps if s.chosen] if verdict in NAMING or weak else []
    final = last if kept else first
    patch = patch_of(
        corrections(last.fit, experiments, colour) if kept else weighed.corrections,
        experiments,
        final.view.of.holdout_rms,
        colour,
        limits,
    )
    missed = _misfits(experiments, base_errors, noise)
    spent = budget(
        experiments,
        first.predicted,
        final.predicted,
        [(s.cause.name, s.without.predicted) for s in kept if s.without is not None],
        None if patch is None else (patch.name, patch.predicted),
        floor,
    )
    model = diagnosed_model(final.fit, experiments, final.predicted, stiffness_given, spent)
    named = kept if verdict in NAMING else []
    small = (
        too_small([c for c in spent.causes if c.what not in vague], limits)
        if partly and named
        else ()
    )
    unnamed = {*vague, *(c.what for c in small)}
    causes = tuple(_cause(s, model, spent, task) for s in named if s.cause.name not in unnamed)
    return Diagnosis(
        verdict=verdict,
        causes=causes,
        candidates=_candidates(first, floor, named=bool(named)),
        noise_floor_rms_m=floor,
        base_errors=errors_of(experiments, first.predicted),
        extended_errors=errors_of(experiments, final.predicted),
        gain=gain if kept else gain_of(experiments, first.predicted, final.predicted),
        blind_to=blind_spots(steps, final, table, limits),
        remaining=_remaining(final, unseen if kept else beyond),
        next_experiment=next_experiment(
            causes,
            verdict,
            same_curves(experiments, table, first.fit),
            [e.record for e in experiments],
            doubted=doubt is not None,
        ),
        doubted=doubt if verdict in ("adequate", "unexplained") else None,
        remarks=(
            *model.provenance.notes,
            *(
                withdrawn_names(steps, weighed, beaten, vague, doubt)
                if verdict == "unexplained"
                else vague_note(vague)
            ),
            *(note("small", effect=c.what, share=max(c.share, 0.0)) for c in small),
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
        contenders=contenders(first, experiments, limits) if verdict == "ambiguous" else (),
        budget=spent,
        patch=patch,
        alternatives=alternatives(kept, final.fit, task, stiffness_given=stiffness_given),
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
    return diagnosed_model(found, d.experiments, found.predicted(d.experiments), given)


def _misfits(
    experiments: Sequence[Experiment], errors: Sequence[FloatArray], noise: Sequence[NoiseFloor]
) -> tuple[Misfit, ...]:
    return tuple(
        misfit(e.record, error, floor)
        for e, error, floor in zip(experiments, errors, noise, strict=True)
        if np.count_nonzero(np.isfinite(error)) >= FEWEST
    )


def _cause(s: Step, model: Model, spent: Budget, task: Task) -> Cause:
    """State a cause: its probability, the share of the error that it removes, what it changes."""
    records = [e.record for e in task.experiments]
    own = next((c for c in spent.causes if c.what == s.cause.name), None)
    return Cause(
        effect=s.cause.name,
        belongs_to=s.cause.belongs_to,
        confidence=float(min(0.99, s.probability[s.cause.name])),
        parameters=estimates(s.cause, model),
        cannot_be_told_from=told_from(s, task.limits),
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
    power = first.screening.colour.level**2 / len(first.fit.residuals)
    gone = {n: s.decrease * power for n, s in first.screening.best_by_effect().items()}
    gone |= {n: h.removes(first.view.of) for n, h in first.fitted.items()}
    rows = [
        Candidate(
            effect=name,
            explained_share=float(np.clip(removed / excess, 0.0, 1.0)),
            evidence=first.alone[name],
            fitted=name in first.fitted,
            probability=first.probability.get(name, 0.0) if named else 0.0,
        )
        for name, removed in gone.items()
    ]
    return tuple(sorted(rows, key=lambda c: (-c.fitted, -c.evidence)))


def _remaining(r: Step, beyond: Excess) -> Remaining:
    """Return what is left; `beyond` the fit where that leaves nothing to be seen."""
    p_value = min(r.test.p_value, beyond.p_value)
    if r.test.alarm:
        return Remaining(False, p_value, r.test.finding)
    if beyond:
        return Remaining(False, p_value, note("held_out_error", factor=beyond.factor))
    return Remaining(True, p_value)
