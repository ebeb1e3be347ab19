"""The search for causes: best first over sets of causes, one score for all of them.

Every set of causes has one hypothesis, the best fit of it so far. The best hypothesis is
looked at: is anything left in its residual? Then its neighbours are fitted: the base with
resonances that it lacks; with one more cause; with several at once; with one less (which fits
the base again from where the cause has led); with one cause in another's place. That goes on while
one of them is better; where much is left, from another base and with all effects.
"""

import numpy as np

from psa_casadi.common.notes import note
from psa_casadi.diagnosis import base_fit
from psa_casadi.diagnosis.colour import noise_rms
from psa_casadi.diagnosis.corrections import CauseEvidence
from psa_casadi.diagnosis.pack import Task
from psa_casadi.diagnosis.search import fits, moves
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, View, examine, hypothesis
from psa_casadi.diagnosis.search.state import FINALISTS, NONE, Names, SearchState
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.effects.mechanics import structural_mode
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.timings import Work, counted, stage

#: Hypotheses whose neighbours are fitted, at most, and visits to them.
_EXPANSIONS, _VISITS = 5, 24
#: Factor to the noise within which a neighbour's residual makes fits from default values needless;
#: else number of neighbours that get them, of a first and of a further cause. The noise is
#: estimated too low by what was projected out of it: 1.7 % where 132 directions were taken out of
#: 3,900 samples.
_SETTLED, _AFRESH, _AFRESH_FURTHER = 1.03, 5, 2
#: Causes that could not be named with this probability are small.
_SURELY = 0.9
#: A hypothesis is looked at again when its rms falls to this share; a resonance near the band is
#: tried where its ringing explains this share of what the best effect would.
_BETTER, _RINGING = 0.95, 0.4
#: Number of neighbours that are fitted first.
_PACE = 2


def best_first(base: Fit, task: Task, before: SearchState | None = None) -> SearchState:
    """Return what a search from a base fit finds. Raises SimulationError where that one fails.

    Where its work goes beyond the method's budget it starts nothing more, and reports what it left.
    A search `before` of the same base with fewer effects has fitted hypotheses that are used again.
    """
    with counted() as work:
        search = _Search(base, task, work)
        if before is not None:
            search.go_on(before)
        try:
            search.run()
        except KeyboardInterrupt:
            task.keep(next(h for h in search.known.ranked() if h.final).fit)
            raise
    return search.known


