"""The state of a search, and the steps to its answer.

Every hypothesis by its causes, and which of them is the best; then the causes of the best one by
one, and the rivals of each.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.notes import Note, note
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import excess_power, noise_rms
from psa_casadi.diagnosis.noise import Omnibus
from psa_casadi.diagnosis.pack import STACK, Task, is_dynamic
from psa_casadi.diagnosis.result import Contender
from psa_casadi.diagnosis.screening import Screening, credible_set, levelled, probabilities
from psa_casadi.diagnosis.search import fits
from psa_casadi.diagnosis.search.hypothesis import (
    Hypothesis,
    View,
    examine,
    held_out_confirms,
    hypothesis,
    noisy,
    root_of,
    scale_of,
)
from psa_casadi.diagnosis.task import State, Thresholds, Tried, same_curves
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.prepare import as_read
from psa_casadi.identification.refitting import relevelled
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import chosen_start
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import whole
from psa_casadi.simulation.side_by_side import side_by_side

#: Share of the best one's evidence from which neighbours are nearly as likely, and distance from it
#: [nats] within which they are so too.
SHARE, NEAR = 0.8, 30.0
#: Number of fits of neighbours that go to their end.
FINALISTS = 3
#: Largest difference of evidence [nats] at which fits of one set are the same minimum.
_SAME = 1.0
#: Effects far behind in the screening are fitted from default values where less than this share of
#: the excess power is explained.
_EXPLAINED = 0.8

Names = frozenset[str]
NONE: Names = frozenset()


class SearchState:
    """The hypotheses of a search, from a base fit on. Raises SimulationError where that one fails.

    `hypotheses` holds them by their causes, `views` those whose residual was tested, `fitted` the
    effects fitted with each, `trials` what effects would add to the base. A search that has ended
    has an `answer`, and the causes of all `admissible` hypotheses; `remarks` say which steps it has
    left out.
    """

    answer: Hypothesis
    admissible: frozenset[Names]
    remarks: tuple[Note, ...] = ()

    def __init__(self, base: Fit, task: Task) -> None:
        self.base, self.task = base, task
        root = root_of(base, task)
        first = examine(root, task)
        self.trials = first.trials
        self.scale = scale_of(root, first.screening.colour, task.limits)
        if "held out" in task.method.without:
            self.scale = replace(self.scale, held=())
        self.hypotheses: dict[Names, Hypothesis] = {root.names: root}
        self.views: dict[Names, View] = {root.names: first}
        self.fitted: dict[Names, tuple[str, ...]] = {}
        self.memories: dict[tuple[Hypothesis, Hypothesis], bool] = {}
        self.noises: dict[tuple[Hypothesis, Hypothesis], bool] = {}
        self.entered: dict[Hypothesis, Hypothesis] = {}
        self.notify(root, "finished")

    @property
    def root(self) -> Hypothesis:
        """The base without causes, as it is fitted by now."""
        return self.hypotheses[NONE]

    def conclude(self) -> None:
        """End the search: choose the answer, examine it, and list what else is admissible."""
        self.view(self.best())
        self.answer = self.in_order(self.best())
        self.view(self.answer)
        self.notify(self.answer, "best")
        self.admissible = frozenset(n for n, h in self.hypotheses.items() if self.is_admissible(h))

    def in_order(self, h: Hypothesis) -> Hypothesis:
        """Return a hypothesis with its causes in the order in which they explain most.

        Those that bend the same curve as another effect, which are never named alone, come last.
        """
        shared = {n for group in self.task.indistinguishable(self.root.fit) for n in group}
        left: list[Component] = list(h.causes)
        causes: list[Component] = []
        while left:
            names = frozenset(c.name for c in causes)
            known = [self.hypotheses.get(names | {c.name}) for c in left]
            gains = [-np.inf if k is None else self.scale.evidence(k) for k in known]
            ranks = [(c.name not in shared, g) for c, g in zip(left, gains, strict=True)]
            causes.append(left.pop(ranks.index(max(ranks))))
        self.hypotheses[h.names] = ordered = replace(h, causes=tuple(causes))
        return ordered

    def note(self, h: Hypothesis | None) -> None:
        """Keep a hypothesis if it is the best of its causes, and held-out samples do not object.

        Another minimum may explain the fitted samples as well and fail between them.
        """
        if h is None:
            return
        old, evidence = self.hypotheses.get(h.names), self.scale.evidence
        gained = np.inf if old is None else evidence(h) - evidence(old)
        ahead = 0.0 if old is None else self.scale.held_out(h, old)
        if gained > _SAME and gained + ahead > 0.0:
            causes = h.causes if old is None else old.causes
            kept = replace(h, causes=causes)
            self.hypotheses[h.names] = kept if causes else noisy(kept, self.task)
            self.notify(kept, "finished" if kept.final else "fitted")

    def notify(self, h: Hypothesis, state: State) -> None:
        """Report a hypothesis to the observer of the search."""
        self.task.watch(
            Tried(
                state,
                tuple(c.name for c in h.causes),
                evidence=float(self.scale.evidence(h)),
                score=float(self.scale.score(h)),
                rms_m=float(h.fit.rms),
                holdout_rms_m=float(h.held[0]),
                base_rms_m=float(self.root.held[0]),
                noise_rms_m=float(self.scale.colour.rms),
            )
        )

    def view(self, h: Hypothesis) -> View:
        """Examine what a hypothesis leaves; the best one gives the noise of all others."""
        old = self.views.get(h.names)
        if old is None or old.of.fit is not h.fit:
            known = self.trials if h.causes else ()
            self.views[h.names] = old = examine(h, self.task, known)
        if h is self.best():
            self.scale = replace(self.scale, colour=old.screening.colour)
        return old

    def children(self, h: Hypothesis) -> list[Hypothesis]:
        """Return the hypotheses with one more cause that were fitted to one, best first."""
        children = [
            replace(c, causes=(*h.causes, *(a for a in c.causes if a.name not in h.names)))
            for c in self.fitted_with(h).values()
        ]
        return sorted(children, key=lambda c: -self.scale.evidence(c))

    def fitted_with(self, h: Hypothesis) -> dict[str, Hypothesis]:
        """Return the hypotheses with one more effect, by its name."""
        every = {n: self.hypotheses.get(h.names | {n}) for n in self.fitted.get(h.names, ())}
        return {n: child for n, child in every.items() if child is not None}

    def leaders(self, h: Hypothesis) -> list[Hypothesis]:
        """Return those of the children that are nearly as likely as the best one, best first."""
        evidence, children = self.scale.evidence(h), self.children(h)
        gains = [self.scale.evidence(c) - evidence for c in children]
        least = nearly(gains[0]) if gains else 0.0
        return [c for c, gained in zip(children, gains, strict=True) if gained > least]

    def near(self, h: Hypothesis, best: Hypothesis) -> float:
        """Return the cost, as `h` is weighted, above which a fit does not come near another one.

        Its evidence with `h` would be below `SHARE` of that one's, and by `NEAR` nats.
        """
        count, reached = len(h.fit.residuals), fits.cost_beside(best, h)
        gained = 0.5 * count * float(np.log(h.fit.cost / reached))
        return h.fit.cost * float(np.exp(-2.0 * nearly(gained) / count))

    def remember(self, h: Hypothesis, *names: str) -> None:
        """Record that these effects were fitted with a hypothesis."""
        self.fitted[h.names] = tuple(dict.fromkeys([*self.fitted.get(h.names, ()), *names]))

    def ranked(self) -> list[Hypothesis]:
        """Return all hypotheses, that of the highest score first."""
        return sorted(self.hypotheses.values(), key=lambda h: -self.scale.score(h))

    def best(self) -> Hypothesis:
        """Return the answer so far: of the highest score and admissible, fitted to its end."""
        while True:
            top = next(h for h in self.ranked() if self.is_admissible(h))
            if top.final:
                return top
            self.finish([top])

    def rejected(self) -> list[Hypothesis]:
        """Return what would be better than the answer if held-out samples confirmed it."""
        best, fitted = self.best(), self.scale.of_fitted
        better = [h for h in self.ranked() if fitted(h) > fitted(best)]
        return [h for h in better if self.is_admissible(h, confirmed=False)]

    def finish(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Fit hypotheses to their end."""
        if hypotheses:
            names = ", ".join("+".join(sorted(h.names)) for h in hypotheses)
            self.task.progress(f"{names} to the end")
        for ended in side_by_side(self._to_end, hypotheses):
            old = self.hypotheses[ended.names]
            better = self.scale.evidence(ended) >= self.scale.evidence(old)
            self.hypotheses[ended.names] = kept = ended if better else replace(old, final=True)
            self.notify(kept, "finished")
        if "begun again" in self.task.method.without:
            return
        final = [self.hypotheses[h.names] for h in hypotheses]
        for again in side_by_side(fits.refit_at_bound, final):
            self.note(again)

    def _to_end(self, h: Hypothesis) -> Hypothesis:
        """Fit a hypothesis to its end, with the noise that it leaves."""
        ended = fits.to_end(h)
        if self.task.pack.is_stack:
            return ended
        levelled = relevelled(ended.fit, every=True)
        if levelled is ended.fit:
            return ended
        return hypothesis(ended.causes, levelled, final=True) or ended

    def is_admissible(self, h: Hypothesis, *, confirmed: bool = True, form: bool = True) -> bool:
        """Whether every cause may be part of the answer.

        Each has its parameters inside their ranges and removes more than the detection limit, more
        than the `form` of the others may miss. A memory adds more than a static curve, each more
        than noise of another colour, and held-out samples have `confirmed` it.
        """
        return all(self._may_hold(h, c, confirmed=confirmed, form=form) for c in h.causes)

    def _may_hold(self, h: Hypothesis, cause: Component, *, confirmed: bool, form: bool) -> bool:
        out, pack = self.task.method.without, self.task.pack
        if not pack.is_admissible(h.fit, cause):
            return False
        before = self.hypotheses.get(h.names - {cause.name})
        least = self.views[NONE].test.detection_limit
        return before is None or (
            pack.exceeds_detection_limit(h.fit, before.fit, h.removes(before), least)
            and not (form and "form" not in out and self.is_small(h, before))
            and self.remembers(h, before, cause)
            and ("noise" in out or self.beyond_noise(h, before, cause))
            and (not confirmed or "held out" in out or held_out_confirms(h, before, self.scale))
        )

    def beyond_noise(self, h: Hypothesis, before: Hypothesis, cause: Component) -> bool:
        """Whether a cause adds more than noise of another colour would, with the base as it is.

        Or as the cause has led it: least squares bend a base to slow noise, and the cause takes
        that back.
        """
        if (h, before) not in self.noises:
            result = self.exceeds(h, before)
            if result and before.colours[0].autoregression.size:
                led = fits.as_led(h, cause)
                result = led is None or self.exceeds(h, led)
            self.noises[h, before] = result
        return self.noises[h, before]

    def exceeds(self, h: Hypothesis, before: Hypothesis) -> bool:
        """Whether a hypothesis exceeds another one of which what it leaves may be noise.

        Where noise enters that one's model, it may enter this one's.
        """
        least, held = self.task.limits.price, self.scale.held
        if h.beyond_noise(before, held, least) > least:
            return True
        entered = any(c.entering for c in before.colours)
        return entered and self.noisy(h).beyond_noise(before, held, least) > least

    def noisy(self, h: Hypothesis) -> Hypothesis:
        """Return a hypothesis with noise that enters its model, if that is likelier."""
        if h not in self.entered:
            self.entered[h] = noisy(h, self.task)
        return self.entered[h]

    def is_small(self, h: Hypothesis, before: Hypothesis) -> bool:
        """Whether a further cause removes no more than the form of the others may miss.

        What it removes of all that these remove is small then, and it leaves much of what they do.
        """
        limits = self.task.limits
        few = h.share(before, self.root) <= limits.further
        return bool(before.causes) and few and h.leaves(before) > 1.0 - limits.enough

    def small_causes(self, h: Hypothesis) -> tuple[str, ...]:
        """Name the causes that remove no more than the form of the others may miss."""
        less = {c.name: self.hypotheses.get(h.names - {c.name}) for c in h.causes}
        return tuple(n for n, b in less.items() if b is not None and self.is_small(h, b))

    def remembers(self, h: Hypothesis, before: Hypothesis, cause: Component) -> bool:
        """Whether a cause with a memory that stays adds more than a static curve."""
        stays = any(s.memory and not s.settles for s in cause.states)
        if not (stays and self.task.pack.is_stack):
            return True
        if (h, before) not in self.memories:
            added = [new - old for new, old in zip(h.predicted, before.predicted, strict=True)]
            dynamic = is_dynamic(added, before.fit, self.task.limits)
            self.memories[h, before] = dynamic
        return self.memories[h, before]

    def different(self, effect: Component, h: Hypothesis) -> bool:
        """Whether an effect is none of the causes, nor bends the same curve as one of them."""
        if effect.name in {c.more_of for c in h.causes}:
            return False
        groups = self.task.indistinguishable(self.root.fit)
        return not any(effect.name in g and h.names & set(g) for g in groups)

    def is_open(self, h: Hypothesis) -> bool:
        """Whether structure remains and the causes explain less than most of the excess."""
        colour = self.view(h).screening.colour
        floor = noise_rms(h.fit.residuals, colour)
        excess = excess_power(self.base.residuals, floor)
        explained = self.base.rms**2 - h.fit.rms**2
        return self.view(h).test.alarm and explained < _EXPLAINED * excess


