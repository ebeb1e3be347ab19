"""Several causes at once: sets that promise most together, from the base and from smaller sets."""

from collections.abc import Sequence

from psa_casadi.diagnosis.screening import best_sets
from psa_casadi.diagnosis.search.fits import (
    cost_beside,
    in_place,
    to_end,
    with_causes,
    with_causes_afresh,
)
from psa_casadi.diagnosis.search.hypothesis import Hypothesis
from psa_casadi.diagnosis.search.known import FINALISTS, Known
from psa_casadi.diagnosis.task import Task
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.timings import stage

#: So many sets are fitted.
_SETS = 4
#: ... of which so many are pairs with the best cause alone.
_PAIRS = 2


@stage("fits of several at once")
def fit_sets(known: Known, task: Task, h: Hypothesis) -> None:
    """Fit the base with the sets of two effects and more that promise most together.

    The cause that explains most alone, that of `h`, may stand for several and hold the search
    there: sets without it are tried. Or it is one of them: pairs with what leads beside it are
    tried, as a fit that adds one cause to the other may end in another minimum than one that begins
    with both. These go to their end, since they need more steps for it.
    """
    root, price = known.root, known.scale.price
    view, alike = known.view(root), task.alike(root.fit)
    if not view.trials:
        return
    every = [
        found
        for size in range(2, thresholds().most_causes + 1)
        for found in best_sets(root.fit, view.trials, view.screening.colour, size, alike)
    ]
    ranked = sorted(every, key=lambda s: price * len(s.names) - s.promise)
    beside = [h.names | {n} for n in known.view(h).screening.leading()[:_PAIRS] if h.causes]
    pairs = [s for s in ranked if s.names in beside]
    apart = [s for s in ranked if not s.names & h.names]
    starts = [s for s in [*pairs, *apart] if s.names not in known.found][:_SETS]
    said = ", ".join("+".join(sorted(s.names)) for s in starts)
    task.progress(f"several causes at once: fitting {said}")
    goal = cost_beside(known.best().fit, root.fit, task.experiments)
    ways = [with_causes]
    if "fits afresh" not in task.method.without:
        ways.append(with_causes_afresh)
    jobs = [(way, s) for way in ways for s in starts]
    found = side_by_side(lambda j: j[0](root, task.experiments, j[1], goal), jobs)
    fitted = [f for f in found if f is not None]
    better = [f for f in fitted if f.names in beside and known.scale.evidence(f) > 0.0]
    others = [f for f in fitted if f not in better]
    for f in _best_to_end(better, others, known, task, goal):
        known.note(f)


@stage("fits afresh")
def fit_from_other_parents(h: Hypothesis, known: Known, task: Task) -> None:
    """Fit children of a hypothesis from their other parents, where those promise more.

    Beside fewer causes a fit may have ended in another minimum, and a deeper one. If causes add up,
    a child gains what both of its parents have gained over what these share.
    """
    if "other parents" in task.method.without:
        return
    evidence = known.scale.evidence
    for cause in h.causes:
        shared = known.get(h.names - {cause.name})
        if shared is None or not shared.causes:
            continue
        gained = evidence(h) - evidence(shared) - known.scale.price
        for child in known.children(h):
            other = known.get(child.names - {cause.name})
            if other is not None and evidence(other) + gained > evidence(child):
                added = child.causes[-1].name
                task.progress(f"cause {len(child.causes)}: {added} as beside fewer causes")
                known.note(in_place(child, other, other.fit, h.fit, cause, task.experiments))


def _best_to_end(
    pairs: Sequence[Hypothesis],
    found: Sequence[Hypothesis],
    known: Known,
    task: Task,
    goal: float,
) -> list[Hypothesis]:
    """Return fits of sets, the pairs and the best others of them to their end.

    Of two fits of one set the better one so far need not be the one that ends lower. One whose cost
    will stay above the `goal` ends before.
    """
    ranked = sorted(found, key=lambda h: -known.scale.score(h))
    best, others = [*pairs, *ranked[:FINALISTS]], ranked[FINALISTS:]
    said = ", ".join("+".join(sorted(h.names)) for h in best)
    task.progress(f"{said} to the end")
    return [*side_by_side(lambda h: to_end(h, task.experiments, goal), best), *others]
