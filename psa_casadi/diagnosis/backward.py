"""The backward step: a cause that a later one made needless is dropped."""

from collections.abc import Sequence
from dataclasses import replace

from psa_casadi.component import Component
from psa_casadi.diagnosis.evidence import evidence
from psa_casadi.diagnosis.extension import extend, polish
from psa_casadi.diagnosis.rounds import Round, examine
from psa_casadi.diagnosis.selection import starts_of
from psa_casadi.diagnosis.task import Task
from psa_casadi.errors import PsaError
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.fit import Fit
from psa_casadi.identification.refitting import refit


def without_needless(rounds: list[Round], task: Task) -> list[Round]:
    """Return the rounds without causes for which, beside the later ones, there is no evidence.

    Every cause but the last is taken out in turn, the rest fitted again. Where one is dropped the
    rounds are built anew from the causes that stay.
    """
    causes = [r.chosen.effect for r in rounds if r.chosen is not None]
    last = rounds[-1]
    for cause in causes[:-1]:
        task.progress(f"without {cause.name}")
        less = _without(last.fit, cause, task.experiments)
        if less is not None and evidence(less, last.fit, last.screening.colour) < 0.0:
            kept = [c for c in causes if c is not cause]
            rebuilt = _rebuilt(rounds[0], kept, task)
            if rebuilt is not None:
                return without_needless(rebuilt, task)
    return rounds


def _without(final: Fit, cause: Component, experiments: Sequence[Experiment]) -> Fit | None:
    """Fit without a cause; None where the other values cannot even be simulated without it."""
    model = final.model.without([cause.name])
    names = [n for n in final.unknowns.names if n in model.values]
    try:
        return refit(replace(final, model=model), experiments, names)
    except PsaError:
        return None


def _rebuilt(first: Round, causes: Sequence[Component], task: Task) -> list[Round] | None:
    """Return rounds with the causes in their order; None where one of them cannot be fitted."""
    rounds = [replace(first, extensions=list(first.extensions), chosen=None)]
    for cause in causes:
        current = rounds[-1]
        colour = current.screening.colour
        scores = starts_of(current.screening, cause.name)
        found = extend(current.fit, task.experiments, scores, colour) if scores else None
        if found is None:
            return None
        current.chosen = polish(current.fit, found, task.experiments, colour)
        current.evidence = {**current.evidence, cause.name: current.chosen.evidence}
        fit, predicted = current.chosen.fit, current.chosen.predicted
        rounds.append(examine(fit, predicted, task, current.trials))
    return rounds
