"""The causes of the best hypothesis one by one: what each was chosen from, and how likely it is."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.noise.residual_tests import Omnibus
from psa_casadi.diagnosis.screening.evidence import levelled, probabilities, temperature
from psa_casadi.diagnosis.screening.screen import Screening
from psa_casadi.diagnosis.search.fits import with_cause, without
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, root_of
from psa_casadi.diagnosis.search.known import Searched
from psa_casadi.diagnosis.search.view import View, examine
from psa_casadi.diagnosis.search.worth import in_character
from psa_casadi.diagnosis.task import Task
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.fitting.fit import Fit

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Step:
    """A hypothesis on the way to the best one, and the cause that comes next.

    `fitted` are the hypotheses with one more effect; `alone` is ln B of every effect over this
    hypothesis, `evidence` over all other causes where there are later ones, and of effects that
    bend the same curve the best one's; `probability` that of being the cause, given that one effect
    of the table is. `chosen` is the hypothesis with the next cause, None of the last step;
    `without` the one with all causes but this.
    """

    view: View
    fitted: Mapping[str, Hypothesis] = field(default_factory=dict)
    chosen: Hypothesis | None = None
    without: Hypothesis | None = None
    alone: Mapping[str, float] = field(default_factory=dict)
    evidence: Mapping[str, float] = field(default_factory=dict)
    probability: Mapping[str, float] = field(default_factory=dict)

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


def steps_of(found: Searched, task: Task) -> list[Step]:
    """Return the steps to the best hypothesis; the last one is that itself."""
    ways = [_way(found, task, k) for k in range(len(found.best.causes))]
    ways.append(found.best)
    views = [_view(found, h, task) for h in ways]
    steps = []
    for k, view in enumerate(views):
        chosen = ways[k + 1] if k + 1 < len(ways) else None
        step = _step(found, task, view, chosen)
        if chosen is not None:
            step = replace(step, without=_without(found, task, step.cause))
        steps.append(step)
    return steps


def unsearched(base: Fit, task: Task) -> list[Step]:
    """Return the one step of a base fit that is not worth a search."""
    view = examine(root_of(base, task.experiments), task)
    return [Step(view, alone=view.estimated(), evidence=view.estimated())]


def _way(found: Searched, task: Task, count: int) -> Hypothesis:
    """Return the hypothesis with the first so many of the best one's causes."""
    best = found.best
    own = found.known.get(best.names_upto(count))
    if own is not None:
        return own
    for cause in best.causes[: count - 1 : -1]:
        less = without(best, cause, task.experiments)
        best = best if less is None else less
    return best


def _without(found: Searched, task: Task, cause: Component) -> Hypothesis | None:
    """Return the best hypothesis without one of its causes."""
    known = found.known.get(found.best.names - {cause.name})
    return known or without(found.best, cause, task.experiments)


def _view(found: Searched, h: Hypothesis, task: Task) -> View:
    own = found.views.get(h.names)
    if own is not None and own.of is h:
        return own
    return examine(h, task, found.views[frozenset()].trials if h.causes else ())


def _step(found: Searched, task: Task, view: View, chosen: Hypothesis | None) -> Step:
    before, scale, best = view.of, found.scale, found.best
    own = scale.evidence(before)
    fitted = {}
    for name in found.fitted.get(before.names, ()):
        child = found.known.get(before.names | {name})
        if child is not None:
            fitted[name] = child
    if chosen is not None:
        fitted[chosen.causes[-1].name] = chosen
    evidence = {**view.estimated(), **{n: scale.evidence(c) - own for n, c in fitted.items()}}
    if chosen is not None:
        for name in _promising(evidence, fitted, chosen.causes[-1].name):
            more = with_cause(before, task.experiments, view.starts_of(name))
            evidence[name] = -np.inf if more is None else scale.evidence(more) - own
    alone, alike = evidence, task.alike(before.fit)
    good = {n for n, c in fitted.items() if c.names in found.worth}
    unfit: set[str] = set()
    if chosen is not None:
        cause = chosen.causes[-1]
        evidence, beside = _beside(found, evidence, cause.name, best)
        rest = best.names - {cause.name}
        unfit = {n for n in beside if n != cause.name and rest | {n} not in found.worth}
        unfit |= {n for g in alike if unfit & set(g) for n in g}
        unfit -= {cause.name, *(n for g in alike if cause.name in g for n in g)}
        good = (good | beside | {cause.name}) - unfit
    fit = {n for n, c in fitted.items() if in_character(c.fit, _named(c, n), task.experiments)}
    same = {n for group in alike if good & set(group) for n in group if n in fit}
    refused = (set(fitted) - good - same) | unfit
    if chosen is not None:  # beside the other causes
        refused |= best.names - {chosen.causes[-1].name}
    evidence = levelled(evidence, alike, good)
    chances = probabilities({n: v for n, v in evidence.items() if n not in refused})
    return Step(view, fitted, chosen, None, alone, evidence, chances)


def _promising(
    evidence: Mapping[str, float], fitted: Mapping[str, Hypothesis], cause: str
) -> list[str]:
    """Return effects of which only an estimate says that they are as likely as the cause."""
    least = evidence[cause] - thresholds().clearly * temperature(evidence[cause])
    return [n for n, e in evidence.items() if n not in fitted and e > least]


def _beside(
    found: Searched, evidence: Mapping[str, float], cause: str, best: Hypothesis
) -> tuple[dict[str, float], set[str]]:
    """Return the evidence beside all other causes, and the effects that were fitted there.

    What was not keeps its distance to the cause, but is not before it: it was not tried there.
    """
    rest = best.names - {cause}
    less = found.known.get(rest)
    if not rest or less is None:
        return dict(evidence), set()
    own = found.scale.evidence(less)
    most = found.scale.evidence(best) - own
    shift = most - evidence[cause]
    moved = {n: min(v + shift, most) for n, v in evidence.items()}
    there = {n: found.known.get(rest | {n}) for n in evidence if n not in rest}
    known = {n: found.scale.evidence(h) - own for n, h in there.items() if h is not None}
    return {**moved, **known}, set(known)


def _named(h: Hypothesis, name: str) -> Component:
    return next(c for c in h.causes if c.name == name)
