"""The search for causes in any model: best first over sets of effects, one score for all of them.

The best hypothesis is looked at; what its residual shows is fitted beside it, one more cause or, of
the base, two at once; and of several causes each is exchanged for what the others still show. That
goes on while one of them is better.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from psa_casadi.any_model.fit import OdeFit, refitted
from psa_casadi.any_model.hypothesis import (
    OdeHypothesis,
    OdeView,
    Table,
    can_be_told,
    held_out_confirms,
    held_out_gain,
    hypothesis_of,
    look,
)
from psa_casadi.any_model.identify import relevelled
from psa_casadi.any_model.runs import Run
from psa_casadi.component import Component
from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.screening import Score, best_sets
from psa_casadi.diagnosis.search.hypothesis import Scale, another_minimum, inside_ranges
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.errors import PsaError
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.stepper import SimulationError

Names = frozenset[str]
NONE: Names = frozenset()
#: Evaluations of a quick fit; so many of the children of a hypothesis are fitted to their end, and
#: so many pairs of causes are tried at once.
_QUICK, _FINALISTS, _PAIRS, _END = 12, 3, 3, 60
#: Children whose evidence is this far below the best one's are not fitted to their end [nats].
_BEHIND = 30.0
_VISITS = 8
#: Ordinary sizes at which a memory that acts in full is looked for.
_FULL = 2.0


@dataclass(eq=False)
class Known:
    """What a search has found so far: every set of causes with the best fit of it."""

    runs: tuple[Run, ...]
    table: Table
    root: OdeHypothesis
    progress: Callable[[str], None]
    base: OdeFit = field(init=False)
    found: dict[Names, OdeHypothesis] = field(default_factory=dict)
    views: dict[Names, OdeView] = field(default_factory=dict)
    scale: Scale[OdeHypothesis] = field(init=False)

    def __post_init__(self) -> None:
        self.base, self.found[NONE] = self.root.fit, self.root

        def gained(of: OdeHypothesis, before: OdeHypothesis, colour: Colour) -> float:
            return held_out_gain(of, before, self.runs, colour)

        colour = self.view(self.root).screening.colour
        whole = any(r.held_out_whole for r in self.runs)
        self.scale = Scale(self.root, colour, LIMITS, gained, judge_only=whole)

    def view(self, h: OdeHypothesis) -> OdeView:
        """Look at a hypothesis; what effects add is known from the base."""
        old = self.views.get(h.names)
        if old is None or old.of.fit is not h.fit:
            self.progress(f"screening effects beside {_named(h)}")
            known = self.views[NONE].trials if h.causes else ()
            self.views[h.names] = old = look(h, self.runs, self.table, known)
        return old

    def note(self, h: OdeHypothesis | None) -> None:
        """Keep a hypothesis if it is the best of its causes, and held-out samples do not object."""
        if h is None:
            return
        old = self.found.get(h.names)
        if old is None:
            self.found[h.names] = h
            return
        gained = self.scale.evidence(h) - self.scale.evidence(old)
        if another_minimum(gained, self.scale.held_out(h, old)):
            self.found[h.names] = replace(h, causes=old.causes)

    def children(self, h: OdeHypothesis) -> list[OdeHypothesis]:
        """Return the hypotheses with one more cause, the likeliest first."""
        own = [c for c in self.found.values() if len(c.names - h.names) == 1 and c.names > h.names]
        return sorted(own, key=lambda c: -self.scale.evidence(c))

    def worth(self, h: OdeHypothesis) -> bool:
        """Whether every cause is itself, removes what can be told, and held-out data confirm it."""
        return self.stands(h) and not self.slight(h)

    def slight(self, h: OdeHypothesis) -> tuple[str, ...]:
        """Name the causes that remove too little beside the others to be told from their form."""
        names = []
        for cause in h.causes:
            before = self.found.get(h.names - {cause.name})
            if before is None or not before.causes:
                continue
            # what a cause removes of the error over what the other causes remove
            levels = [max(o.level, 1e-300) for o in before.fit.outputs]
            root, old, new = (
                sum((t / s) ** 2 for t, s in zip(x.train, levels, strict=True))
                for x in (self.found[NONE], before, h)
            )
            if root > old and (old - new) / (root - old) <= LIMITS.further:
                names.append(cause.name)
        return tuple(names)

    def stands(self, h: OdeHypothesis) -> bool:
        """Whether every cause is itself, can be told, and is confirmed by held-out data."""
        for cause in h.causes:
            if not inside_ranges(h.fit.model.values, cause):
                return False
            before = self.found.get(h.names - {cause.name})
            if before is None:
                continue
            if not can_be_told(h, before):
                return False
            if not held_out_confirms(h, before, self.runs, self.scale):
                return False
        return True

    def best(self) -> OdeHypothesis:
        """Return the hypothesis of the highest score that is worth having, fitted to its end."""
        while True:
            ranked = sorted(self.found.values(), key=lambda h: -self.scale.score(h))
            top = next((h for h in ranked if self.worth(h)), self.found[NONE])
            if top.final:
                return top
            self.finish([top])

    def finish(self, hypotheses: Sequence[OdeHypothesis]) -> None:
        """Fit hypotheses to their end, with the noise that they leave."""
        for h in hypotheses:
            self.progress(f"{_named(h)}, to the end")
            ended: OdeHypothesis | None = None
            try:
                fit = relevelled(refitted(h.fit, self.runs, evaluations=_END), self.runs)
                _raise_if(fit)
                ended = hypothesis_of(h.causes, fit, self.runs, final=True)
            except PsaError:
                pass
            old = self.found[h.names]
            better = (
                ended is not None and self.scale.evidence(ended) >= self.scale.evidence(old) - 1e-6
            )
            self.found[h.names] = ended if ended and better else replace(old, final=True)


def search(
    base: OdeFit, runs: Sequence[Run], table: Table, progress: Callable[[str], None]
) -> Known:
    """Return what a search from a base fit finds. Raises SimulationError where that one fails."""
    root = hypothesis_of((), base, runs, final=True)
    if root is None:
        raise SimulationError(
            "The fitted base cannot be simulated over the whole records; give other values."
        )
    known = Known(tuple(runs), table, root, progress)
    visited: set[Names] = set()
    for _ in range(_VISITS):
        best = known.best()
        if best.names in visited:
            break
        visited.add(best.names)
        view = known.view(best)
        known.scale = replace(known.scale, colour=view.screening.colour)
        if len(best.causes) > 1:
            exchange(known, best)
        if view.shows and len(best.causes) < LIMITS.most_causes:
            add_causes(known, best, view)
    return known


def add_causes(known: Known, h: OdeHypothesis, view: OdeView) -> None:
    """Fit with one more cause, the leading ones to their end; and the base with two at once."""
    for scores in view.leading():
        known.note(with_cause(known, h, scores))
    _finish_leaders(known, h)
    best = known.best()
    if h.causes or not known.view(best).test.alarm:
        return
    for pair in best_sets(h.fit, view.trials, view.screening.colour, 2)[:_PAIRS]:
        known.progress(f"fitting {' and '.join(sorted(pair.names))}")
        pairs = zip(pair.directions, pair.gains, strict=True)
        added = [(d.effect, d.values, d.unit_gain if d.finite else g) for d, g in pairs]
        fit = _quick(known, h, added, 2 * _QUICK)
        known.note(hypothesis_of((*h.causes, *(e for e, _, _ in added)), fit, known.runs))


def exchange(known: Known, h: OdeHypothesis) -> None:
    """Fit what the other causes still show in the place of each cause."""
    for cause in h.causes:
        less = without(known, h, cause)
        if less is None:
            continue
        for scores in known.view(less).leading()[:_FINALISTS]:
            names = less.names | {scores[0].direction.effect.name}
            if names not in known.found:
                known.note(with_cause(known, less, scores))
        _finish_leaders(known, less)


def _finish_leaders(known: Known, h: OdeHypothesis) -> None:
    children = known.children(h)
    if children:
        least = known.scale.evidence(children[0]) - _BEHIND
        near = [c for c in children if known.scale.evidence(c) > least and not c.final]
        known.finish(near[:_FINALISTS])


def with_cause(known: Known, h: OdeHypothesis, scores: Sequence[Score]) -> OdeHypothesis | None:
    """Fit quickly with one more cause from its best directions; None if every fit fails.

    The linear estimate of a memory's gain tells little of one that acts in full: such an effect
    starts from an ordinary size of either sign at every trial value, too.
    """
    effect = scores[0].direction.effect
    known.progress(f"fitting {effect.name} beside {_named(h)}")
    starts = [(s.direction.values, s.start) for s in scores]
    if any(q.memory for q in effect.states):
        trials = [d for d in known.views[NONE].trials if d.effect is effect]
        starts += [(d.values, side * _FULL * d.unit_gain) for d in trials for side in (1, -1)]
    fits = side_by_side(lambda s: _quick(known, h, [(effect, *s)]), starts)
    best = min((f for f in fits if f is not None), key=lambda f: f.cost, default=None)
    return hypothesis_of((*h.causes, effect), best, known.runs)


def without(known: Known, h: OdeHypothesis, cause: Component) -> OdeHypothesis | None:
    """Fit without a cause from where the whole has led; return the best without it."""
    left = [c for c in h.causes if c is not cause]
    model = known.table.with_effects(h.fit, left)
    try:
        fit = relevelled(refitted(h.fit, known.runs, model=model, evaluations=_END), known.runs)
        _raise_if(fit)
        known.note(hypothesis_of(left, fit, known.runs, final=True))
    except PsaError:
        pass
    return known.found.get(frozenset(c.name for c in left))


def _quick(
    known: Known,
    h: OdeHypothesis,
    added: Sequence[tuple[Component, dict[str, float], float]],
    evaluations: int = _QUICK,
) -> OdeFit | None:
    """Fit with more effects from their trial values and gains; at a third of these if that fails.

    A fit that is worse than the one without them has failed. None where both fail.
    """
    before = h.fit
    model = known.table.with_effects(before, [*h.causes, *(e for e, _, _ in added)])
    for share in (1.0, 0.3):
        values: dict[str, float] = {}
        for effect, trial, gain in added:
            low, high = model.parameter(effect.gain or "").bounds
            values |= {**trial, effect.gain or "": float(np.clip(share * gain, low, 0.9 * high))}
        try:
            fit = refitted(
                before, known.runs, model=model.with_values(values),
                evaluations=evaluations, tolerance=1e-3,
            )  # fmt: skip
        except PsaError:
            continue
        _raise_if(fit)
        if fit.cost < before.cost:
            return fit
    return None


def _raise_if(fit: OdeFit) -> None:
    if fit.interrupted:
        raise KeyboardInterrupt


def _named(h: OdeHypothesis) -> str:
    return " and ".join(sorted(h.names)) or "the base"
