"""From the result of a search to a diagnosis of any model: are the names kept, and what is left?"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import noise_left, noise_told
from psa_casadi.diagnosis.corrections import (
    SUREST,
    CauseEvidence,
    Correction,
    Family,
    FreeFunction,
    best_of,
    estimates,
    families,
    place_and_kind,
)
from psa_casadi.diagnosis.free_functions import fit_free_functions, formula_of, model_of
from psa_casadi.diagnosis.generic import Attached
from psa_casadi.diagnosis.held_out import Budget, Removed, Share, held_out_within, too_few_held_out
from psa_casadi.diagnosis.pack import Task
from psa_casadi.diagnosis.remedy import Size, changes
from psa_casadi.diagnosis.result import (
    NOISE,
    Candidate,
    Cause,
    Diagnosis,
    OutputError,
    Remaining,
    Verdict,
)
from psa_casadi.diagnosis.screening import credible_set, temperature
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale
from psa_casadi.diagnosis.search.state import SearchState, Step, steps_of
from psa_casadi.diagnosis.task import Thresholds
from psa_casadi.identification.result import EXCESSIVE
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment, missed_rms
from psa_casadi.simulation.timings import stage

#: Verdicts that name causes.
NAMING: tuple[Verdict, ...] = ("cause_named", "partly_explained", "ambiguous")
#: Smallest ratio of the change of an output by one cause to that by all together at which causes
#: cancel each other: three wrong names for a heat capacity that changes reach 20, causes of other
#: places about 1.
_CANCEL = 5.0


@dataclass(frozen=True)
class Weighed:
    """Causes against the unnamed `corrections` of the model without them.

    `evidence` of the causes together over that model; `share` that they remove of its held-out
    excess, outputs over their noise, and `each` of every output by itself that it clearly misses.
    """

    evidence: float
    share: float
    each: Mapping[str, float]
    corrections: Sequence[Correction]

    @property
    def least(self) -> tuple[str, float]:
        """The output of which the least is removed, "" for all together, and that share."""
        return min({"": self.share, **self.each}.items(), key=lambda item: item[1])


def indistinguishable(step: Step, limits: Thresholds) -> tuple[str, ...]:
    """Effects that may as well be a step's cause: with the chosen one, the credible set."""
    if step.chosen is None:
        return ()
    within = credible_set(step.probability, limits.credible)
    return tuple(name for name in within if name != step.cause.name)


