"""The search for causes: best first over sets of causes, one score for all of them.

Every set of causes has one hypothesis, the best fit of it that was found. The best hypothesis is
looked at: is anything left in its residual? Then its neighbours are fitted: the base with
resonances that it has missed; with one more cause; with one less (which fits the base again from
where the cause has led); with one cause in another's place. That goes on while one of them is
better, or, where something is left, with the next best ones until the budget ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.component import Component
from psa_casadi.diagnosis.base_fit.ringing import ringing
from psa_casadi.diagnosis.base_fit.variants import (
    SEEN,
    from_band,
    from_resonances,
    instead_of,
    instead_of_mode,
    rings,
)
from psa_casadi.diagnosis.noise.colour import excess_power, noise_rms
from psa_casadi.diagnosis.screening.screen import Copy, copies
from psa_casadi.diagnosis.search.fits import (
    afresh,
    any_afresh,
    in_place,
    like,
    to_end,
    together,
    with_cause,
    without,
)
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale, hypothesis
from psa_casadi.diagnosis.search.view import View, examine
from psa_casadi.diagnosis.search.worth import confirmed, in_character
from psa_casadi.diagnosis.task import Task
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.simulation.timings import stage

#: Hypotheses whose neighbours are fitted, at most, and visits to them.
EXPANSIONS, _VISITS = 5, 24
#: Neighbours whose residual is within this factor of the noise, or that remove this share of the
#: excess power, need no fits afresh; of a first and a further cause so many get some.
_SETTLED, _NEARLY, _AFRESH, _AFRESH_FURTHER = 1.02, 0.95, 4, 2
#: So many neighbours are fitted to the end, if their evidence is this share of the best one's or
#: within so many nats of it.
_FINALISTS, _SHARE, NEAR = 3, 0.8, 30.0
#: Effects far behind in the screening are fitted afresh where less than this share of the excess
#: power is explained.
_EXPLAINED = 0.8

Names = frozenset[str]
_NONE: Names = frozenset()


@dataclass(frozen=True, eq=False)
class Searched:
    """What a search has found: every hypothesis by its causes, and the best of them.

    `views` are of hypotheses whose residual was looked at, `fitted` the effects fitted beside each.
    """

    best: Hypothesis
    known: dict[Names, Hypothesis]
    views: dict[Names, View]
    fitted: dict[Names, tuple[str, ...]]
    worth: frozenset[Names]
    scale: Scale


def best_first(base: Fit, task: Task) -> Searched:
    """Return what a search from a base fit finds. Raises SimulationError where that one fails."""
    search = _Search(base, task)
    search.run()
    return search.result()


class _Search:
    """The state of one search."""

    def __init__(self, base: Fit, task: Task) -> None:
        self.base, self.task = base, task
        self.known: dict[Names, Hypothesis] = {}
        self.views: dict[Names, View] = {}
        self.expanded: dict[Names, Hypothesis] = {}
        self.fitted: dict[Names, tuple[str, ...]] = {}
        self.done: set[tuple[str, Names]] = set()
        self.closed: set[Names] = set()
        root = hypothesis((), base, task.experiments, final=True)
        if root is None:
            raise SimulationError(
                "The fitted base cannot be simulated over the whole records; start from a model."
            )
        first = examine(root, task)
        self.trials = first.trials
        self.scale = Scale(base, first.screening.colour, thresholds().price)
        self.known[root.names] = root
        self.views[root.names] = first

    def run(self) -> None:
        for _ in range(_VISITS):
            chosen = self.next()
            if chosen is None or len(self.expanded) > EXPANSIONS:
                break
            self.visit(chosen)

    def result(self) -> Searched:
        best = self.best()
        if len(best.causes) > 1 and self.view(best).test.alarm:
            self.task.progress("all causes together, to the end")
            self.note(together(best, self.task.experiments))
            best = self.best()
        self.view(best)
        worth = frozenset(n for n, h in self.known.items() if self.worth(h))
        return Searched(best, self.known, self.views, self.fitted, worth, self.scale)

    # What to do next

    def next(self) -> Hypothesis | None:
        """Return the hypothesis to visit: the best or one on its way; else the next best one.

        None where nothing is left in the best one, or nothing else is worth a visit.
        """
        best = self.best()
        way = [self.known.get(best.names_upto(k)) for k in range(len(best.causes) + 1)]
        for own in way:
            if own is not None and (own is best or own.names in self.expanded) and self.unseen(own):
                return own
        if any(self.explains(own) for own in way[:-1] if own is not None):
            return self.next()
        if best.causes and self.once("exchange", best.names):
            self.exchange(best)
            return self.next()
        if self.open(best) and self.otherwise():
            return self.next()
        if not self.view(best).shows or "going back" in self.task.method.without:
            return None
        return self.second_best(best)

    def otherwise(self) -> bool:
        """Try what is dear, where most is left: another base, all effects; whether that was new."""
        if self.seen_in_records():
            return True
        if "all afresh" in self.task.method.without or not self.once("all afresh", _NONE):
            return False
        self.all_afresh()
        return True

    def unseen(self, h: Hypothesis) -> bool:
        """Whether a hypothesis was not visited yet, or has become much better since."""
        last = self.expanded.get(h.names)
        if last is None or h.fit.rms < thresholds().better * last.fit.rms:
            return True
        return h is self.best() and self.gained(last, h)

    def explains(self, h: Hypothesis) -> bool:
        """Whether nothing is left of a hypothesis whose fit is better than when it was seen.

        It is the answer then, whatever more causes would explain.
        """
        old = self.views.get(h.names)
        if h.names in self.closed or old is None:
            return False
        if not self.gained(old.of, h) or _left(self.view(h)):
            return False
        self.closed.add(h.names)
        return True

    def gained(self, before: Hypothesis, after: Hypothesis) -> bool:
        """Whether a fit has more evidence than an earlier one by the price of a cause."""
        return self.scale.evidence(after) > self.scale.evidence(before) + self.scale.price

    def second_best(self, best: Hypothesis) -> Hypothesis | None:
        """Return the best first cause that was not visited and may lead further than the best."""
        least = _SHARE * self.scale.score(best)
        for h in self.sorted():
            near = self.scale.score(h) > least and len(h.causes) == 1
            if near and h.names not in self.expanded and self.worth(h):
                return h
        return None

    def visit(self, h: Hypothesis) -> None:
        """Fit the neighbours of a hypothesis: fewer causes, other bases, then more causes."""
        if h.causes and self.once("challenged", h.names):
            self.challenge(h)
            return
        view = self.view(h)
        if self.resonances(h, view):
            self.done.discard(("challenged", h.names))
            return
        self.expanded[h.names] = h
        if view.shows and len(h.causes) < thresholds().most_causes:
            self.add_causes(h, view)

    def once(self, what: str, names: Names) -> bool:
        """Whether something is done for the first time with a set of causes."""
        new = (what, names) not in self.done
        self.done.add((what, names))
        return new

    # Neighbours

    @stage("fits of candidates")
    def add_causes(self, h: Hypothesis, view: View) -> None:
        """Fit with one more cause, from the hypothesis, afresh, and the leading ones to the end."""
        task, experiments = self.task, self.task.experiments
        leading = [s for s in view.leading() if self.different(s[0].direction.effect, h)]
        names = [scores[0].direction.effect.name for scores in leading]
        self.tell(h, f"fitting {', '.join(names)}")
        for found in side_by_side(lambda s: with_cause(h, experiments, s), leading):
            self.note(found)
        self.remember(h, *names)
        if "fits afresh" not in task.method.without:
            self.fit_afresh(h, view)
        self.finish([c for c in self.leaders(h) if not c.final][:_FINALISTS])

    def different(self, effect: Component, h: Hypothesis) -> bool:
        """Whether an effect bends another curve than the causes of a hypothesis do."""
        groups = self.task.alike(self.known[_NONE].fit)
        return not any(effect.name in g and h.names & set(g) for g in groups)

    @stage("fits afresh")
    def fit_afresh(self, h: Hypothesis, view: View) -> None:
        floor = noise_rms(h.fit.residuals, view.screening.colour)
        excess = excess_power(h.fit.residuals, view.screening.colour, floor)
        count = _AFRESH_FURTHER if h.causes else _AFRESH
        for k, child in enumerate(self.children(h)[:count]):
            best = max(self.children(h), key=lambda c: c.removes(h))
            if best.fit.rms < _SETTLED * floor or (k > 0 and best.removes(h) > _NEARLY * excess):
                break
            self.tell(h, f"{child.causes[-1].name} afresh")
            self.note(afresh(h, self.task.experiments, child))

    @stage("fits afresh")
    def all_afresh(self) -> None:
        root = self.known[_NONE]
        view = self.view(root)
        done = [c.causes[-1].name for c in self.children(root)[:_AFRESH]]
        scores = [s for n, s in view.screening.best_by_effect().items() if n not in done]
        self.tell(root, "all other effects afresh")
        found = any_afresh(root, self.task.experiments, scores)
        if found is not None:
            self.note(found)
            self.remember(root, found.causes[-1].name)

    def challenge(self, h: Hypothesis) -> None:
        """Fit with every cause taken out, and with resonances of the stack's own in its place."""
        task = self.task
        if "base again" not in task.method.without:
            for cause in h.causes:
                task.progress(f"without {cause.name}")
                self.note(without(h, cause, task.experiments))
        before = self.known.get(h.names_upto(len(h.causes) - 1))
        if "resonances" in task.method.without or before is None:
            return
        last, found = h.causes[-1], None
        if rings(last):
            found = instead_of_mode(before.fit, last, h.fit, task.experiments, task.progress)
        if found is None and not before.causes and not self.unseen(before):
            found = instead_of(before.fit, h.fit, task.experiments, task.progress)
        self.note(hypothesis(before.causes, found, task.experiments, final=True))

    def resonances(self, h: Hypothesis, view: View) -> bool:
        """Fit with resonances that the base has missed; whether that explains more.

        Those of fast records first. One near or above the band is tried where its ringing explains
        as much as an effect would; it bends itself to a cause that is not found yet, so that
        without a cause it counts only where nothing is left to explain.
        """
        task, experiments = self.task, self.task.experiments
        if "resonances" in task.method.without or not view.test.alarm:
            return False
        if task.fast and not h.causes and self.seen_in_records():
            return True
        if not self.once("ringing", h.names):
            return False
        rung = ringing(h.fit, experiments)
        if rung is None or rung.decrease < SEEN:
            return False
        if view.shows and rung.decrease < thresholds().ringing * view.decrease:
            return False
        found = from_band(h.fit, experiments, task.progress)
        own = hypothesis(h.causes, found, experiments, final=True)
        if own is not None and (h.causes or not _left(examine(own, task, self.trials))):
            self.note(own)
        return self.known[h.names] is not h

    def seen_in_records(self) -> bool:
        """Fit the base from resonances and lags that the records show; whether it is better."""
        root, task = self.known[_NONE], self.task
        if "resonances" in task.method.without or not self.once("resonances", _NONE):
            return False
        fitted = from_resonances(root.fit, task.experiments, task.progress)
        self.note(hypothesis((), fitted, task.experiments, final=True))
        return self.known[_NONE] is not root

    @stage("causes judged again")
    def exchange(self, h: Hypothesis) -> None:
        """Fit what was nearly as likely in a cause's step in its place, beside the later ones."""
        if "exchange" in self.task.method.without:
            return
        for k, cause in enumerate(h.causes):
            before = self.known.get(h.names_upto(k))
            less = self.known.get(h.names - {cause.name})
            if before is None or less is None:
                continue
            if len(h.causes) > 1:
                for rival in self.rivals(before, h):
                    self.task.progress(f"{rival.causes[-1].name} in the place of {cause.name}")
                    self.put_in_place(h, less, rival)
            for copy in self.copies(h, less):
                name = copy.direction.effect.name
                self.task.progress(f"{name}, which could copy {cause.name}")
                self.note(like(h, less, copy, self.task.experiments))
                self.remember(before, name)

    def put_in_place(self, h: Hypothesis, less: Hypothesis, rival: Hypothesis) -> None:
        """Fit a rival's last cause beside those of `less`, to the end where that is near."""
        effect, own = rival.causes[-1], self.scale.evidence(h)
        names = less.names | {effect.name}
        for reached in (h.fit, rival.fit):
            found = in_place(h, less, reached, rival.fit, effect, self.task.experiments)
            self.note(found)
            if found is not None and self.scale.evidence(found) > own:
                break
        best = self.known.get(names)
        if best is not None and self.scale.evidence(best) > own - NEAR:
            self.finish([best])

    def copies(self, h: Hypothesis, less: Hypothesis) -> list[Copy]:
        """Return effects that could add what the cause not in `less` adds, but were not fitted so.

        A copy that leaves so little of the contribution's sum of squares D that D (1 - R^2)/2 is
        below `NEAR` might explain the data as well; a fit much worse than its copy was lost.
        """
        pairs = zip(h.predicted, less.predicted, self.task.experiments, strict=True)
        added = np.concatenate([(p - q)[e.used] for p, q, e in pairs])
        table = [e for e in self.task.table if e.name not in h.names]
        trials = [d for d in self.trials if d.effect in table and self.different(d.effect, less)]
        power, found = copies(less.fit, added, trials, self.scale.colour)
        own = self.scale.evidence(h)
        lost: dict[str, float] = {}
        for name, copy in found.items():
            left = 0.5 * power * (1.0 - copy.share)
            known = self.known.get(less.names | {name})
            reached = -np.inf if known is None else self.scale.evidence(known)
            if left < NEAR and reached < own - left - NEAR:
                lost[name] = left
        return [found[n] for n in sorted(lost, key=lambda n: lost[n])[:_FINALISTS]]

    def rivals(self, before: Hypothesis, h: Hypothesis) -> list[Hypothesis]:
        """Return the fitted neighbours that were nearly as likely as a cause, the best first."""
        near = self.leaders(before)
        return [c for c in near if c.causes[-1].name not in h.names][:_FINALISTS]

    # What is known

    def note(self, found: Hypothesis | None) -> None:
        """Keep a hypothesis if it is the best of its causes."""
        if found is None:
            return
        old = self.known.get(found.names)
        if old is None or self.scale.evidence(found) > self.scale.evidence(old):
            causes = found.causes if old is None else old.causes
            self.known[found.names] = replace(found, causes=causes)

    def view(self, h: Hypothesis) -> View:
        """Look at what a hypothesis leaves; the noise of all others is told from the best one."""
        old = self.views.get(h.names)
        if old is None or old.of is not h:
            known = self.trials if h.causes else ()
            self.views[h.names] = old = examine(h, self.task, known)
        if h is self.best():
            self.scale = replace(self.scale, colour=old.screening.colour)
        return old

    def children(self, h: Hypothesis) -> list[Hypothesis]:
        """Return the hypotheses with one more cause that were fitted beside one, best first."""
        names = self.fitted.get(h.names, ())
        found = [self.known.get(h.names | {n}) for n in names]
        own = [replace(c, causes=(*h.causes, _added(c, h))) for c in found if c is not None]
        return sorted(own, key=lambda c: -self.scale.evidence(c))

    def leaders(self, h: Hypothesis) -> list[Hypothesis]:
        """Return those of the children that are nearly as likely as the best one, best first."""
        own, children = self.scale.evidence(h), self.children(h)
        gains = [self.scale.evidence(c) - own for c in children]
        least = min(_SHARE * gains[0], gains[0] - NEAR) if gains else 0.0
        return [c for c, gained in zip(children, gains, strict=True) if gained > least]

    def remember(self, h: Hypothesis, *names: str) -> None:
        """Keep that these effects were fitted beside a hypothesis."""
        self.fitted[h.names] = tuple(dict.fromkeys([*self.fitted.get(h.names, ()), *names]))

    def sorted(self) -> list[Hypothesis]:
        return sorted(self.known.values(), key=lambda h: -self.scale.score(h))

    def best(self) -> Hypothesis:
        """Return the answer so far: of the highest score and worth having, fitted to its end.

        Where nothing is left of a hypothesis with fewer causes, that one.
        """
        for names in sorted(self.closed, key=len):
            return self.known[names]
        while True:
            top = next(h for h in self.sorted() if self.worth(h))
            if top.final:
                return top
            self.finish([top])

    def finish(self, hypotheses: Sequence[Hypothesis]) -> None:
        if hypotheses:
            names = ", ".join("+".join(sorted(h.names)) for h in hypotheses)
            self.task.progress(f"{names} to the end")
        for ended in side_by_side(lambda h: to_end(h, self.task.experiments), hypotheses):
            old = self.known[ended.names]
            better = self.scale.evidence(ended) >= self.scale.evidence(old)
            self.known[ended.names] = ended if better else replace(old, final=True)

    def worth(self, h: Hypothesis) -> bool:
        """Whether every cause removes what can be told, and held-out data confirm it."""
        root = self.known[_NONE]
        knowable = self.views[root.names].test.knowable
        experiments, out = self.task.experiments, self.task.method.without
        for cause in h.causes:
            if not in_character(h.fit, cause, experiments):
                return False
            before = self.known.get(h.names - {cause.name})
            if before is None:
                continue
            if h.removes(before) <= knowable**2:
                return False
            if before.causes and "form" not in out and h.share(before, root) <= thresholds().form:
                return False
            if "held out" in out:
                continue
            seen = self.views.get(before.names)
            alarm = seen is None or seen.test.alarm
            if not confirmed(h, before, experiments, self.scale.colour, alarm=alarm):
                return False
        return True

    def open(self, h: Hypothesis) -> bool:
        """Whether structure remains and the causes explain less than most of the excess."""
        colour = self.view(h).screening.colour
        floor = noise_rms(h.fit.residuals, colour)
        excess = excess_power(self.base.residuals, colour, floor)
        explained = self.base.rms**2 - h.power
        return self.view(h).test.alarm and explained < _EXPLAINED * excess

    def tell(self, h: Hypothesis, what: str) -> None:
        self.task.progress(f"cause {len(h.causes) + 1}: {what}")


def _left(view: View) -> bool:
    """Whether anything is left to explain."""
    return view.test.alarm or view.shows


def _added(child: Hypothesis, parent: Hypothesis) -> Component:
    return next(c for c in child.causes if c.name not in parent.names)
