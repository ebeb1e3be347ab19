"""Diagnose: fit the base, screen the effects, fit the leading ones, choose, repeat, judge."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.errors_of import held_out_rms
from psa_casadi.diagnosis.omnibus import Omnibus, omnibus
from psa_casadi.diagnosis.probes import directions
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.diagnosis.screening import Screening, screen
from psa_casadi.diagnosis.selection import (
    FURTHER,
    NOTICEABLE,
    Extension,
    choose,
    extend,
    extend_afresh,
    leading,
    polish,
)
from psa_casadi.diagnosis.verdict import conclude
from psa_casadi.effects import EFFECTS
from psa_casadi.experiment.record import Record
from psa_casadi.experiment.split import Experiment, split, whole
from psa_casadi.experiment.suspects import cleaned
from psa_casadi.identification.fit import Fit
from psa_casadi.identification.noise import correlation_inflation, high_frequency_noise
from psa_casadi.identification.refitting import Progress, refit
from psa_casadi.identification.search import fit_base
from psa_casadi.identification.starting import starting_model
from psa_casadi.model.compose import Model

FloatArray = npt.NDArray[np.float64]

#: Most causes that are named for one set of records.
MOST_CAUSES = 3
#: An extension whose residual is within this factor of the noise needs no further starts.
SETTLED = 1.05
#: How many extensions are fitted to the end, if their evidence is this share of the best one's.
FINALISTS, RUNNER_UP = 2, 0.8
#: Share of the residual's power above the noise from which a further cause is looked for.
REMAINDER = 0.35
#: A base fit retried from the extension's parameters counts if its rms falls to this share.
BETTER_BASE = 0.95


@dataclass(eq=False)
class Round:
    """One step of the search: the model so far, its screening and test, the extensions tried."""

    fit: Fit
    predicted: tuple[FloatArray, ...]
    screening: Screening
    test: Omnibus
    extensions: list[Extension] = field(default_factory=list)
    chosen: Extension | None = None
    rivals: list[Extension] = field(default_factory=list)


def diagnose(
    records: Sequence[Record],
    *,
    holdout: Sequence[Record] = (),
    model: Model | None = None,
    stiffness: float | None = None,
    effects: Sequence[Component] | None = None,
    progress: Progress = lambda _: None,
) -> Diagnosis:
    """Find what the base model gets wrong on the records, name the cause, measure the gain.

    Held-out data are the records `holdout`, else a quarter of every record in blocks (see
    `split`); they choose nothing but whether an extension may stay. `model` is where the base fit
    starts; `stiffness` [N/m] fixes the force scale; `effects` is the table to search. Raises
    InputError.
    """
    table = list(effects if effects is not None else EFFECTS.values())
    experiments = _experiments([cleaned(r) for r in records], [cleaned(r) for r in holdout])
    start = (model or starting_model(records, stiffness)).without(
        c.name for c in table if c.gain is not None
    )
    there = {c.name for c in start.components}
    table = [effect for effect in table if set(effect.needs) <= there]
    base = fit_base(start, experiments, progress=progress)
    rounds = _search(base, experiments, table, progress)
    progress("judging")
    return conclude(rounds, experiments, table, stiffness is not None)


def _experiments(records: Sequence[Record], holdout: Sequence[Record]) -> tuple[Experiment, ...]:
    if not holdout:
        return tuple(split(r) for r in records)
    held = []
    for record in holdout:
        # the first tenth of a held-out record only serves to find its offset and memory
        lead = np.arange(record.n) < max(8, record.n // 10)
        held.append(Experiment(record, record.mask & lead, record.mask & ~lead))
    return (*(whole(r) for r in records), *held)


def _search(
    base: Fit, experiments: Sequence[Experiment], table: Sequence[Component], progress: Progress
) -> list[Round]:
    """Forward selection: add the best effect until the rest is noise or nothing helps."""
    rounds = [_examine(base, tuple(base.predicted(experiments)), experiments, table, progress)]
    retried = False
    while len(rounds) <= MOST_CAUSES and _worth_searching(rounds):
        current = rounds[-1]
        _extend(current, len(rounds), experiments, progress)
        if current.chosen is None:
            break
        if len(rounds) == 1 and not retried:
            retried = True
            better = _retry_base(current, experiments, progress)
            if better is not None:
                predicted = tuple(better.predicted(experiments))
                rounds = [_examine(better, predicted, experiments, table, progress)]
                continue
        left = [c for c in table if c not in current.chosen.fit.model.components]
        rounds.append(
            _examine(current.chosen.fit, current.chosen.predicted, experiments, left, progress)
        )
    return _settle(rounds, experiments, progress)


def _settle(
    rounds: list[Round], experiments: Sequence[Experiment], progress: Progress
) -> list[Round]:
    """Where two causes or more leave structure, fit all their parameters together once more."""
    last = rounds[-1]
    if len(rounds) < 3 or not last.test.alarm:
        return rounds
    progress("all causes together, to the end")
    again = refit(last.fit, experiments, last.fit.unknowns.names)
    predicted = tuple(again.predicted(experiments))
    before = held_out_rms(experiments, last.predicted)
    if held_out_rms(experiments, predicted) < before:
        rounds[-1] = replace(last, fit=again, predicted=predicted)
    return rounds


def _worth_searching(rounds: Sequence[Round]) -> bool:
    """A direction above the threshold; after a first cause also a remainder beyond the noise."""
    current = rounds[-1]
    best = max((s.decrease for s in current.screening.scores), default=0.0)
    if best < current.screening.threshold:
        return False
    return len(rounds) == 1 or (current.test.alarm and current.test.excess > REMAINDER)


def _extend(
    current: Round, number: int, experiments: Sequence[Experiment], progress: Progress
) -> None:
    """Fit the leading effects, the best ones to the end, and choose among them."""
    inflation = correlation_inflation(current.fit.residuals) if number > 1 else 1.0
    floor = high_frequency_noise(current.fit.residuals)
    for name, scores in leading(current.screening):
        progress(f"cause {number}: fitting {name}")
        extension = extend(current.fit, experiments, scores, inflation)
        if extension is not None:
            current.extensions.append(extension)
    current.extensions.sort(key=lambda e: -e.evidence)
    lost = [k for k, e in enumerate(current.extensions) if k == 0 or e.evidence < 0]
    for k in lost if current.extensions and current.extensions[0].fit.rms > SETTLED * floor else ():
        progress(f"cause {number}: {current.extensions[k].effect.name} afresh")
        again = extend_afresh(current.fit, experiments, current.extensions[k], inflation)
        current.extensions[k] = again
    current.extensions.sort(key=lambda e: -e.evidence)
    for k, extension in enumerate(current.extensions[:FINALISTS]):
        if extension.evidence > RUNNER_UP * current.extensions[0].evidence:
            progress(f"cause {number}: {extension.effect.name} to the end")
            current.extensions[k] = polish(current.fit, extension, experiments, inflation)
    before = held_out_rms(experiments, current.predicted)
    ranked = choose(
        current.extensions,
        experiments,
        current.fit,
        before,
        floor,
        NOTICEABLE if number == 1 else FURTHER,
    )
    if ranked:
        current.chosen, current.rivals = ranked[0], ranked[1:]


def _examine(
    fit: Fit,
    predicted: tuple[FloatArray, ...],
    experiments: Sequence[Experiment],
    table: Sequence[Component],
    progress: Progress,
) -> Round:
    progress("screening effects")
    lengths = [int(e.used.sum()) for e in experiments]
    screening = screen(fit, directions(fit, experiments, table), lengths)
    voltage = np.concatenate([e.record.voltage[e.used] for e in experiments])
    time = np.concatenate([e.record.time[e.used] for e in experiments])
    floor = high_frequency_noise(fit.residuals)
    test = omnibus(fit.residuals, voltage, time, screening.colour, floor)
    return Round(fit, predicted, screening, test)


def _retry_base(first: Round, experiments: Sequence[Experiment], progress: Progress) -> Fit | None:
    """Fit the base once more from the best extension's parameters; return it if clearly better."""
    if first.chosen is None:
        return None
    progress("base fit, from the extension's parameters")
    names = first.fit.unknowns.names
    values = {n: first.chosen.fit.model.values[n] for n in names}
    moved = replace(first.fit, model=first.fit.model.with_values(values))
    again = refit(moved, experiments, names)
    return again if again.rms < BETTER_BASE * first.fit.rms else None