def nearly(gained: float) -> float:
    """Return the evidence from which on a fit is nearly as likely as one that has `gained` more."""
    return min(SHARE * gained, gained - NEAR)


@dataclass(frozen=True, eq=False)
class Step:
    """A hypothesis on the way to the best one, and the cause that comes next.

    `fitted` are the hypotheses with one more effect; `alone` is ln B of every effect over this
    hypothesis, of all samples that choose (`Scale.gain`), `evidence` that over all other causes
    where there are later ones, and of effects that bend the same curve the best one's;
    `probability` that of being the cause, on condition that one effect of the table is. `chosen` is
    the hypothesis with the next cause, None of the last step; `without` the one with all causes but
    this, `view_without` what that one leaves, and `instead` the hypotheses with other effects in
    this cause's place. `remarks` of the last step state what the search has left.
    """

    view: View
    fitted: Mapping[str, Hypothesis] = field(default_factory=dict)
    chosen: Hypothesis | None = None
    without: Hypothesis | None = None
    view_without: View | None = None
    instead: Mapping[str, Hypothesis] = field(default_factory=dict)
    alone: Mapping[str, float] = field(default_factory=dict)
    evidence: Mapping[str, float] = field(default_factory=dict)
    probability: Mapping[str, float] = field(default_factory=dict)
    remarks: tuple[Note, ...] = ()

    @property
    def fit(self) -> Fit:
        """The fit of the hypothesis."""
        return self.view.of.fit

    @property
    def predicted(self) -> tuple[FloatArray, ...]:
        """Its predictions of whole records [m]."""
        return self.view.of.predicted

    @property
    def screening(self) -> Screening:
        """The screening of further effects."""
        return self.view.screening

    @property
    def test(self) -> Omnibus:
        """The omnibus test of its residual."""
        return self.view.test

    @property
    def cause(self) -> Component:
        """The next cause. Raises ValueError of the last step."""
        if self.chosen is None:
            raise ValueError("the last step has no cause")
        return self.chosen.causes[-1]


