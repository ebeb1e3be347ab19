"""The next experiment: best for chosen parameters, or for telling effects apart."""

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from psa_casadi.component import Component
from psa_casadi.design.experiment.criteria import (
    LEAST,
    Information,
    Optimality,
    Rival,
    SensorNoise,
    Separation,
    noise_of_fit,
    overall,
    rival_of_fit,
    rival_of_model,
)
from psa_casadi.design.experiment.limits import KINDS, Kind, Limits, limits_of, rest_of
from psa_casadi.design.experiment.search import BRIEF, GRID, Effort, Progress, coarse, search
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.diagnosis.screening import temperature
from psa_casadi.diagnosis.search.steps import one_of_each
from psa_casadi.diagnosis.task import FAST, LIMITS
from psa_casadi.errors import InputError, PsaError
from psa_casadi.model.compose import Model
from psa_casadi.notes import note
from psa_casadi.records.excitation import sine, triangle
from psa_casadi.records.record import Record

#: How often a record may be played until it tells, and the probability that is asked for.
PLAYS, ASKED = (1, 2, 3, 5), 0.9


@dataclass(frozen=True)
class Pair:
    """How surely a record would tell: growth of ln of the Bayes factor if `truth` is the cause.

    `designed` for the designed record, `usual` for a sine and a triangle of the same length and
    amplitude.
    """

    truth: str
    other: str
    designed: float
    usual: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Separated:
    """A record that tells effects apart.

    `record` is the voltage to play (no displacement), of the family `kind` ("sine" or "triangle"
    where no designed one was better); `chance` is for each
    effect the probability that a diagnosis of the data at hand with the record names it alone if it
    is the cause, as the rivals' fits predict it; `usual_chance` the same with sine and triangle.
    `plays` is how often the record must be played, each time from rest, until every chance is at
    least 90 %; None where `PLAYS[-1]` times are not enough.
    """

    record: Record
    kind: str
    limits: Limits
    pairs: tuple[Pair, ...]
    chance: Mapping[str, float]
    usual_chance: Mapping[str, Mapping[str, float]]
    plays: int | None
    evaluations: int
    seconds: float

    @property
    def names(self) -> tuple[str, ...]:
        """The effects to tell apart."""
        return tuple(self.chance)

    def factor(self, usual: str) -> float:
        """Return the least ln of the Bayes factor over that with a usual voltage."""
        least = min(p.designed for p in self.pairs)
        return least / max(min(p.usual[usual] for p in self.pairs), 1e-12)


@dataclass(frozen=True, eq=False)
class Informative:
    """A record that sharpens parameters.

    `intervals` are the predicted 95 % intervals with it (and the data at hand), `before` those
    without, each in the parameter's unit; `factor` says by how much the mean standard error of the
    criterion is smaller than with a usual voltage of the same length and amplitude.
    """

    record: Record
    kind: str
    limits: Limits
    optimality: Optimality
    intervals: Mapping[str, tuple[float, float]]
    before: Mapping[str, tuple[float, float]]
    factor: Mapping[str, float]
    evaluations: int
    seconds: float


#: Chance to be named from which on no better voltage is looked for, at distances this many times
#: smaller: rivals are not the true equations.
_CERTAIN, _MARGIN = 0.999, 10.0


def naming_probability(
    truth: Rival, others: Sequence[Rival], distances: Mapping[tuple[str, str], float], over: float
) -> float:
    """Return the probability that a diagnosis names `truth` if it is the cause.

    Against each other rival ln B is normal with mean (what the data at hand say) + T/2 and
    variance T; to be named alone it must exceed temperature * ln(c/(1 - c)), c = 0.95, where the
    temperature grows with the evidence over the base, of which the new record adds `over`/2.
    """
    credible = LIMITS.credible
    needed = temperature(truth.evidence + 0.5 * over) * float(np.log(credible / (1.0 - credible)))
    chances = []
    for other in others:
        t = distances[truth.name, other.name]
        gained = truth.evidence - other.evidence + 0.5 * t - needed
        chances.append(float(scipy.special.ndtr(gained / np.sqrt(max(t, LEAST)))))
    return min(chances, default=1.0)


def tells(criterion: Separation, base: Rival | None, record: Record) -> bool:
    """Whether a record names every rival for sure, even with a fraction of its distances."""
    try:
        less = {pair: t / _MARGIN for pair, t in criterion.distances(record).items()}
        return min(chances_of(criterion, less, base, record).values()) > _CERTAIN
    except PsaError:  # a base that cannot follow: another voltage may be better
        return False


