"""What could stand in a cause's place, weighed beside the causes that were found after it.

A first cause is chosen while the second one is still in the residual, which hides the differences
between those that are nearly as likely. Beside the second cause they show.
"""

from collections.abc import Mapping

from psa_casadi.diagnosis.screening.evidence import levelled, probabilities
from psa_casadi.diagnosis.search.extension import Extension, extend_within, polish
from psa_casadi.diagnosis.search.imitators import NEAR
from psa_casadi.diagnosis.search.rounds import RUNNER_UP, Round
from psa_casadi.diagnosis.search.selection import MARGIN, out_of_character
from psa_casadi.diagnosis.task import Task
from psa_casadi.identification.fitting.fit import Fit

#: How many effects are fitted in a cause's place, at most, and within which share of the cause's
#: evidence they are fitted to the end.
RIVALS, _CLOSE = 3, 0.05


def beside(
    step: Round, last: Round, less: Fit, own: float, task: Task
) -> tuple[dict[str, float], Extension | None]:
    """Return the evidence of a step's cause and of its rivals beside all others, and a better one.

    `last` holds all causes, `less` is its fit without the one of the `step`: the evidence is that
    over `less`, `own` the cause's.
    """
    if step.chosen is None:
        return {}, None
    name = step.chosen.effect.name
    found = {name: own}
    best: Extension | None = None
    for rival in _rivals(step, last):
        task.progress(f"{rival.effect.name} in the place of {name}")
        fitted = _in_place(rival, last, less, own, task)
        if fitted is None or out_of_character(fitted, task.experiments):
            continue
        found[rival.effect.name] = fitted.evidence
        if best is None or fitted.evidence > best.evidence:
            best = fitted
    return found, best if best is not None and best.evidence > own + MARGIN else None


def weigh_again(step: Round, found: Mapping[str, float], task: Task) -> None:
    """Give a step the evidence beside the other causes; what was not fitted keeps its distance."""
    if step.chosen is None or step.chosen.effect.name not in found:
        return
    own = step.chosen.effect.name
    shift = found[own] - step.evidence[own]
    moved = {n: found.get(n, e + shift) for n, e in step.evidence.items()}
    step.evidence = levelled(moved, task.alike(step.fit), found)
    step.probability = probabilities({n: step.evidence[n] for n in step.probability})


def _rivals(step: Round, last: Round) -> list[Extension]:
    """Return the step's fitted effects that are nearly as likely as its cause, the best first."""
    there = {c.name for c in last.fit.model.components}
    highest = max(e.evidence for e in step.extensions)
    limit = min(RUNNER_UP * highest, highest - NEAR)
    near = [
        e
        for e in step.extensions
        if e.effect.name in step.probability and e.effect.name not in there and e.evidence > limit
    ]
    return sorted(near, key=lambda e: -e.evidence)[:RIVALS]


def _in_place(rival: Extension, last: Round, less: Fit, own: float, task: Task) -> Extension | None:
    """Fit a rival beside the other causes; to the end where the evidence is near the cause's own.

    It starts from the base that all causes reached, then from that of the rival alone.
    """
    colour, experiments = last.screening.colour, task.experiments
    best: Extension | None = None
    for base in (last.fit, rival.fit):
        fitted = extend_within(less, experiments, base, rival.fit, rival.effect, colour)
        if fitted is not None and (best is None or fitted.evidence > best.evidence):
            best = fitted
        if best is not None and best.evidence > own:
            break
    if best is None or best.evidence < own - max(NEAR, _CLOSE * own):
        return best
    return polish(less, best, experiments, colour)