def steps_of(known: SearchState) -> list[Step]:
    """Return the steps to the best hypothesis; the last one is that itself."""
    ways = [*(_way(known, k) for k in range(len(known.answer.causes))), known.answer]
    views = [_view(known, h) for h in ways]
    steps = [_step(known, *pair) for pair in zip(views, [*ways[1:], None], strict=True)]
    return [*steps[:-1], replace(steps[-1], remarks=known.remarks)]


def unsearched(base: Fit, task: Task) -> list[Step]:
    """Return the one step of a base fit that is not searched."""
    view = examine(root_of(base, task), task)
    return [Step(view, alone=view.estimated(), evidence=view.estimated())]


def _way(known: SearchState, count: int) -> Hypothesis:
    """Return the hypothesis with the first `count` of the best one's causes."""
    best = known.answer
    fitted = known.hypotheses.get(best.names_upto(count))
    if fitted is not None:
        return replace(fitted, causes=best.causes[:count])
    for cause in best.causes[: count - 1 : -1]:
        less = fits.without(best, cause)
        best = best if less is None else less
    return best


def _view(known: SearchState, h: Hypothesis) -> View:
    """Look at a hypothesis; what effects would add is known from where the search began."""
    view = known.views.get(h.names)
    if view is None or view.of.fit is not h.fit:
        known.views[h.names] = view = examine(h, known.task, known.trials)
    return view if view.of is h else replace(view, of=h)


