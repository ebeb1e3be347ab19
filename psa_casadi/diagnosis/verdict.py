"""What a diagnosis states of a stack more than of any model: blind spots, rivals, the next record.

What belongs to the sensor or the environment stays out of an exported plant. Where the records
cannot separate such a cause from one of the plant, they do not determine which one is exported.
So there are two models, and the difference of their plants' displacements is reported.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.diagnosis import held_out
from psa_casadi.diagnosis.corrections import Correction, corrections, with_patch
from psa_casadi.diagnosis.held_out import Compared, coverage_notes, held_out_excess, unconfirmed
from psa_casadi.diagnosis.judgement import Judge, indistinguishable
from psa_casadi.diagnosis.misfit import FEWEST, Misfit, misfit
from psa_casadi.diagnosis.noise import noise_floor, pooled_level
from psa_casadi.diagnosis.pack import Task
from psa_casadi.diagnosis.remedy import sizes
from psa_casadi.diagnosis.result import (
    Alternative,
    BlindSpot,
    Cause,
    Diagnosis,
    NextExperiment,
    OutputError,
    StackDiagnosis,
    Verdict,
)
from psa_casadi.diagnosis.search.fits import to_end, with_cause
from psa_casadi.diagnosis.search.hypothesis import Hypothesis
from psa_casadi.diagnosis.search.state import Step, contenders
from psa_casadi.diagnosis.task import same_curves
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.identify import with_provenance
from psa_casadi.identification.result import evidence_of
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import ErrorBudget, ErrorShare, HeldOut
from psa_casadi.model.variables import Interval
from psa_casadi.records.record import Record
from psa_casadi.records.repeats import held, repeats
from psa_casadi.records.split import Experiment, counts, loop_sizes
from psa_casadi.simulation.simulate import simulate_record
from psa_casadi.simulation.start import memory_names
from psa_casadi.simulation.timings import stage

#: What records need: length of a hold [s]; number of bands, each a factor of four wide, with
#: durations of the largest rises; number of sizes of loops.
_HOLD, _RATES, _SIZES = 3.0, 2, 3


def next_experiment(
    causes: Sequence[Cause],
    verdict: Verdict,
    groups: Sequence[Sequence[str]],
    records: Sequence[Record],
    *,
    doubted: bool,
) -> NextExperiment:
    """Return what to do next; `groups` are effects that only a resonance separates."""
    if verdict == "not_driven":
        return NextExperiment(None, (), (note("correct_columns"),))
    if doubted:
        return NextExperiment(None, (), (note("record_again"),))
    open_ones = [(c.effect, *c.cannot_be_told_from) for c in causes if c.cannot_be_told_from]
    rivals = tuple(dict.fromkeys(n for effects in open_ones for n in effects))
    same = [effects for effects in open_ones if any(set(effects) <= set(g) for g in groups)]
    steps = [note("same_curve", effects=effects) for effects in same]
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
    lacking = tuple(what for what, result in there.items() if not result)
    return note("lacking", what=lacking) if lacking else note("other_conditions")


def _fitted(step: Step, name: str) -> Hypothesis | None:
    """Return the hypothesis with another effect in a cause's place, fitted to its end."""
    known = step.instead.get(name)
    if known is None and step.view_without is not None:
        starts = step.view_without.starts_of(name)
        known = with_cause(step.view_without.of, starts) if starts else None
    return known if known is None or known.final else to_end(known)


def _difference(one: Fit, other: Fit) -> tuple[float, float]:
    """Return by how much the plants of two fits differ on the records: most [m], and % of range.

    About the mean difference of each record, as the sensor's zero is free.
    """
    most = span = 0.0
    for k, e in enumerate(one.experiments):
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