def plays_of(
    criterion: Separation, base: Rival | None, record: Record, chance: Mapping[str, float]
) -> int | None:
    """Return how often a record must be played until it tells; None if `PLAYS[-1]` do not.

    k records of the same voltage are one whose noise has 1/k of the variance.
    """
    for plays in PLAYS:
        if plays > 1:
            colour = replace(criterion.noise, level=criterion.noise.level / np.sqrt(plays))
            often = replace(criterion, noise=colour)
            chance = chances_of(often, often.distances(record), base, record)
        if min(chance.values()) >= ASKED:
            return plays
    return None


def chances_of(
    criterion: Separation,
    distances: Mapping[tuple[str, str], float],
    base: Rival | None,
    record: Record,
) -> dict[str, float]:
    """Return the probability of every rival that it is named if it is the cause.

    `distances` are those of the record; `base` is the model without any of the rivals.
    """
    chances = {}
    for truth in criterion.rivals:
        others = [r for r in criterion.rivals if r is not truth]
        over = 0.0 if base is None else criterion.distance(truth, base, record)
        chances[truth.name] = naming_probability(truth, others, distances, over)
    return chances


#: Periods of the usual sine and triangle that a design is compared with.
USUAL_PERIODS = 10
#: Gain of an effect that no record tells, over its ordinary size.
ORDINARY = 2.5
#: Samples of the grid on which the result is judged, at most.
_FINE = 2000
_SURE = 1.959964
#: Rivals that a record is designed for, at most: as many as a verdict tells.
_RIVALS = 5


def usual_records(limits: Limits, steepest: float) -> dict[str, Record]:
    """Return a sine and a triangle of the limits' length and range, slower if the rate asks."""
    time, first = limits.grid(), rest_of(limits)
    room = limits.duration - first
    fastest = steepest / (np.pi * limits.span)
    frequency = min(USUAL_PERIODS / room, limits.band, fastest)
    moving = time[time >= first] - first
    shapes = {
        "sine": sine(moving, limits.low, limits.high, frequency),
        "triangle": triangle(moving, limits.low, limits.high, frequency),
    }
    rest = np.full(len(time) - len(moving), limits.low)
    return {
        n: Record(name=n, time=time, voltage=np.concatenate([rest, v])) for n, v in shapes.items()
    }


def separating_experiment(
    rivals: Sequence[Rival],
    noise: SensorNoise,
    limits: Limits,
    *,
    base: Rival | None = None,
    kinds: Sequence[Kind] = KINDS,
    effort: Effort | None = None,
    progress: Progress = lambda _: None,
) -> Separated:
    """Return the voltage that best separates rivals, each fitted again to the others.

    `base` is the model without any of them, which scales the evidence that a diagnosis asks for.
    Raises SimulationError, and InputError also where all rivals bend the same curve and the record
    is too slow to show a resonance.
    """
    begin = clock.perf_counter()
    curves = {c.curve for r in rivals for c in r.model.components if c.name == r.name}
    if _slow(limits) and len(rivals) > 1 and len(curves) == 1 and None not in curves:
        raise InputError(str(note("same_curve", effects=tuple(r.name for r in rivals))))
    steepest = limits.steepest(rivals[0].model.values.get("C_p"))
    samples = min(limits.samples, GRID)
    coarser = Separation(tuple(rivals), noise.on_grid(limits, samples))
    usual = usual_records(limits, steepest)
    best = search(
        coarser, limits, steepest, usual=tuple(usual.values()), kinds=kinds, effort=effort,
        enough=lambda record: tells(coarser, base, record), progress=progress,
    )  # fmt: skip
    progress("comparing with a sine and a triangle")
    samples = min(limits.samples, _FINE)
    criterion = Separation(tuple(rivals), noise.on_grid(limits, samples))
    records = {n: coarse(r, samples) for n, r in {"designed": best.record, **usual}.items()}
    found = {n: criterion.distances(r) for n, r in records.items()}
    chosen = max(found, key=lambda n: overall(found[n].values()))
    if chosen != "designed":
        records["designed"], found["designed"] = records[chosen], found[chosen]
    chances = {n: chances_of(criterion, found[n], base, r) for n, r in records.items()}
    return Separated(
        record=usual.get(chosen, best.record),
        kind=chosen if chosen in usual else best.kind,
        limits=limits,
        pairs=tuple(
            Pair(a, b, 0.5 * t, {n: 0.5 * found[n][a, b] for n in usual})
            for (a, b), t in found["designed"].items()
        ),
        chance=chances["designed"],
        usual_chance={n: chances[n] for n in usual},
        plays=plays_of(criterion, base, records["designed"], chances["designed"]),
        evaluations=best.evaluations,
        seconds=clock.perf_counter() - begin,
    )


