"""The backward step: causes that later ones made needless are dropped, or change their names."""

from collections.abc import Sequence
from dataclasses import replace

from psa_casadi.component import Component
from psa_casadi.diagnosis.screening.evidence import estimated, evidence
from psa_casadi.diagnosis.search.extension import extend, extend_within, polish
from psa_casadi.diagnosis.search.rivals_beside import beside, weigh_again
from psa_casadi.diagnosis.search.rounds import Round, examine, settle_on
from psa_casadi.diagnosis.search.selection import LEAST, starts_of
from psa_casadi.diagnosis.task import Task
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.search.refitting import refit
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.timings import stage


@stage("causes judged again")
def reconsidered(rounds: list[Round], task: Task) -> list[Round]:
    """Return the rounds with every cause but the last judged again beside the later ones.

    Each is taken out in turn and the rest fitted again. Where there is hardly evidence for it, it
    is dropped; else what was nearly as likely in its step is fitted in its place, which gives the
    step's probabilities, and takes its place where there is more evidence for it. The rounds are
    then built anew.
    """
    weights: list[tuple[int, dict[str, float]]] = []
    for k in range(sum(r.chosen is not None for r in rounds) - 1):
        causes = [r.chosen.effect for r in rounds if r.chosen is not None]
        last = rounds[-1]
        task.progress(f"without {causes[k].name}")
        less = _without(last.fit, causes[k], task.experiments)
        if less is None:
            continue
        own = evidence(less, last.fit, last.screening.colour)
        if own < LEAST:
            rebuilt = _rebuilt(rounds[0], [*causes[:k], *causes[k + 1 :]], less, task)
            if rebuilt is not None:
                return reconsidered(rebuilt, task)
        found, better = beside(rounds[k], last, less, own, task)
        if better is not None:
            causes[k] = better.effect
            rounds = _rebuilt(rounds[0], causes, better.fit, task) or rounds
        weights.append((k, found))
    for k, found in weights if task.method.weights == "evidence" else ():
        weigh_again(rounds[k], found, task)
    return rounds


def _without(final: Fit, cause: Component, experiments: Sequence[Experiment]) -> Fit | None:
    """Fit without a cause; None where the other values cannot even be simulated without it."""
    model = final.model.without([cause.name])
    names = [n for n in final.unknowns.names if n in model.values]
    try:
        return refit(replace(final, model=model), experiments, names)
    except PsaError:
        return None


def _rebuilt(
    first: Round, causes: Sequence[Component], reached: Fit, task: Task
) -> list[Round] | None:
    """Return rounds with the causes in their order; None where one of them cannot be fitted.

    Every cause is fitted from its directions and from the values in the fit that all of them
    `reached` together: the first may be what keeps a base that was bent to another cause.
    """
    guess = estimated(first.fit, first.screening)
    rounds = [replace(first, extensions=list(first.extensions), chosen=None, evidence=guess)]
    for cause in causes:
        current = rounds[-1]
        colour = current.screening.colour
        scores = starts_of(current.screening, cause.name)
        found = [
            extend(current.fit, task.experiments, scores, colour) if scores else None,
            extend_within(current.fit, task.experiments, reached, reached, cause, colour),
        ]
        fitted = [f for f in found if f is not None]
        if not fitted:
            return None
        best = min(fitted, key=lambda f: f.fit.cost)
        chosen = polish(current.fit, best, task.experiments, colour)
        settle_on(current, chosen, task, rounds[0].chosen if len(rounds) > 1 else None)
        rounds.append(examine(chosen.fit, chosen.predicted, task, current.trials))
    return rounds
