"""Another effect in a cause's place, beside all others: its rivals, and what could copy it."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.component import Component
from psa_casadi.diagnosis.screening import Copy, Score, copies
from psa_casadi.diagnosis.search.fits import in_place, like, with_cause
from psa_casadi.diagnosis.search.hypothesis import Hypothesis
from psa_casadi.diagnosis.search.known import NEAR, SHARE, Known
from psa_casadi.diagnosis.task import Task
from psa_casadi.simulation.timings import stage

#: So many rivals of a cause are fitted, and so many copies.
_MOST = 3


@stage("causes judged again")
def exchange(h: Hypothesis, known: Known, task: Task) -> None:
    """Fit in each cause's place what the screening beside all others finds near it."""
    for cause in h.causes:
        less = known.get(h.names - {cause.name})
        if less is None:
            continue
        if len(h.causes) > 1:
            for starts in _near(h, less, known)[:_MOST]:
                task.progress(f"{_effect(starts).name} in the place of {cause.name}")
                _put_in_place(h, less, starts, known, task)
            known.remember(less, cause.name)
        for copy in _copies(h, less, known, task):
            name = copy.direction.effect.name
            task.progress(f"{name}, which could copy {cause.name}")
            known.note(like(h, less, copy, task.experiments, known.near(less, h)))
            known.remember(less, name)


def _near(h: Hypothesis, less: Hypothesis, known: Known) -> list[list[Score]]:
    """Return the starts of effects that promise nearly what `h` gains beside the causes of `less`.

    They are not among the causes, and bend no curve that one of them bends.
    """
    view = known.view(less)
    promised, gained = view.estimated(), known.scale.evidence(h) - known.scale.evidence(less)
    least = min(SHARE * gained, gained - NEAR)
    return [
        starts
        for starts in view.leading()
        if promised[_effect(starts).name] > least
        and _effect(starts).name not in h.names
        and known.different(_effect(starts), less)
    ]


def _put_in_place(
    h: Hypothesis, less: Hypothesis, starts: Sequence[Score], known: Known, task: Task
) -> None:
    """Fit an effect beside the causes of `less`, from there and from where `h` has led the base.

    To the end where that comes near.
    """
    goal = known.near(less, h)
    rival = with_cause(less, task.experiments, starts, goal)
    known.note(rival)
    if rival is None:
        return
    effect = _effect(starts)
    known.note(in_place(h, less, h.fit, rival.fit, effect, task.experiments, goal))
    known.remember(less, effect.name)
    best = known.get(rival.names)
    if best is not None and known.scale.evidence(best) > known.scale.evidence(h) - NEAR:
        known.finish([best])


def _copies(h: Hypothesis, less: Hypothesis, known: Known, task: Task) -> list[Copy]:
    """Return effects that could add what the cause not in `less` adds, but were not fitted so.

    A copy that leaves so little of the contribution's sum of squares D that D (1 - R^2)/2 is
    below `NEAR` might explain the data as well; a fit much worse than its copy was lost.
    """
    pairs = zip(h.predicted, less.predicted, task.experiments, strict=True)
    added = np.concatenate([(p - q)[e.used] for p, q, e in pairs])
    table = [e for e in task.table if e.name not in h.names]
    trials = [d for d in known.trials if d.effect in table and known.different(d.effect, less)]
    power, found = copies(less.fit, added, trials, known.scale.colour)
    own = known.scale.evidence(h)
    lost: dict[str, float] = {}
    for name, copy in found.items():
        left = 0.5 * power * (1.0 - copy.share)
        fitted = known.get(less.names | {name})
        reached = -np.inf if fitted is None else known.scale.evidence(fitted)
        if left < NEAR and reached < own - left - NEAR:
            lost[name] = left
    return [found[n] for n in sorted(lost, key=lambda n: lost[n])[:_MOST]]


def _effect(starts: Sequence[Score]) -> Component:
    return starts[0].direction.effect
