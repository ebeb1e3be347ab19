"""The causes of the best hypothesis one by one, and the rivals of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from psa_casadi.common.errors import InputError
from psa_casadi.common.notes import Note, note
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.omnibus import Omnibus
from psa_casadi.diagnosis.pack import STACK, Task
from psa_casadi.diagnosis.result import Contender
from psa_casadi.diagnosis.screening import (
    Screening,
    credible_set,
    levelled,
    probabilities,
)
from psa_casadi.diagnosis.search.fits import to_end, with_cause, without
from psa_casadi.diagnosis.search.hypothesis import (
    Hypothesis,
    View,
    examine,
    hypothesis,
    root_of,
    scale_of,
)
from psa_casadi.diagnosis.search.state import SearchState
from psa_casadi.diagnosis.task import Thresholds, same_curves
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.prepare import as_read
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.start.ordinary import chosen_start
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, whole


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
        less = without(best, cause)
        best = best if less is None else less
    return best


def _view(known: SearchState, h: Hypothesis) -> View:
    """Look at a hypothesis; what effects would add is known from where the search began."""
    view = known.views.get(h.names)
    if view is None or view.of.fit is not h.fit:
        known.views[h.names] = view = examine(h, known.task, known.trials)
    return view if view.of is h else replace(view, of=h)


def _step(known: SearchState, view: View, chosen: Hypothesis | None) -> Step:
    fitted, gain, task = _fitted(known, view.of), known.scale.gain, known.task
    if chosen is not None:
        fitted[chosen.causes[-1].name] = chosen
    evidence = known.scale.evidence(view.of)
    alone = {**view.estimated(), **{n: gain(c, view.of) for n, c in fitted.items()}}
    if chosen is None:
        refused = {n for n, c in fitted.items() if c.names not in known.admissible}
        return _judged(Step(view, fitted, alone=alone), alone, fitted, refused, evidence, task)
    cause = chosen.causes[-1]
    less = known.hypotheses.get(known.answer.names - {cause.name}) or without(known.answer, cause)
    if less is None:  # it cannot be fitted; the effects as they are without the later causes
        return _judged(
            Step(view, fitted, chosen, alone=alone), alone, fitted, set(), evidence, task
        )
    there = _view(known, less)
    instead = {**_fitted(known, less), cause.name: known.answer}
    beside = {**there.estimated(), **{n: gain(c, less) for n, c in instead.items()}}
    refused = {n for n, c in instead.items() if c.names not in known.admissible} - {cause.name}
    step = Step(view, fitted, chosen, less, there, instead, alone)
    return _judged(step, beside, instead, refused, known.scale.evidence(known.answer), task)


def _fitted(known: SearchState, h: Hypothesis) -> dict[str, Hypothesis]:
    """Return the hypotheses with one more effect, by its name."""
    every = {n: known.hypotheses.get(h.names | {n}) for n in known.fitted.get(h.names, ())}
    return {n: child for n, child in every.items() if child is not None}


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
            like = {n for n, h, c in every if pack.is_admissible(h.fit, c, task.experiments)}
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
        fitted = with_cause(step.view.of, scores) if scores else None
        if fitted is not None:
            result[name] = to_end(fitted)
            known[name] = scale.gain(result[name], step.view.of)
    return tuple(Contender(n, result[n].fit, known[n]) for n in names if n in result)


def one_of_each(
    result: Sequence[Contender], experiments: Sequence[Experiment]
) -> tuple[tuple[Contender, ...], tuple[Note, ...]]:
    """Return the contenders that a voltage may separate, and notes on those that none separates.

    Of effects that bend the same curve the best fit represents all.
    """
    best = sorted(result, key=lambda c: c.fit.cost)
    effects = [next(e for e in c.fit.model.components if e.name == c.effect) for c in best]
    groups = same_curves(experiments, effects, best[0].fit) if best else ()
    rest = {name for group in groups for name in group[1:]}
    same = tuple(note("same_curve", effects=group) for group in groups)
    return tuple(c for c in result if c.effect not in rest), same


def fit_contenders(
    records: Sequence[Record],
    effects: Sequence[Component],
    *,
    model: Model | None = None,
    progress: Progress = silent,
) -> tuple[Fit, tuple[Contender, ...], tuple[Experiment, ...]]:
    """Fit the base and each of the named effects to records in full, without a verdict.

    Raises InputError where an effect cannot be fitted to them.
    """
    experiments = tuple(whole(as_read(r)) for r in records)
    start = chosen_start(records, model, None)[0].without(e.name for e in effects)
    base = fit_base(start, experiments, progress=progress)
    task = Task(experiments, tuple(effects), STACK, progress=progress)
    return base, fitted_rivals(base, task), experiments


def fitted_rivals(base: Fit, task: Task) -> tuple[Contender, ...]:
    """Fit each effect of a task with the base, without a verdict.

    Raises InputError where an effect cannot be fitted.
    """
    plain = hypothesis((), base, task.experiments, final=True)
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
            " to tell apart; leave the records out to design from ordinary sizes."
        )
    return chosen
