"""The next experiment: best for chosen parameters, or for separating effects."""

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from psa_casadi.common.display import with_units
from psa_casadi.common.errors import InputError, Problems, PsaError, quoted
from psa_casadi.common.notes import note
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
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
from psa_casadi.design.experiment.search import BRIEF, FINE, GRID, Effort, Make, Plan, search
from psa_casadi.diagnosis.result import StackDiagnosis
from psa_casadi.diagnosis.screening import temperature
from psa_casadi.diagnosis.search.state import one_of_each
from psa_casadi.diagnosis.task import FAST, LIMITS
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import Interval
from psa_casadi.records.excitation import sine, triangle
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Signals
from psa_casadi.simulation.start import is_stack

#: How often a record may be played until it names the cause, and the probability demanded.
PLAYS, CHANCE = (1, 2, 3, 5), 0.9


@dataclass(frozen=True)
class Pair:
    """Growth of ln of the Bayes factor of `truth` over `other` if `truth` is the cause.

    `designed` for the designed record, `usual` for a sine and a triangle of the same length and
    amplitude.
    """

    truth: str
    other: str
    designed: float
    usual: Mapping[str, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class Designed:
    """What all designed records have: inputs to play and no outputs, and the search for them.

    `kind` is the family of the inputs, `limits` are those of every one.
    """

    record: Signals
    kind: str
    limits: Mapping[str, Limits]
    rivals: tuple[Rival, ...]
    evaluations: int
    seconds: float


def columns_to_play(design: Designed) -> dict[str, FloatArray]:
    """Return time and inputs with their units, as `write_record` takes them."""
    record = design.record
    return with_units({"time": record.time, **record.columns}, {"time": "s", **record.units})


@dataclass(frozen=True, eq=False, kw_only=True)
class Separated(Designed):
    """A record that separates effects.

    Its `kind` is "sine" or "triangle" where no designed one was better; `chance` is for each
    effect the probability that a diagnosis of the data at hand with the record names it alone if it
    is the cause, as the rivals' fits predict it; `usual_chance` the same with sine and triangle.
    `plays` is how often the record must be played, each time from rest, until every chance is at
    least 90 %; None where `PLAYS[-1]` times are not enough.
    """

    pairs: tuple[Pair, ...]
    chance: Mapping[str, float]
    usual_chance: Mapping[str, Mapping[str, float]]
    plays: int | None

    def factor(self, usual: str) -> float:
        """Return the least ln of the Bayes factor over that with a usual voltage."""
        least = min(p.designed for p in self.pairs)
        return least / max(min(p.usual[usual] for p in self.pairs), 1e-12)


@dataclass(frozen=True, eq=False, kw_only=True)
class Informative(Designed):
    """A record that sharpens parameters.

    `intervals` are the predicted 95 % intervals with it (and the data at hand), `before` those
    without, each in the parameter's unit and within its bounds; `factor` is the ratio of the mean
    standard error of the criterion to that with a usual voltage of the same length and
    amplitude.
    """

    optimality: Optimality
    intervals: Mapping[str, tuple[float, float]]
    before: Mapping[str, tuple[float, float]]
    factor: Mapping[str, float]


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


def names_all(criterion: Separation, record: Signals) -> bool:
    """Whether a record names every rival almost certainly, even with less than its distances."""
    try:
        less = {pair: t / _MARGIN for pair, t in criterion.distances(record).items()}
        return min(chances_of(criterion, less, record).values()) > _CERTAIN
    except PsaError:  # a base that cannot follow: another voltage may be better
        return False


def plays_of(criterion: Separation, record: Signals, chance: Mapping[str, float]) -> int | None:
    """Return how often a record must be played to name the cause; None if `PLAYS[-1]` do not.

    k records of the same voltage are one whose noise has 1/k of the variance.
    """
    for plays in PLAYS:
        if plays > 1:
            quieter = [replace(c, level=c.level / np.sqrt(plays)) for c in criterion.noise]
            often = replace(criterion, noise=quieter)
            chance = chances_of(often, often.distances(record), record)
        if min(chance.values()) >= CHANCE:
            return plays
    return None


def chances_of(
    criterion: Separation, distances: Mapping[tuple[str, str], float], record: Signals
) -> dict[str, float]:
    """Return the probability of every rival that it is named if it is the cause.

    `distances` are those of the record.
    """
    chances, base = {}, criterion.base
    for truth in criterion.rivals:
        others = [r for r in criterion.rivals if r is not truth]
        over = 0.0 if base is None else criterion.distance(truth, base, record)
        chances[truth.name] = naming_probability(truth, others, distances, over)
    return chances


#: Periods of the usual sine and triangle that a design is compared with.
USUAL_PERIODS = 10
#: Ratio of the frequencies of two inputs: the golden one, of which no small multiples meet.
_APART = 1.618
#: Gain of an effect that no record determines, over its ordinary size.
ORDINARY = 2.5
#: Rivals that a record is designed for, at most: as many as a verdict lists.
_RIVALS = 5


def record_for(model: Model) -> Make:
    """Return what makes planned records of a model: `Record` of a stack, else `Signals`."""
    units = {i.name: i.unit for i in model.structure.inputs}

    def make(name: str, time: FloatArray, columns: Mapping[str, FloatArray]) -> Signals:
        if is_stack(model):
            return _of_stacks(name, time, columns)
        return Signals(name=name, time=time, columns=columns, units=units)

    return make


def _of_stacks(name: str, time: FloatArray, columns: Mapping[str, FloatArray]) -> Record:
    return Record(name=name, time=time, voltage=columns["voltage"])


def usual_records(limits: Limits, steepest: float) -> dict[str, Record]:
    """Return a sine and a triangle of the limits' length and range, slower if the rate asks."""
    waves = usual_inputs({"voltage": replace(limits, rate=steepest)})
    return {n: _of_stacks(n, limits.grid(), columns) for n, columns in waves.items()}


def usual_inputs(limits: Mapping[str, Limits]) -> dict[str, dict[str, FloatArray]]:
    """Return a sine and a triangle for every input, from its rest on, by the inputs' names.

    Those of a second input and further ones are slower, so that they can be separated.
    """
    table: dict[str, dict[str, FloatArray]] = {"sine": {}, "triangle": {}}
    for k, (name, item) in enumerate(limits.items()):
        time, first, share = item.grid(), rest_of(item), item.rest_share
        fastest = item.rate / (np.pi * item.span)
        frequency = min(USUAL_PERIODS / (item.duration - first), item.band, fastest) / _APART**k
        moving = time[time >= first] - first
        rest = np.full(len(time) - len(moving), item.low + share * item.span)
        for shape, wave, phase in (
            ("sine", sine, np.arccos(1.0 - 2.0 * share) / (2.0 * np.pi)),
            ("triangle", triangle, 0.5 * share),
        ):
            wound = wave(moving + phase / frequency, item.low, item.high, frequency)
            table[shape][name] = np.concatenate([rest, wound])
    return table


Limited = Limits | Mapping[str, Limits]
Noisy = SensorNoise | Sequence[SensorNoise]


def _plan(model: Model, limits: Limited, noise: Noisy) -> Plan:
    """Return the plan of a design; the current into a stack limits the rate of its voltage.

    Raises InputError where inputs and limits do not fit.
    """
    every = {"voltage": limits} if isinstance(limits, Limits) else limits
    problems = Problems()
    for name in every:
        if name not in model.input_names:
            problems.add(
                f"There are limits of '{name}', which is no input of '{model.name}'; it has"
                f" {quoted(model.input_names)}."
            )
    lengths = {(item.duration, item.samples) for item in every.values()}
    if len(lengths) != 1:
        problems.add("Give limits of an input or more, all with one duration and one `samples`.")
    problems.raise_if_any()
    capacitance = model.values.get("C_p") if is_stack(model) else None
    steep = {n: replace(item, rate=item.steepest(capacitance)) for n, item in every.items()}
    make, waves = record_for(model), usual_inputs(steep)
    time = next(iter(every.values())).grid()
    usual = {n: make(n, time, columns) for n, columns in waves.items()}
    return Plan(steep, (noise,) if isinstance(noise, SensorNoise) else (*noise,), make, usual)


def separating_experiment(
    rivals: Sequence[Rival],
    noise: Noisy,
    limits: Limited,
    *,
    base: Rival | None = None,
    kinds: Sequence[Kind] = KINDS,
    effort: Effort | None = None,
    progress: Progress = silent,
) -> Separated:
    """Return the inputs that best separate rivals, each fitted again to the others.

    `limits` are those of every input by name (a stack's voltage may stand alone), `noise` is that
    of every output in the rivals' order; `base` is the model without any of them, which scales the
    evidence that a diagnosis asks for. Raises SimulationError, and InputError also where all rivals
    bend the same curve and the record is too slow to show a resonance.
    """
    begin = clock.perf_counter()
    plan = _plan(rivals[0].model, limits, noise)
    curves = {c.curve for r in rivals for c in r.model.components if c.name == r.name}
    if _slow(plan.whole) and len(rivals) > 1 and len(curves) == 1 and None not in curves:
        raise InputError(str(note("same_curve", effects=tuple(r.name for r in rivals))))
    coarser = Separation(tuple(rivals), plan.colours(GRID), base)
    usual = plan.usual
    best = search(
        coarser, plan, kinds=kinds, effort=effort, progress=progress,
        enough=lambda record: names_all(coarser, record),
    )  # fmt: skip
    progress("comparing with a sine and a triangle")
    criterion = replace(coarser, noise=plan.colours(FINE))
    records = {n: plan.coarse(r) for n, r in {"designed": best.record, **usual}.items()}
    distances = {n: criterion.distances(r) for n, r in records.items()}
    chosen = max(distances, key=lambda n: overall(distances[n].values()))
    if chosen != "designed":
        records["designed"], distances["designed"] = records[chosen], distances[chosen]
    chances = {n: chances_of(criterion, distances[n], r) for n, r in records.items()}
    return Separated(
        record=usual.get(chosen, best.record),
        kind=chosen if chosen in usual else best.kind,
        limits=plan.limits,
        rivals=tuple(rivals),
        pairs=tuple(
            Pair(a, b, 0.5 * t, {n: 0.5 * distances[n][a, b] for n in usual})
            for (a, b), t in distances["designed"].items()
        ),
        chance=chances["designed"],
        usual_chance={n: chances[n] for n in usual},
        plays=plays_of(criterion, records["designed"], chances["designed"]),
        evaluations=best.evaluations,
        seconds=clock.perf_counter() - begin,
    )


def informative_experiment(
    rival: Rival,
    noise: Noisy,
    limits: Limited,
    *,
    names: Sequence[str] = (),
    optimality: Optimality = "D",
    kinds: Sequence[Kind] = KINDS,
    effort: Effort | None = None,
    progress: Progress = silent,
) -> Informative:
    """Return the inputs that best determine the named parameters, all free ones by default.

    `limits` and `noise` are those of `separating_experiment`.

    Raises InputError and SimulationError.
    """
    begin = clock.perf_counter()
    plan = _plan(rival.model, limits, noise)
    wanted = tuple(names) or rival.unknowns.names
    criterion = Information(rival, wanted, optimality, plan.colours(GRID))
    best = search(criterion, plan, kinds=kinds, effort=effort, progress=progress)
    progress("comparing with a sine and a triangle")
    criterion = replace(criterion, noise=plan.colours(FINE))
    designed = plan.coarse(best.record)
    value = criterion.at(designed).value
    usual = {n: criterion.at(plan.coarse(r)).value for n, r in plan.usual.items()}
    return Informative(
        record=best.record,
        kind=best.kind,
        limits=plan.limits,
        rivals=(rival,),
        optimality=optimality,
        intervals=_intervals(rival, criterion.standard_errors(designed)),
        before=_intervals(rival, criterion.standard_errors(None)),
        factor={n: float(np.exp(value - v)) for n, v in usual.items()},
        evaluations=best.evaluations,
        seconds=clock.perf_counter() - begin,
    )


def resolving_experiment(
    d: StackDiagnosis,
    *,
    limits: Limits | None = None,
    effort: Effort | None = None,
    progress: Progress = silent,
) -> Separated:
    """Return the record that shows which of an ambiguous diagnosis' effects is the cause.

    It has the voltages and the length of the records diagnosed unless `limits` say otherwise; the
    search is brief by default. Of effects that bend the same curve one represents all, of many
    rivals the most likely ones count: each adds a simulation to every trial.
    Raises InputError where the diagnosis is not ambiguous, or between such effects only.
    """
    if d.verdict != "ambiguous" or len(d.contenders) < 2:
        raise InputError(
            f"The verdict is {d.verdict} with {len(d.contenders)} fitted rivals, so there is"
            " nothing to separate; name the effects with --separate instead."
        )
    contenders, _ = one_of_each(d.contenders)
    if len(contenders) < 2 or (limits is not None and not _slow(limits)):
        contenders = d.contenders  # a new record that shows resonances may separate them
    contenders = tuple(sorted(contenders, key=lambda c: -c.evidence)[:_RIVALS])
    noise, colours = noise_of_fit(min(d.contenders, key=lambda c: c.fit.rms).fit)
    rivals = [rival_of_fit(c.effect, c.fit, colours, c.evidence) for c in contenders]
    base, effort = rival_of_fit("base", d.base_fit, colours), effort or BRIEF
    chosen = limits or limits_of([e.record for e in d.experiments])
    return separating_experiment(rivals, noise, chosen, base=base, effort=effort, progress=progress)


def rival_of_effect(model: Model, effect: Component, free: Sequence[str], **words: Any) -> Rival:
    """Return a model with an effect as a rival: at the gain it has, else at an ordinary one.

    `free` are the base's parameters that a fit would search, `words` other fields of a rival.
    """
    extended = model.with_effect(effect)
    gain = extended.parameter(effect.gain or "")
    if extended.values[gain.name] == 0.0:
        size = ORDINARY * gain.typical(extended.values)
        extended = extended.with_values({gain.name: float(np.clip(size, *gain.bounds))})
    extra = [n for n in effect.fitted if n not in free]
    return rival_of_model(effect.name, extended, [*free, *extra], **words)


def _slow(limits: Limits) -> bool:
    return limits.duration >= FAST * limits.samples


def _intervals(rival: Rival, errors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Return 95 % intervals as those of a fit, of which nothing lies outside the bounds."""
    intervals = {}
    for name, error in errors.items():
        value, p = rival.model.values[name], rival.model.parameter(name)
        low, high = Interval.of(p, value, error)
        intervals[name] = max(low, min(p.bounds[0], value)), min(high, max(p.bounds[1], value))
    return intervals