def informative_experiment(
    rival: Rival,
    noise: SensorNoise,
    limits: Limits,
    *,
    names: Sequence[str] = (),
    optimality: Optimality = "D",
    kinds: Sequence[Kind] = KINDS,
    effort: Effort | None = None,
    progress: Progress = lambda _: None,
) -> Informative:
    """Return the voltage that best determines the named parameters, all free ones by default.

    Raises InputError and SimulationError.
    """
    begin = clock.perf_counter()
    steepest = limits.steepest(rival.model.values.get("C_p"))
    samples = min(limits.samples, GRID)
    wanted = tuple(names) or rival.unknowns.names
    criterion = Information(rival, wanted, optimality, noise.on_grid(limits, samples))
    plain = usual_records(limits, steepest)
    best = search(
        criterion, limits, steepest,
        usual=tuple(plain.values()), kinds=kinds, effort=effort, progress=progress,
    )  # fmt: skip
    progress("comparing with a sine and a triangle")
    samples = min(limits.samples, _FINE)
    criterion = Information(rival, wanted, optimality, noise.on_grid(limits, samples))
    designed = coarse(best.record, samples)
    value = criterion.at(designed).value
    usual = {
        n: float(np.exp(value - criterion.at(coarse(r, samples)).value)) for n, r in plain.items()
    }
    return Informative(
        record=best.record,
        kind=best.kind,
        limits=limits,
        optimality=optimality,
        intervals=_intervals(rival, criterion.standard_errors(designed)),
        before=_intervals(rival, criterion.standard_errors(None)),
        factor=usual,
        evaluations=best.evaluations,
        seconds=clock.perf_counter() - begin,
    )


def resolving_experiment(
    d: Diagnosis,
    *,
    limits: Limits | None = None,
    effort: Effort | None = None,
    progress: Progress = lambda _: None,
) -> Separated:
    """Return the record that would tell which of an ambiguous diagnosis' effects is the cause.

    It has the voltages and the length of the records diagnosed unless `limits` say otherwise; the
    search is brief by default. Of effects that bend the same curve one stands for all, of many
    rivals the most likely ones count: each adds a simulation to every trial.
    Raises InputError where the diagnosis is not ambiguous, or between such effects only.
    """
    if d.verdict != "ambiguous" or len(d.contenders) < 2:
        raise InputError(
            f"The verdict is {d.verdict} with {len(d.contenders)} fitted rivals, so there is"
            " nothing to tell apart; name the effects with --separate instead."
        )
    told, _ = one_of_each(d.contenders, d.experiments)
    if len(told) < 2 or (limits is not None and not _slow(limits)):
        told = d.contenders  # a new record that shows resonances may tell
    told = tuple(sorted(told, key=lambda c: -c.evidence)[:_RIVALS])
    best = min(d.contenders, key=lambda c: c.fit.rms).fit
    noise, colour = noise_of_fit(best, d.experiments)
    rivals = [rival_of_fit(c.effect, c.fit, colour, c.evidence) for c in told]
    base = rival_of_fit("base", d.base_fit, colour)
    chosen = limits or limits_of([e.record for e in d.experiments])
    return separating_experiment(
        rivals, noise, chosen, base=base, effort=effort or BRIEF, progress=progress
    )


def rival_of_effect(model: Model, effect: Component, free: Sequence[str]) -> Rival:
    """Return a model with an effect as a rival: at the gain it has, else at an ordinary one.

    `free` are the base's parameters that a fit would search.
    """
    extended = model.with_effect(effect)
    gain = extended.parameter(effect.gain or "")
    if extended.values[gain.name] == 0.0:
        size = ORDINARY * gain.typical(extended.values)
        extended = extended.with_values({gain.name: float(np.clip(size, *gain.bounds))})
    own = [n for n in effect.fitted if n not in free]
    return rival_of_model(effect.name, extended, [*free, *own])


def _slow(limits: Limits) -> bool:
    return limits.duration >= FAST * limits.samples


def _intervals(rival: Rival, errors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    values = rival.model.values
    return {n: (values[n] - _SURE * e, values[n] + _SURE * e) for n, e in errors.items()}