class Judge:
    """What follows from the steps of a search, each computed when it is used.

    Of records whose output is not `driven` by the input nothing is named. The methods of the first
    part depend on the kind of device; a stack overrides them.
    """

    def __init__(self, steps: Sequence[Step], task: Task, *, driven: bool = True) -> None:
        self.steps, self.task, self.driven = tuple(steps), task, driven
        self.first, self.last, self.searched = self.steps[0], self.steps[-1], self.steps[:-1]
        self.experiments, self.limits = self.first.fit.experiments, task.limits
        self._left: dict[Step, Remaining] = {}

    # What depends on the kind of device

    @property
    def noise(self) -> tuple[float, ...]:
        """The rms of the noise of every channel that judges, the first ones."""
        raise NotImplementedError

    @property
    def doubt(self) -> Note | None:
        """Why held-out samples cannot confirm a cause."""
        raise NotImplementedError

    @property
    def model(self) -> Model:
        """The extended model with its evidence."""
        raise NotImplementedError

    def corrections(self, of: Hypothesis) -> Sequence[Correction]:
        """Return the unnamed corrections of a hypothesis."""
        raise NotImplementedError

    def held_out_finding(self, step: Step) -> tuple[Note, float] | None:
        """Return what only held-out samples show that a model lacks, and its p value."""
        raise NotImplementedError

    def named(self, step: Step) -> Cause:
        """Return a cause with where it sits and what it changes, with what all causes have."""
        raise NotImplementedError

    def family(self, effect: Component) -> tuple[str, str]:
        """Return the place and the kind of an effect."""
        return effect.belongs_to, effect.kind

    # What every kind of device has

    @cached_property
    def scale(self) -> Scale:
        """The evidence of hypotheses over the base, by the noise that the best one leaves."""
        return Scale(self.first.view.of, self.last.screening.colour, self.limits)

    def left(self, step: Step) -> Remaining:
        """Return what the model of a step leaves, in fitted samples or in held-out ones."""
        if step not in self._left:
            test, beyond = step.test, self.held_out_finding(step)
            finding, p = (NOISE, 1.0) if beyond is None else beyond
            finding = test.finding if test.alarm else finding
            self._left[step] = Remaining(finding is NOISE, min(test.p_value, p), finding)
        return self._left[step]

    def _shown(self, evidence: float) -> CauseEvidence:
        """Return the `CauseEvidence` of a cause from its evidence conditional on the others."""
        return CauseEvidence(evidence, len(self.first.fit.residuals), len(self.last.view.of.causes))

    @property
    def missing(self) -> bool:
        """Whether the base lacks something."""
        return self.first.chosen is not None or not self.left(self.first).white

    def weigh(
        self, before: Hypothesis, after: Hypothesis, *, with_corrections: bool = True
    ) -> Weighed:
        """Weigh the causes that one hypothesis has more than another against corrections of that.

        Without any corrections if `with_corrections` is False. A channel counts by itself where
        there are several, and the other's held-out rms is above `EXCESSIVE` times the noise:

            share_j = (P_before,j - P_after,j) / (P_before,j - s_j^2)
        """
        result = self.corrections(before) if with_corrections else ()
        removed = Removed(self.experiments, before.predictions, self.noise)
        rows = list(zip(before.fit.channels, before.errors, after.errors, self.noise, strict=False))
        each = {
            f.column: (base**2 - left**2) / (base**2 - floor**2)
            for f, base, left, floor in rows
            if len(rows) > 1 and base > EXCESSIVE * floor
        }
        return Weighed(
            evidence=self.scale.evidence(after) - self.scale.evidence(before),
            share=removed.from_base(after.predictions),
            each=each,
            corrections=result,
        )

    @cached_property
    def weighed(self) -> Weighed:
        """All causes together, against corrections of the base."""
        both = self.first.view.of, self.last.view.of
        return self.weigh(*both, with_corrections=self.missing and self.driven)

    @property
    def adds(self) -> bool:
        """Whether the causes remove more than their form may be wrong by, named or not."""
        return self.weighed.share > self.limits.form

    @cached_property
    def each(self) -> dict[str, Weighed]:
        """Every cause by itself, against corrections of the model without it, all others kept."""
        pairs = [(s.cause.name, s.without) for s in self.searched if s.without is not None]
        return {n: self._alone(less) for n, less in pairs if self.doubt is None}

    def _alone(self, less: Hypothesis) -> Weighed:
        """Weigh one cause against what corrections add in its place alone.

        What they add with all causes as well is no word against one of these.
        """
        if less.fit is self.first.fit:
            return self.weighed
        weighed = self.weigh(less, self.last.view.of)
        more = {c.name: max(c.evidence, 0.0) for c in self._last_corrections}
        pairs = [(c, c.evidence - more.get(c.name, 0.0)) for c in weighed.corrections]
        return replace(weighed, corrections=[replace(c, evidence=e) for c, e in pairs])

    @cached_property
    def _last_corrections(self) -> Sequence[Correction]:
        """The unnamed corrections with all causes, where structure remains."""
        return self.corrections(self.last.view.of) if self.last.test.alarm else ()

    @cached_property
    def unlisted(self) -> dict[str, Correction]:
        """Causes that are rather none of the listed effects, with the best unnamed correction."""
        better: dict[str, Correction] = {}
        alone = max(self.weighed.corrections, key=lambda c: c.evidence, default=None)
        if alone is not None and len(self.each) > 1 and alone.evidence > self.weighed.evidence:
            return dict.fromkeys(self.each, alone)  # one explains more than they do together
        for name, weighed in self.each.items():
            of = self.families[name]
            if sum(f.not_listed for f in of) > sum(sum(f.effects.values()) for f in of):
                others = {(f.place, f.kind) for f in of if f.not_listed > 0.0}
                likely = [c for c in weighed.corrections if place_and_kind(c) in others]
                better[name] = max(likely, key=lambda c: c.evidence)
        return better

    @property
    def unnamed(self) -> set[str]:
        """Causes that are rather not listed effects, or without which the model is as likely."""
        price = self.limits.price
        return {*self.unlisted, *(n for n, w in self.each.items() if w.evidence <= price)}

    @cached_property
    def families(self) -> dict[str, tuple[Family, ...]]:
        """The places and kinds that every cause may be of, by its name."""
        return {
            s.cause.name: families(
                s.probability,
                {e.name: self.family(e) for e in (*self.task.table, s.cause)},
                self._shown(self.each[s.cause.name].evidence),
                self.each[s.cause.name].corrections,
                self.limits,
            )
            for s in self.searched
            if s.cause.name in self.each
        }

    @property
    def least(self) -> float:
        """The share of the held-out excess that causes must remove to be named.

        More where structure remains; else held-out samples need only show them, unless a further
        column may do so alone.
        """
        if self.last.test.alarm:
            return self.limits.enough
        return -np.inf if self.first.fit.further else self.limits.form

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict; the first of these that is so decides."""
        unnamed = self.unnamed
        named = [s for s in self.searched if s.cause.name not in unnamed]
        little = self.weighed.least[1] < self.least
        if not self.driven:
            return "not_driven"
        if not self.missing:
            return "adequate"
        if self.doubt is not None or not named or little:
            return "unexplained"
        if indistinguishable(named[0], self.limits):
            return "ambiguous"
        more = self.unlisted or not self.left(self.last).white
        return "partly_explained" if more else "cause_named"

    @cached_property
    def kept(self) -> tuple[Step, ...]:
        """The steps to the causes that the extended model holds, named or not."""
        weak = self.verdict == "unexplained" and self.doubt is None and not self.unlisted
        return self.searched if self.verdict in NAMING or (weak and self.adds) else ()

    @property
    def final(self) -> Step:
        """The step whose model is the extended one."""
        return self.last if self.kept else self.first

    @cached_property
    def final_corrections(self) -> Sequence[Correction]:
        """The unnamed corrections of the extended model."""
        if self.final is self.last and self.last.test.alarm:
            return self._last_corrections
        return self.corrections(self.final.view.of) if self.kept else self.weighed.corrections

    @cached_property
    def best_correction(self) -> Correction | None:
        """The unnamed correction that would remove most of what the extended model leaves."""
        of, colour = self.final.view.of, self.last.screening.colour
        return best_of(self.final_corrections, self.experiments, of.errors, colour, self.limits)

    @property
    def reported_correction(self) -> Correction | None:
        """The same in the form that is reported."""
        return self.best_correction

    @property
    def families_left(self) -> tuple[Family, ...]:
        """The places and kinds that what has no name may be of, where something is left."""
        if self.best_correction is None or self.left(self.final).white:
            return ()
        most = self.best_correction.evidence
        return families({}, {}, self._shown(most), self.final_corrections, self.limits)

    @cached_property
    def budget(self) -> Budget:
        """Where the base's held-out error goes."""
        unnamed = self.reported_correction
        return Removed(self.experiments, self.first.view.of.predictions, self.noise).budget(
            self.final.view.of.predictions,
            [(s.cause.name, s.without.predictions) for s in self.kept if s.without is not None],
            None if unnamed is None else (unnamed.name, unnamed.predicted),
        )

    @cached_property
    def small(self) -> tuple[Share, ...]:
        """Causes that are not named where structure remains: the form of the others is wrong.

        Each removes less of the base's excess than a form may miss, and less than `enough` of what
        the largest does: that one is always named.
        """
        if not self.last.test.alarm or len(self.steps) < 2 or self.verdict not in NAMING:
            return ()
        shares = [c for c in self.budget.causes if c.what not in self.unlisted]
        most = max((c.share for c in shares), default=0.0)
        least = min(self.limits.form, self.limits.enough * most if most > 0.0 else most)
        return tuple(c for c in shares if c.share < least)

    @cached_property
    def causes(self) -> tuple[Cause, ...]:
        """The causes that are named."""
        unnamed = {*self.unnamed, *(c.what for c in self.small)}
        steps = self.kept if self.verdict in NAMING else ()
        return tuple(self.named(s) for s in steps if s.cause.name not in unnamed)

    def cause(self, step: Step, sizes: Sequence[Size], port: str = "") -> Cause:
        """Return a cause: its probability, the share of the error that it removes."""
        name, shares = step.cause.name, {c.what: c for c in self.budget.causes}
        share, of = shares.get(name), self.families.get(name, ())
        sure = sum(f.effects.get(name, 0.0) for f in of) if of else step.probability[name]
        return Cause(
            effect=name,
            belongs_to=step.cause.belongs_to,
            confidence=float(min(SUREST, sure)),
            parameters=estimates(step.cause, self.model),
            cannot_be_told_from=indistinguishable(step, self.limits),
            explained_share=0.0 if share is None else share.clipped[0],
            remedy=step.cause.what_now.code,
            sizes=tuple(sizes),
            port=port,
            description=step.cause.description,
            families=of,
        )

    def withdrawn(self) -> tuple[Note, ...]:
        """Return which causes of the search are not named, and why."""
        names = tuple(s.cause.name for s in self.searched)
        if not names:
            return ()
        (output, share), kept = self.weighed.least, False
        if self.doubt is not None:
            why = self.doubt
        elif self.unlisted:
            why = self._better()
        elif share < self.least:
            more = self.last.test.alarm
            why, kept = note("little", least=self.least, more=more), self.adds
        else:
            why, kept = note("rare"), self.adds
        return (
            note("withdrawn", names=names, evidence=self.weighed.evidence, share=max(0.0, share),
                 output=output, kept=kept, why=why),
        )  # fmt: skip

    def _better(self) -> Note:
        return note("better_unnamed", each=tuple((c.label, n) for n, c in self.unlisted.items()))

    @property
    def remarks(self) -> tuple[Note | str, ...]:
        """Which names are withdrawn; which causes are too uncertain or too small to be named."""
        notes = self.withdrawn() if self.verdict == "unexplained" else ()
        if self.unlisted and self.verdict != "unexplained":
            # they stay in the model without a name
            notes = (note("vague", names=tuple(self.unlisted), why=self._better()),)
        small = (note("small", effect=c.what, share=max(c.share, 0.0)) for c in self.small)
        return (*notes, *small)

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Every effect tried, with its share of the training excess; estimated if not fitted.

        Where nothing is named no effect of the table has a probability.
        """
        first = self.first
        fit, colour, level = first.fit, first.screening.colour, first.fit.channels[0].level
        base = sum(
            len(f.residuals) * max(f.rms**2 - floor**2, 0.0) * (level / f.level) ** 2
            for f, floor in zip(fit.channels, self.noise, strict=False)
        )
        excess = max(base / len(fit.residuals), 1e-300)
        power = colour.level**2 / len(fit.residuals)
        gone = {n: s.decrease * power for n, s in first.screening.best_by_effect().items()}
        gone |= {n: h.removes(first.view.of) for n, h in first.fitted.items()}
        named = self.verdict in NAMING
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

    @property
    def common(self) -> dict[str, Any]:
        """What the diagnosis of every kind of device holds."""
        best = self.reported_correction
        share = 0.0 if self.budget.unnamed is None else self.budget.unnamed.share
        return {
            "verdict": self.verdict,
            "causes": self.causes,
            "candidates": self.candidates,
            "base_remaining": self.left(self.first),
            "remaining": self.left(self.final),
            "base_fit": self.first.fit,
            "extended_fit": self.final.fit,
            "model": self.model,
            "families": self.families_left,
            "doubted": self.doubt if self.verdict in ("adequate", "unexplained") else None,
            "budget": self.budget,
            "patch": None if best is None else replace(best, share=share),
        }


class ModelJudge(Judge):
    """The judge of any model: `base` as it was before the search, `table` effects at its ports.

    `whole` are the records, of which the search may have used parts.
    """

    def __init__(
        self,
        known: SearchState,
        base: Model,
        table: Mapping[str, Attached],
        whole: Sequence[Experiment],
    ) -> None:
        super().__init__(steps_of(known), known.task)
        self.known, self.base, self.table, self.whole = known, base, table, whole
        self.views = {s.view.of.names: s.view for s in self.steps}
        views = [s.view_without for s in self.steps if s.view_without is not None]
        self.views |= {v.of.names: v for v in views}

    @cached_property
    def noise(self) -> tuple[float, ...]:
        """The rms of the noise in what the best model leaves of every output."""
        return tuple(noise_left(self.last.fit, self.last.screening.colour))

    @cached_property
    def doubt(self) -> Note | None:
        """Whether too few samples are held out."""
        return too_few_held_out(self.experiments)

    @cached_property
    def model(self) -> Model:
        """The extended model, open at the ports that it needs alone."""
        effects = [self.table[s.cause.name] for s in self.kept]
        return model_of(self.base, self.final.fit, effects)

    def corrections(self, of: Hypothesis) -> Sequence[Correction]:
        """Fit free functions added to a hypothesis; none with causes that leave no structure."""
        view = self.views[of.names]
        if of.causes and not view.test.alarm:
            return ()
        return fit_free_functions(view, self.task, self.base, self._attached(of), self.scale)

    def _attached(self, of: Hypothesis) -> list[Attached]:
        return [self.table[c.name] for c in of.causes]

    @cached_property
    def reported_correction(self) -> Correction | None:
        """The unnamed correction as a formula, where few terms predict as well."""
        best, of = self.best_correction, self.final.view.of
        if not isinstance(best, FreeFunction):
            return best
        effects = self._attached(of)
        law = formula_of(best, of, self.task, self.base, effects, self.scale, self.whole)
        return best if law is None else replace(law, open_to=best.open_to)

    def held_out_finding(self, step: Step) -> tuple[Note, float] | None:
        """Return which output's held-out samples are unlike the fitted ones.

        Without causes these leave noise of any colour, and the innovations are compared.
        """
        rows = zip(step.fit.channels, self._noise(step)[1], step.view.of.colours, strict=True)
        for o, noise, colour in rows:
            if not step.view.of.causes and not any(e.held_out_whole for e in self.experiments):
                excess = held_out_within(colour, len(step.fit.theta), self.limits)
                if excess:
                    finding = note("held_out_unlike", output=o.column, ratio=excess.factor)
                    return finding, excess.p_value
                continue
            held = any(e.at(o.number, e.held_out).any() for e in self.experiments)
            rms = missed_rms(self.experiments, step.view.of.predictions, o.number)
            least = self.limits.unseen_ratio_of_records * float(np.hypot(noise, o.straight))
            if held and rms > least:
                finding = note("held_out_unlike", output=o.column, ratio=rms / noise)
                return finding, step.test.p_value
        return None

    def _noise(self, step: Step) -> tuple[tuple[Experiment, ...], tuple[float, ...]]:
        return noise_told(step.fit, step.screening.colour)

    @cached_property
    def extended(self) -> tuple[FloatArray, ...]:
        """What the extended model shows of every output along every record (n, ny)."""
        return tuple(self.final.fit.outputs())

    def _changes(self, effects: Sequence[Component]) -> tuple[Size, ...]:
        return changes(effects, self.final.fit, self.extended)

    def family(self, effect: Component) -> tuple[str, str]:
        """Return the port and the kind of an effect."""
        return self.table[effect.name].port.words, effect.kind

    def named(self, step: Step) -> Cause:
        """Return a cause with its port, and what it changes of every output."""
        sizes = self._changes([step.cause])
        return self.cause(step, sizes, self.table[step.cause.name].port.words)

    @property
    def remarks(self) -> tuple[Note | str, ...]:
        """The remarks of any model, which causes cancel each other, which are too small to name."""
        left_out = () if self.doubt else self._left_out()
        return (*super().remarks, *self._cancelling(), *left_out)

    def _cancelling(self) -> tuple[Note, ...]:
        """Return the output that one of several causes changes much more than all of them do."""
        if len(self.causes) < 2:
            return ()
        whole = self._changes([s.cause for s in self.kept])
        rows = [
            (size.value / max(both.value, 1e-300), cause.effect, size, both)
            for cause in self.causes
            for size, both in zip(cause.sizes, whole, strict=False)
        ]
        times, effect, size, both = max(rows, key=lambda r: r[0], default=(0.0, "", None, None))
        if times < _CANCEL or size is None or both is None:
            return ()
        alone, together = (size.value, size.unit), (both.value, both.unit)
        return (note("cancel", effect=effect, output=size.output, alone=alone, together=together),)

    def _left_out(self) -> tuple[Note, ...]:
        """Return which causes are clearly likelier than the best, but may only correct its form.

        Only where structure remains with the best.
        """
        known, best = self.known, self.last.view.of
        if not best.causes or not self.last.test.alarm:
            return ()
        clearly = self.limits.clearly * temperature(known.scale.evidence(best))
        least = known.scale.score(best) + clearly
        better = [h for h in known.hypotheses.values() if known.scale.score(h) > least]
        better = [h for h in better if known.small_causes(h) and known.is_admissible(h, form=False)]
        top = max(better, key=known.scale.score, default=None)
        if top is None:
            return ()
        names, small = (tuple(sorted(n)) for n in (top.names, known.small_causes(top)))
        more = known.scale.evidence(top) - known.scale.evidence(best)
        return (note("slight", names=names, more=more, small=small, least=self.limits.further),)

    @stage("judging")
    def conclude(self) -> Diagnosis:
        """Return the diagnosis."""
        first, final = self.first, self.final
        experiments, noise = self._noise(final)
        both = [s.view.of.predictions for s in (first, final)]
        errors = []
        for o, level in zip(final.fit.channels, noise, strict=True):
            rms = [missed_rms(self.experiments, p, o.number) for p in both]
            errors.append(OutputError(o.column, o.channel.unit, level, *rms))
        extended = self.extended
        base = tuple(first.fit.outputs()) if self.kept else extended
        return Diagnosis(
            errors=tuple(errors), remarks=self.remarks, experiments=experiments, base=base,
            extended=extended, **self.common,
        )  # fmt: skip