def diagnosed_model(
    fit: Fit,
    predicted: Sequence[FloatArray],
    stiffness_given: bool,
    spent: held_out.StackBudget | None = None,
) -> Model:
    """Return a model of a diagnosis with its evidence; `spent` is its error's budget."""
    result = determinacy(fit)
    evidence = replace(
        evidence_of(fit, result, predicted, by="psa diagnose"),
        held_out=_held_out(fit.experiments, predicted),
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
    records = [e.record for e in fit.experiments]
    return with_provenance(fit.model, result, records, stiffness_given, evidence=evidence)


def _held_out(experiments: Sequence[Experiment], predicted: Sequence[FloatArray]) -> HeldOut | None:
    """Return the held-out error with the jackknife interval of its logarithm over the parts."""
    sums, counts = held_out.held_out_parts(experiments, predicted)
    if not len(counts):
        return None
    errors = held_out.errors_of(experiments, predicted)

    def of(kept: BoolArray) -> float:
        power = float(np.sum(sums[kept])) / max(int(np.sum(counts[kept])), 1)
        return 0.5 * float(np.log(max(power, 1e-300)))

    centre, half = held_out.jackknife(of, len(counts))
    records = sum(bool(e.held_out.any()) for e in experiments)
    return HeldOut(
        rms_m=errors.holdout_rms_m,
        interval_m=Interval(float(np.exp(centre - half)), float(np.exp(centre + half))),
        max_m=errors.holdout_max_m,
        nrmse_percent=errors.holdout_nrmse_percent,
        records=records if len(counts) == records else 0,
    )


def _share(s: held_out.Share) -> ErrorShare:
    return ErrorShare(s.what, s.share, Interval(*s.interval))


class StackJudge(Judge):
    """The judge of a stack: repeats show its noise, its one output is its displacement."""

    def __init__(
        self, steps: Sequence[Step], task: Task, *, scale_given: bool, driven: bool = True
    ) -> None:
        super().__init__(steps, task, driven=driven)
        self.scale_given = scale_given
        self.errors, self.missed_errors = (
            held_out.whole_residuals(self.experiments, s.predicted) for s in (self.last, self.first)
        )
        self.floors = noise_floor([e.record for e in self.experiments], self.errors)
        self.floor = pooled_level(self.floors, self.errors, self.last.screening.colour)

    @property
    def noise(self) -> tuple[float, ...]:
        """The noise floor of the displacement."""
        return (self.floor,)

    @cached_property
    def doubt(self) -> Note | None:
        """Why the records do not confirm the causes."""
        compared = Compared(self.experiments, self.first.predicted, self.last.predicted)
        whole = 100.0 * (1.0 - self.floor / max(self.first.view.of.held[0], 1e-300))
        return unconfirmed(
            self.experiments,
            compared.gain,
            whole=whole,
            lost=compared.lost_elsewhere(self.last.screening.colour.inflation),
            partly=self.last.test.alarm and len(self.steps) > 1,
            hidden=self.task.hidden,
            limits=self.limits,
        )

    @cached_property
    def model(self) -> Model:
        """The extended model, with where its error goes."""
        return self._model_of(self.final.view.of, self.spent)

    def _model_of(self, of: Hypothesis, spent: held_out.StackBudget | None = None) -> Model:
        return diagnosed_model(of.fit, of.predicted, self.scale_given, spent)

    @cached_property
    def spent(self) -> held_out.StackBudget:
        """The error budget in lengths."""
        return self.compared.in_lengths(self.budget, self.floor)

    @cached_property
    def compared(self) -> Compared:
        """What base and extended model predict of the records."""
        return Compared(self.experiments, self.first.predicted, self.final.predicted)

    def corrections(self, of: Hypothesis) -> Sequence[Correction]:
        """Return the corrections of a hypothesis, by columns at the stack's ports."""
        return corrections(of.fit, self.last.screening.colour)

    def held_out_finding(self, step: Step) -> tuple[Note, float] | None:
        """Return by which factor held-out errors exceed those of the fit."""
        excess = held_out_excess(
            step.fit, step.predicted, step.view.of.colours[0], self.floors, self.limits
        )  # fmt: skip
        return (note("held_out_error", factor=excess.factor), excess.p_value) if excess else None

    def named(self, step: Step) -> Cause:
        """Return a cause with what it changes in the tests that its effect declares."""
        records = [e.record for e in self.experiments]
        unit = records[0].displacement_unit
        return self.cause(step, sizes(step.cause, self.model, records, unit=unit))

    def misfits(self, errors: Sequence[FloatArray]) -> tuple[Misfit, ...]:
        """Return what the errors (n,) of every record show, of those with enough samples."""
        rows = zip(self.experiments, errors, self.floors, strict=True)
        enough = [row for row in rows if np.count_nonzero(np.isfinite(row[1])) >= FEWEST]
        return tuple(misfit(e.record, error, floor) for e, error, floor in enough)

    def blind_spots(self) -> tuple[BlindSpot, ...]:
        """Return effects whose smallest gain that shows on these records is more than ordinary.

        Not those that the records do show, fitted with evidence, or as likely as a cause.
        """
        spots, final, limits = [], self.final, self.limits
        present = {c.name for c in final.fit.model.components}
        for s in self.steps:
            present |= {n for n in s.fitted if s.evidence.get(n, -np.inf) > limits.price}
            present |= {*indistinguishable(s, limits)}
        factor = np.sqrt(final.screening.threshold)
        for effect in [e for e in self.task.table if e.name not in present]:
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

    def alternatives(self) -> tuple[Alternative, ...]:
        """Return, for each cause that may lie on the other side of the sensor, the model with it.

        Of several such effects the likeliest that can be fitted and simulated.
        """
        in_plant = {e.name: e.in_plant for e in self.task.table}
        final, models = self.final.fit, []
        for step in self.kept:
            here = step.cause.in_plant
            rivals = indistinguishable(step, self.limits)
            others = [n for n in rivals if in_plant.get(n, here) != here]
            for name in sorted(others, key=lambda n: -step.probability.get(n, 0.0)):
                other = _fitted(step, name)
                if other is None:
                    continue
                try:
                    differs = _difference(final, other.fit)
                except PsaError:
                    continue
                model = self._model_of(other)
                ratio = other.fit.rms / final.rms
                models.append(Alternative(step.cause.name, name, model, ratio, *differs))
                break
        return tuple(models)

    @stage("judging")
    def conclude(self) -> StackDiagnosis:
        """Return the diagnosis."""
        experiments, final = self.experiments, self.final
        both = self.first.predicted, final.predicted
        misfits = self.misfits(self.missed_errors)
        records = [e.record for e in experiments]
        groups = same_curves(self.task.table, self.first.fit)
        ambiguous = self.verdict == "ambiguous"
        base, extended = (held_out.errors_of(experiments, p) for p in both)
        rms = base.holdout_rms_m, extended.holdout_rms_m
        output_error = OutputError("displacement", records[0].displacement_unit, self.floor, *rms)
        held = (s.view.of.held[1:] for s in (self.first, final))
        further = zip(final.fit.further, final.screening.colour.further, *held, strict=True)
        common = self.common | {"budget": self.spent}
        return StackDiagnosis(
            **common,
            errors=(
                output_error,
                *(OutputError(f.column, f.channel.unit, c.rms, *e) for f, c, *e in further),
            ),
            noise_floor_rms_m=self.floor,
            base_errors=base,
            extended_errors=extended,
            gain=self.compared.gain,
            blind_to=self.blind_spots(),
            next_experiment=next_experiment(
                self.causes, self.verdict, groups, records, doubted=self.doubt is not None
            ),
            remarks=(*self.model.provenance.notes, *self.remarks, *coverage_notes(experiments)),
            experiments=tuple(experiments),
            base=both[0],
            extended=both[1],
            noise=self.floors,
            misfit=misfits,
            remainder=self.misfits(self.errors) if self.kept else misfits,
            contenders=contenders(self.first, self.limits) if ambiguous else (),
            alternatives=self.alternatives(),
        )


def patched_model(d: Diagnosis) -> Model:
    """Return the extended model with the unnamed correction fitted with it, all values free.

    Raises InputError where a diagnosis has none, or one that no component represents;
    SimulationError where it cannot be simulated.
    """
    if d.correction is not None:
        return d.correction.model
    if not isinstance(d, StackDiagnosis) or d.patch is None:
        raise InputError("No unnamed correction removes more than the extended model does.")
    fit = with_patch(d.extended_fit, d.patch, d.extended)
    inputs = d.model.provenance.force_scale == "given"
    return diagnosed_model(fit, fit.predicted(), inputs)
