"""One step of the search for causes: screen, fit the leading effects, ask for imitators, choose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.noise.colour import excess_power, noise_rms, residual_colour
from psa_casadi.diagnosis.noise.floor import knowable_of, known_colour
from psa_casadi.diagnosis.noise.residual_tests import Omnibus, omnibus
from psa_casadi.diagnosis.screening.evidence import (
    bic_probabilities,
    estimated,
    levelled,
    probabilities,
)
from psa_casadi.diagnosis.screening.probes import Direction, directions
from psa_casadi.diagnosis.screening.screen import Screening, screen
from psa_casadi.diagnosis.search.extension import (
    Extension,
    extend,
    extend_afresh,
    polish,
)
from psa_casadi.diagnosis.search.imitators import NEAR, imitations
from psa_casadi.diagnosis.search.selection import choose, leading, out_of_character
from psa_casadi.diagnosis.task import Task
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.timings import stage

FloatArray = npt.NDArray[np.float64]

#: An extension whose residual is within this factor of the noise needs no further starts.
SETTLED = 1.02
#: How many extensions are fitted to the end, if their evidence is this share of the best one's or
#: within `NEAR` of it.
FINALISTS, RUNNER_UP = 3, 0.8
#: How many extensions are fitted afresh, of a first and of a further cause: the best one and, while
#: none removes this share of the excess power, the next ones.
AFRESH, AFRESH_FURTHER, MOST = 4, 2, 0.95


@dataclass(eq=False)
class Round:
    """One step of the search: the model so far, its screening and test, the extensions tried.

    `evidence` is ln B of every effect over the model so far, of a full fit where there was one, or
    over all other causes where later ones were found, and of effects that bend the same curve the
    best one's; `probability` that of being the cause, given that one effect of the table is.
    """

    fit: Fit
    predicted: tuple[FloatArray, ...]
    trials: tuple[Direction, ...]
    screening: Screening
    test: Omnibus
    extensions: list[Extension] = field(default_factory=list)
    chosen: Extension | None = None
    evidence: Mapping[str, float] = field(default_factory=dict)
    probability: Mapping[str, float] = field(default_factory=dict)


@stage("screening")
def examine(
    fit: Fit, predicted: tuple[FloatArray, ...], task: Task, known: Sequence[Direction] = ()
) -> Round:
    """Screen the effects that a fit does not hold yet, and test its residual.

    Directions that are `known` from the fit before are used again: what an effect adds hardly
    changes with another effect beside it, and a full fit judges.
    """
    task.progress("screening effects")
    table = [e for e in task.table if e not in fit.model.components]
    kept = [d for d in known if d.effect in table]
    if known:
        lines = [e for e in table if e.tone is not None]  # the residual's lines are new ones
        kept = [d for d in kept if d.effect not in lines] + _directions(fit, task, lines)
    else:
        kept = _directions(fit, task, table)
    screening = _screened(fit, kept, task)
    voltage = np.concatenate([e.record.voltage[e.used] for e in task.experiments])
    time = np.concatenate([e.record.time[e.used] for e in task.experiments])
    floor = noise_rms(fit.residuals, screening.colour)
    limit = knowable_of(fit, task.experiments)
    test = omnibus(
        fit.residuals, voltage, time, screening.colour, floor, knowable=limit, even=bool(known)
    )
    guess = levelled(estimated(fit, screening), task.alike(fit))
    return Round(
        fit,
        predicted,
        tuple(kept),
        screening,
        test,
        evidence=guess,
        probability=probabilities(guess),
    )


def _directions(fit: Fit, task: Task, effects: Sequence[Component]) -> list[Direction]:
    return directions(fit, task.experiments, effects, finite_steps=task.method.finite_steps)


def _screened(fit: Fit, trials: Sequence[Direction], task: Task) -> Screening:
    lengths = [int(e.used.sum()) for e in task.experiments]
    residuals = fit.residuals_of(task.experiments)
    known = [known_colour(e.record, r) for e, r in zip(task.experiments, residuals, strict=True)]
    if task.method.whiten_from == "residual":
        return screen(fit, trials, lengths, colour=residual_colour(fit.residuals, lengths))
    return screen(fit, trials, lengths, known)


@stage("fits of candidates")
def search_cause(current: Round, number: int, task: Task, first: Extension | None = None) -> None:
    """Fit the leading effects and what could imitate the best, and choose among them.

    `first` is the first cause where this is a further one.
    """
    colour, experiments = current.screening.colour, task.experiments
    first_fits = leading(current.screening)
    task.progress(f"cause {number}: fitting {', '.join(name for name, _ in first_fits)}")
    found = side_by_side(lambda f: extend(current.fit, experiments, f[1], colour), first_fits)
    current.extensions += [extension for extension in found if extension is not None]
    _sort(current)
    _afresh(current, number, task)
    decide(current, number, task, first)


@stage("choosing")
def decide(current: Round, number: int, task: Task, first: Extension | None = None) -> None:
    """Fit the best extensions to the end and what could look like them, and choose."""
    _sort(current)
    _polish(current, number, task)
    if current.extensions and task.method.imitators:
        _imitators(current, number, task)
        _polish(current, number, task)
    ranked = _ranked(current, task, first)
    while ranked and not ranked[0].final:  # better ones were not worth having
        _to_end(current, ranked[:1], number, task)
        ranked = _ranked(current, task, first)
    _weigh(current, ranked, task)
    current.chosen = ranked[0] if ranked else None


@stage("fits afresh")
def _afresh(current: Round, number: int, task: Task) -> None:
    """Fit extensions afresh, the best first, until one of them explains nearly everything."""
    floor = noise_rms(current.fit.residuals, current.screening.colour)
    excess = excess_power(current.fit.residuals, current.screening.colour, floor)
    count = AFRESH if number == 1 else AFRESH_FURTHER
    for k, extension in enumerate(current.extensions[:count]):
        best = max(current.extensions, key=lambda e: e.removed)
        if best.fit.rms < SETTLED * floor or (k > 0 and best.removed > MOST * excess):
            break
        task.progress(f"cause {number}: {extension.effect.name} afresh")
        current.extensions[k] = extend_afresh(
            current.fit, task.experiments, extension, current.screening.colour
        )


def settle_on(
    current: Round, extension: Extension, task: Task, first: Extension | None = None
) -> None:
    """Take an extension, found in another way, as a step's cause, and weigh the others against it.

    What could look like it is fitted as after a search. `first` is the first cause where this is a
    further one.
    """
    others = [e for e in current.extensions if e.effect is not extension.effect]
    current.extensions = [*others, extension]
    _sort(current)
    if task.method.imitators and current.extensions[0] is extension:
        number = 1 if first is None else 2
        _imitators(current, number, task)
        _polish(current, number, task)
    own = next(e for e in current.extensions if e.effect is extension.effect)
    ranked = _ranked(current, task, first)
    _weigh(current, ranked if own in ranked else [own, *ranked], task)
    current.chosen = own


def _ranked(current: Round, task: Task, first: Extension | None) -> list[Extension]:
    fit, predicted, colour = current.fit, current.predicted, current.screening.colour
    extensions, alarm = current.extensions, current.test.alarm
    least = current.test.knowable
    return choose(
        extensions, task.experiments, fit, predicted, colour, first, alarm=alarm, knowable=least
    )


def _weigh(current: Round, worth: Sequence[Extension], task: Task) -> None:
    """Give every effect its evidence and, unless a full fit showed it unfit, its probability.

    An effect that bends the same curve as one worth having is as good, whatever its own form.
    """
    fitted = {e.effect.name: e.evidence for e in current.extensions}
    good = {e.effect.name for e in worth}
    fit = {e.effect.name for e in current.extensions if not out_of_character(e, task.experiments)}
    alike = task.alike(current.fit)
    same = {n for group in alike if good & set(group) for n in group if n in fit}
    refused = set(fitted) - good - same
    current.evidence = levelled({**current.evidence, **fitted}, alike, good)
    if task.method.weights == "bic":
        current.probability = bic_probabilities(
            current.fit, {e.effect.name: e.fit for e in worth}, current.screening.colour
        )
        return
    current.probability = probabilities(
        {name: v for name, v in current.evidence.items() if name not in refused}
    )


def _sort(current: Round) -> None:
    current.extensions.sort(key=lambda e: -e.evidence)


def _polish(current: Round, number: int, task: Task) -> None:
    """Fit the best extensions to the end, where that is not done yet."""
    if not current.extensions:
        return
    best = current.extensions[0].evidence
    limit = min(RUNNER_UP * best, best - NEAR)
    leaders = current.extensions[:FINALISTS]
    _to_end(current, [e for e in leaders if e.evidence > limit and not e.final], number, task)


@stage("fits to the end")
def _to_end(current: Round, chosen: Sequence[Extension], number: int, task: Task) -> None:
    """Fit some of the extensions to the end, and sort all."""
    if chosen:
        names = ", ".join(e.effect.name for e in chosen)
        task.progress(f"cause {number}: {names} to the end")
    colour = current.screening.colour
    ended = side_by_side(lambda e: polish(current.fit, e, task.experiments, colour), chosen)
    rest = [e for e in current.extensions if e not in chosen]
    current.extensions = [*ended, *rest]
    _sort(current)


@stage("fits of imitators")
def _imitators(current: Round, number: int, task: Task) -> None:
    """Fit the effects that could stand in the best one's place, and keep those fits."""
    colour = current.screening.colour
    new = imitations(current.fit, current.extensions, current.trials, colour, task, number)
    for extension in new:
        fitted = {e.effect.name: e for e in current.extensions}
        own = fitted.get(extension.effect.name)
        if own is None:
            current.extensions.append(extension)
        elif extension.evidence > own.evidence:
            current.extensions[current.extensions.index(own)] = extension
    _sort(current)
