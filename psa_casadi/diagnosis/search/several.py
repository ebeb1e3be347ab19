"""Several causes at once: from the base to the sets of effects that promise most together."""

from psa_casadi.diagnosis.screening.sets import best_sets
from psa_casadi.diagnosis.search.fits import with_causes
from psa_casadi.diagnosis.search.known import Known
from psa_casadi.diagnosis.search.quick_fits import cost_beside
from psa_casadi.diagnosis.task import Task
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.timings import stage

#: So many sets are fitted.
_SETS = 4


@stage("fits of several at once")
def fit_sets(known: Known, task: Task) -> None:
    """Fit the base with the sets of two effects and more that promise most together.

    The cause that explains most alone may stand for several, and hold the search there.
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
    starts = [s for s in ranked if s.names not in known.found][:_SETS]
    said = ", ".join("+".join(sorted(s.names)) for s in starts)
    task.progress(f"several causes at once: fitting {said}")
    goal = cost_beside(known.best().fit, root.fit, task.experiments)
    for found in side_by_side(lambda s: with_causes(root, task.experiments, s, goal), starts):
        known.note(found)