def _step(known: SearchState, view: View, chosen: Hypothesis | None) -> Step:
    scale, among, refused = known.scale, known.fitted_with(view.of), set[str]()
    if chosen is not None:
        among[chosen.causes[-1].name] = chosen
    alone = {**view.estimated(), **{n: scale.gain(h, view.of) for n, h in among.items()}}
    step, evidence, whole = Step(view, among, chosen, alone=alone), alone, scale.evidence(view.of)
    if chosen is None:
        refused = {n for n, h in among.items() if h.names not in known.admissible}
        return _judged(step, evidence, among, refused, whole, known.task)
    cause, answer = chosen.causes[-1], known.answer
    less = known.hypotheses.get(answer.names - {cause.name}) or fits.without(answer, cause)
    if less is not None:  # else it cannot be fitted; the effects are without the later causes
        there, among = _view(known, less), {**known.fitted_with(less), cause.name: answer}
        evidence = {**there.estimated(), **{n: scale.gain(h, less) for n, h in among.items()}}
        refused = {n for n, h in among.items() if h.names not in known.admissible} - {cause.name}
        step = replace(step, without=less, view_without=there, instead=among)
        whole = scale.evidence(answer)
    return _judged(step, evidence, among, refused, whole, known.task)


def _judged(
    step: Step,
    evidence: Mapping[str, float],
    fitted: Mapping[str, Hypothesis],
    refused: set[str],
    whole: float,
    task: Task,
) -> Step:
    """Return a step with evidence and probability; `refused` effects may not be the answer.

    `whole` is the evidence over the plain base of the model with the cause.

    Effects that bend the same curve are refused together, and share what the best of them has.
    """
    similar, good, pack = task.indistinguishable(step.fit), set(fitted) - refused, task.pack
    for group in similar:
        if good & set(group):
            every = [(n, h, c) for n, h in fitted.items() for c in h.causes if n == c.name]
            like = {n for n, h, c in every if pack.is_admissible(h.fit, c)}
            refused = refused - (set(group) & like)
        elif refused & set(group):
            refused = refused | set(group)
    shared = levelled(evidence, similar, good)
    chances = probabilities(
        {n: v for n, v in shared.items() if n not in refused}, whole, task.limits
    )
    return replace(step, evidence=shared, probability=chances)