class _Search:
    """The state of one search."""

    def __init__(self, base: Fit, task: Task, work: Work) -> None:
        self.task, self.work, self.known = task, work, SearchState(base, task)
        self.left: list[str] = []
        self.expanded: dict[Names, Hypothesis] = {}
        self.done: set[tuple[str, Names]] = set()
        self.sets_of: Hypothesis | None = None
        self.resonant: Hypothesis | None = None
        self.shaken: dict[Names, Fit] = {}
        self.tried: set[tuple[Fit, str]] = set()

    def go_on(self, before: SearchState) -> None:
        """Take over what a search with fewer effects has fitted, and what it has tried."""
        for h in before.hypotheses.values():
            if h.causes:
                self.known.note(h)
        self.tried = {
            (h.fit, n) for h in before.hypotheses.values() for n in before.fitted.get(h.names, ())
        }
        ended = [h.names for h in before.hypotheses.values() if h.causes and h.final]
        self.done |= {(what, names) for what in ("base again", "challenged") for names in ended}

    def run(self) -> None:
        for _ in range(_VISITS):
            chosen = self.next()
            if chosen is None or len(self.expanded) > _EXPANSIONS:
                break
            if self.expanded and not self.does("neighbours"):
                break
            self.known.notify(chosen, "visited")
            self.visit(chosen)
        while self.led(self.known.best()):
            pass
        best = self.known.best()
        if len(best.causes) > 1 and self.known.view(best).test.alarm:
            self.task.progress("all causes to the end")
            self.known.note(fits.together(best))
        self.known.conclude()
        if self.left:
            left = tuple(dict.fromkeys(self.left))
            self.known.remarks = (note("budget", work=float(self.work.done), left=left),)

    def does(self, step: str) -> bool:
        """Whether a step belongs to the method, and may start; the budget may be spent."""
        if step in self.task.method.without:
            return False
        if self.work.done <= self.task.method.budget:
            return True
        self.left.append(step)
        return False

    # What to do next

    def next(self) -> Hypothesis | None:
        """Return the hypothesis to visit: the best one, or one on its way that has become better.

        None where neither is new, and nothing dear is left to try.
        """
        if self.led(self.known.ranked()[0]):
            return self.next()
        best = self.known.best()
        way = [self.known.hypotheses.get(best.names_upto(k)) for k in range(len(best.causes) + 1)]
        for h in way:
            if h and (h is best or h.names in self.expanded) and self.is_new(h):
                return h
        if best.causes and self.once("exchange", best.names):
            if self.does("exchange"):
                moves.exchange(best, self.known)
            return self.next()
        if self.known.is_open(best):
            return self.next() if self.otherwise() else self.rejected()
        if self.is_small(best) and self.once("all afresh", NONE) and self.does("all afresh"):
            self.all_afresh()
            return self.next()
        return None

    def is_small(self, h: Hypothesis) -> bool:
        """Whether causes are so small relative to the noise that others may be as likely."""
        evidence = CauseEvidence(self.known.scale.evidence(h), len(h.fit.residuals))
        return bool(h.causes) and evidence.listed_probability(self.task.limits) < _SURELY

    def rejected(self) -> Hypothesis | None:
        """Return the best of what held-out samples reject that may lack a cause.

        While a large one is missing, they can hardly confirm a small one.
        """
        if not self.does("rejected"):
            return None
        for h in self.known.rejected():
            if len(h.causes) < self.task.limits.most_causes and self.is_new(h):
                self.known.finish([] if h.final else [h])
                return self.known.hypotheses.get(h.names)
        return None

    def otherwise(self) -> bool:
        """Try what is dear, where most is left; whether that was new.

        Another base, all effects, and sets of them: where no cause alone may be the answer, two
        may.
        """
        if self.seen_in_records():
            return True
        if not self.known.best().causes and self.once("sets", NONE):
            self.several_at_once(self.known.best())
            return True
        if not self.once("all afresh", NONE) or not self.does("all afresh"):
            return False
        self.all_afresh()
        return True

    def led(self, h: Hypothesis) -> bool:
        """Fit the base again without each cause of a hypothesis; whether that is done anew.

        Even one that may not be the answer can have led the base to where it needs no cause.
        """
        new = bool(h.causes) and h.final and self.once("base again", h.names)
        for cause in h.causes if new else ():
            less = self.known.hypotheses.get(h.names - {cause.name})
            if (less is None or not cause.more_of) and self.does("base again"):
                self.task.progress(f"without {cause.name}")
                self.known.note(fits.without(h, cause, less))
        return new

    def is_new(self, h: Hypothesis) -> bool:
        """Whether a hypothesis was not visited yet, or has become much better since."""
        last = self.expanded.get(h.names)
        if last is None or h.fit.rms < _BETTER * last.fit.rms:
            return True
        if h is not self.known.best():
            return False
        scale = self.known.scale
        return scale.evidence(h) > scale.evidence(last) + scale.limits.price

    def visit(self, h: Hypothesis) -> None:
        """Fit the neighbours of a hypothesis: fewer causes, other bases, then more causes."""
        series = has_series(h)
        if h.causes and self.once("challenged", h.names):
            self.challenge(h)
            return
        view = self.known.view(h)
        if not series and self.resonances(h, view):
            self.done -= {("challenged", h.names), ("base again", h.names)}
            return
        self.expanded[h.names] = h
        if self.several_modes(h, view):
            return
        if view.shows and len(h.causes) < self.task.limits.most_causes:
            if h.causes and not series:
                self.several_at_once(h)
            self.add_causes(h, view)

    def once(self, what: str, names: Names) -> bool:
        """Whether something is done for the first time with a set of causes."""
        new = (what, names) not in self.done
        self.done.add((what, names))
        return new

    # Neighbours

    @stage("fits of candidates")
    def add_causes(self, h: Hypothesis, view: View) -> None:
        """Fit with one more cause, from here and from default values; end the leading fits."""
        leading = [s for s in view.leading() if self.known.different(s[0].direction.effect, h)]
        leading = [s for s in leading if (h.fit, s[0].direction.effect.name) not in self.tried]
        names = [scores[0].direction.effect.name for scores in leading]
        if not names:
            return
        self.report(h, f"fitting {', '.join(names)}")
        for result in side_by_side(lambda s: fits.with_cause(h, s), leading[:_PACE]):
            self.known.note(result)
        self.known.remember(h, *names)
        best = max(self.known.children(h), key=lambda c: c.removes(h), default=None)
        goal = self.known.near(h, best) if best is not None else np.inf
        rest = leading[_PACE:]
        if rest and self.does("other effects"):
            for result in side_by_side(lambda s: fits.with_cause(h, s, goal), rest):
                self.known.note(result)
        if "fits afresh" not in self.task.method.without:
            self.fit_afresh(h, view)
            if self.does("other parents"):
                moves.fit_from_other_parents(h, self.known)
        leaders = [c for c in self.known.leaders(h) if not c.final]
        self.known.finish(leaders[: FINALISTS if self.does("finalists") else 1])

    @stage("fits of candidates")
    def several_modes(self, h: Hypothesis, view: View) -> bool:
        """Fit a series of modes added to the base or in a single one's place; whether it is best.

        Where fast records show several, or where one leaves structure.
        """
        name = structural_mode.name
        if structural_mode not in self.task.table or not view.test.alarm:
            return False
        less = self.known.hypotheses.get(h.names - {name})
        if less is None or not (name in h.names or (self.task.is_fast(h.fit) and not h.causes)):
            return False
        if self.shaken.get(less.names) is less.fit or not self.does("several modes"):
            return False
        self.shaken[less.names] = less.fit
        self.report(less, "several modes at once")
        result = moves.with_modes(less)
        if result is None:
            return False
        self.known.note(result)
        single = view.starts_of(name) if less is h else []
        if single:
            self.known.note(fits.with_cause(h, single))
        self.known.remember(less, result.causes[-1].name, name)
        return self.known.best().names == result.names

    def several_at_once(self, h: Hypothesis) -> None:
        """Fit sets of causes at once, again where the base without causes has become another."""
        if self.sets_of is self.known.root or not self.does("several at once"):
            return
        self.sets_of = self.known.root
        moves.fit_sets(self.known, h)

    @stage("fits afresh")
    def fit_afresh(self, h: Hypothesis, view: View) -> None:
        floor = noise_rms(h.fit.residuals, view.screening.colour)
        count = _AFRESH_FURTHER if h.causes else _AFRESH
        children = [c for c in self.known.children(h) if not has_series(c)]
        for child in children[:count]:
            best = max(self.known.children(h), key=lambda c: c.removes(h))
            if best.fit.rms < _SETTLED * floor or not self.does("fits afresh"):
                break
            self.report(h, f"{child.causes[-1].name} afresh")
            self.known.note(fits.fit_from_default(h, child, self.known.near(h, best)))

    @stage("fits afresh")
    def all_afresh(self) -> None:
        root = self.known.root
        view = self.known.view(root)
        done = [c.causes[-1].name for c in self.known.children(root)[:_AFRESH]]
        scores = [s for n, s in view.screening.best_by_effect().items() if n not in done]
        self.report(root, "all other effects afresh")
        result = fits.fit_any_from_default(root, scores)
        if result is not None:
            self.known.note(result)
            self.known.remember(root, result.causes[-1].name)

    def challenge(self, h: Hypothesis) -> None:
        """Fit with every cause taken out, and with resonances of the stack in its place.

        Several modes that leave structure are challenged by a single one.
        """
        self.led(h)
        task = self.task
        before = self.known.hypotheses.get(h.names_upto(len(h.causes) - 1))
        if before is not None and h.causes[-1].more_of and self.known.view(h).test.alarm:
            task.progress(f"without {h.causes[-1].name}, one mode instead")
            for one in moves.one_mode(h, before):
                self.known.note(one)
            self.known.remember(before, structural_mode.name)
        if before is None or has_series(h) or not self.does("resonances"):
            return
        last, fit = h.causes[-1], None
        if base_fit.rings(last):
            fit = base_fit.instead_of_mode(before.fit, last, h.fit, task.progress)
        if fit is None and not before.causes and not self.is_new(before):
            other = self.resonant.fit if self.resonant else None
            fit = base_fit.instead_of(before.fit, h.fit, task.progress, other)
        self.known.note(hypothesis(before.causes, fit, final=True))

    def resonances(self, h: Hypothesis, view: View) -> bool:
        """Fit with resonances that the base lacks; whether that explains more.

        Those of fast records first. One near or above the band is tried where its ringing explains
        as much as an effect would; it bends itself to a cause that is not known yet, so that
        without a cause it counts only where nothing is left to explain.
        """
        task = self.task
        if not view.test.alarm or not self.does("resonances"):
            return False
        if not h.causes and self.seen_in_records(sure=not task.is_fast(h.fit)):
            return True
        if not self.once("ringing", h.names):
            return False
        rung = base_fit.ringing(h.fit)
        if rung is None or rung.decrease < base_fit.LEAST_DECREASE:
            return False
        if view.shows and rung.decrease < _RINGING * view.decrease:
            return False
        fit = base_fit.from_band(h.fit, task.progress)
        other = hypothesis(h.causes, fit, final=True)
        if other is not None and (h.causes or not examine(other, task, self.known.trials).leaves):
            self.known.note(other)
        return self.known.hypotheses.get(h.names) is not h

    def seen_in_records(self, *, sure: bool = False) -> bool:
        """Fit the base from resonances and lags that the records show; whether it is better.

        If `sure`, it counts only where it leaves nothing: slow records rarely show a resonance, and
        what looks like one may be of a cause. Without, what was fitted before counts.
        """
        root, task = self.known.root, self.task
        if self.once("resonances", NONE) and self.does("resonances"):
            fitted = base_fit.from_resonances(root.fit, task.progress)
            self.resonant = hypothesis((), fitted, final=True)
        if self.resonant and not (sure and examine(self.resonant, task, self.known.trials).leaves):
            self.known.note(self.resonant)
            self.resonant = None
        return self.known.root is not root

    def report(self, h: Hypothesis, what: str) -> None:
        self.task.progress(f"cause {len(h.causes) + 1}: {what}")


def has_series(h: Hypothesis) -> bool:
    """Whether a cause is a series of modes, which has taken all that rings."""
    return any(c.more_of for c in h.causes)
