"""The next experiment: best for chosen parameters, or for telling effects apart."""

import time as clock
from collections.abc import Mapping, Sequence

import numpy as np

from psa_casadi.component import Component
from psa_casadi.design.experiment.chances import chances_of, plays_of, tells
from psa_casadi.design.experiment.criteria import (
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
from psa_casadi.design.experiment.designs import Informative, Pair, Separated
from psa_casadi.design.experiment.limits import KINDS, Kind, Limits, limits_of, rest_of
from psa_casadi.design.experiment.search import BRIEF, GRID, Best, Effort, Progress, coarse, search
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.diagnosis.search.contenders import one_of_each, same_curve_note
from psa_casadi.diagnosis.task import FAST
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.records.excitation import sine, triangle
from psa_casadi.records.record import Record

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
    _check_curves(rivals, limits)
    steepest = limits.steepest(_capacitance(rivals[0].model))
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
        pairs=_pairs(found),
        chance=chances["designed"],
        usual_chance={n: c for n, c in chances.items() if n != "designed"},
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
    steepest = limits.steepest(_capacitance(rival.model))
    samples = min(limits.samples, GRID)
    wanted = tuple(names) or rival.unknowns.names
    criterion = Information(rival, wanted, optimality, noise.on_grid(limits, samples))
    plain = usual_records(limits, steepest)
    best: Best = search(
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


def _check_curves(rivals: Sequence[Rival], limits: Limits) -> None:
    curves = {c.curve for r in rivals for c in r.model.components if c.name == r.name}
    if _slow(limits) and len(rivals) > 1 and len(curves) == 1 and None not in curves:
        raise InputError(same_curve_note([r.name for r in rivals]))


def _pairs(found: Mapping[str, Mapping[tuple[str, str], float]]) -> tuple[Pair, ...]:
    """Return the growth of ln B, T/2, of every pair with the designed and the usual voltages."""
    return tuple(
        Pair(a, b, 0.5 * t, {n: 0.5 * f[a, b] for n, f in found.items() if n != "designed"})
        for (a, b), t in found["designed"].items()
    )


def _intervals(rival: Rival, errors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    values = rival.model.values
    return {n: (values[n] - _SURE * e, values[n] + _SURE * e) for n, e in errors.items()}


def _capacitance(model: Model) -> float | None:
    return model.values.get("C_p")