def contenders(step: Step, limits: Thresholds, names: Sequence[str] = ()) -> tuple[Contender, ...]:
    """Return effects of one step of the search with their fits; those not fitted are fitted now.

    Without `names` they are the fewest that hold the cause with the probability `credible`. An
    effect whose fit fails is left out.
    """
    names = names or credible_set(step.probability, limits.credible)
    result = dict(step.fitted)
    scale = scale_of(step.view.of, step.screening.colour, replace(limits, price=0.0))
    known = dict(step.evidence)
    for name in names:
        scores = [] if name in result else step.view.starts_of(name)
        fitted = fits.with_cause(step.view.of, scores) if scores else None
        if fitted is not None:
            result[name] = fits.to_end(fitted)
            known[name] = scale.gain(result[name], step.view.of)
    return tuple(Contender(n, result[n].fit, known[n]) for n in names if n in result)


def one_of_each(result: Sequence[Contender]) -> tuple[tuple[Contender, ...], tuple[Note, ...]]:
    """Return the contenders that a voltage may separate, and notes on those that none separates.

    Of effects that bend the same curve the best fit represents all.
    """
    best = sorted(result, key=lambda c: c.fit.cost)
    effects = [next(e for e in c.fit.model.components if e.name == c.effect) for c in best]
    groups = same_curves(effects, best[0].fit) if best else ()
    rest = {name for group in groups for name in group[1:]}
    same = tuple(note("same_curve", effects=group) for group in groups)
    return tuple(c for c in result if c.effect not in rest), same


def fit_contenders(
    records: Sequence[Record],
    effects: Sequence[Component],
    *,
    model: Model | None = None,
    progress: Progress = silent,
) -> tuple[Fit, tuple[Contender, ...]]:
    """Fit the base and each of the named effects to records in full, without a verdict.

    Raises InputError where an effect cannot be fitted to them.
    """
    experiments = tuple(whole(as_read(r)) for r in records)
    start = chosen_start(records, model, None)[0].without(e.name for e in effects)
    base = fit_base(start, experiments, progress=progress)
    task = Task(tuple(effects), STACK, progress=progress)
    return base, fitted_rivals(base, task)


def fitted_rivals(base: Fit, task: Task) -> tuple[Contender, ...]:
    """Fit each effect of a task with the base, without a verdict.

    Raises InputError where an effect cannot be fitted.
    """
    plain = hypothesis((), base, final=True)
    if plain is None:
        raise InputError(["The fitted base cannot be simulated over the whole of these records."])
    view = examine(plain, task)
    task.progress("fitting the rivals")
    step = Step(view, evidence=view.estimated())
    names = [e.name for e in task.table]
    chosen = contenders(step, task.limits, names)
    lost = {*names} - {c.effect for c in chosen}
    if lost:
        raise InputError(
            f"{', '.join(sorted(lost))} could not be fitted to these records, so there is nothing"
            " to separate; leave the records out to design from ordinary sizes."
        )
    return chosen
