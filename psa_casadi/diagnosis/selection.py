"""Full fits of the leading effects, and the choice among them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.errors_of import held_out_rms
from psa_casadi.diagnosis.evidence import evidence
from psa_casadi.diagnosis.screening import Copy, Score, Screening
from psa_casadi.errors import PsaError
from psa_casadi.experiment.drive import among_harmonics
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.search import FIXED
from psa_casadi.identification.starting import ordinary_values

FloatArray = npt.NDArray[np.float64]

#: How many effects are fitted fully in each round, and how many starts each gets.
FULL_FITS = 4
_STARTS = 2
#: An effect whose screening score is below this share of the best one is not worth a full fit.
_WORTH = 0.1
_QUICK, _COPY, _AFRESH = 8, 12, 25
#: Tolerance of the stepper in quick fits, then of stepper and fit, and evaluations, to the end.
_QUICK_RTOL = 1e-4
_POLISHING = ((1e-5, 1e-3, 30), (FIT_RTOL, 1e-4, 8))
#: Evidence (in units of the log-likelihood) within which the better held-out prediction leads.
MARGIN = 3.0
#: Share of the excess power that an effect must remove to be added.
WORTHWHILE = 0.25
#: Gain in log-likelihood of the held-out samples that a first and a further effect must bring.
HELD_OUT, HELD_OUT_FURTHER = 1.0, 4.0
#: A further effect must remove this share of what the first one did: less may be the first one's
#: form, which is not the true one.
OF_FIRST = 0.05


@dataclass(frozen=True, eq=False)
class Extension:
    """One more effect, fitted: its fit, evidence over the model before, held-out rms [m].

    `removed` is the power that it takes from the residual [m^2]; `final` says that the fit went on
    to its end.
    """

    effect: Component
    fit: Fit
    evidence: float
    holdout_rms: float
    predicted: tuple[FloatArray, ...]
    removed: float
    final: bool = False


def leading(screening: Screening) -> list[tuple[str, list[Score]]]:
    """Return the effects worth a full fit with their best starts, best first."""
    best = screening.best_by_effect()
    if not best:
        return []
    top = next(iter(best.values())).decrease
    limit = max(screening.threshold, _WORTH * top)
    chosen = [name for name, score in best.items() if score.decrease >= limit][:FULL_FITS]
    return [(name, starts_of(screening, name)) for name in chosen]


def starts_of(screening: Screening, name: str) -> list[Score]:
    """Return the best directions of one effect, from which its fits start."""
    own = [s for s in screening.scores if s.direction.effect.name == name]
    starts: list[Score] = []
    for score in own:
        known = [s.direction.values for s in starts]
        new = score.direction.values not in known or score.direction.finite
        if new and len(starts) < _STARTS and score.decrease >= 0.3 * own[0].decrease:
            starts.append(score)
    return starts


_Start = tuple[dict[str, float], float, tuple[dict[str, float], ...]]


def extend(
    before: Fit, experiments: Sequence[Experiment], scores: Sequence[Score], colour: Colour
) -> Extension | None:
    """Fit quickly with one more effect from its best directions; None if every fit fails."""
    starts = [(s.direction.values, s.start, s.direction.memory) for s in scores]
    quick = _quick(before, experiments, scores[0].direction.effect, starts, {})
    return (
        None
        if quick is None
        else _extension(before, quick, scores[0].direction.effect, experiments, colour)
    )


def extend_like(
    before: Fit,
    best: Extension,
    experiments: Sequence[Experiment],
    copy: Copy,
    screening: Screening,
) -> Extension | None:
    """Fit an effect from where the best one has led the base, with the gain that copies that one.

    The base without either is bent to imitate them; beside the best one it is nearly right.
    """
    effect, direction = copy.direction.effect, copy.direction
    values = best.fit.model.values
    base = {n: values[n] for n in before.unknowns.names}
    usable = copy.gain > 0 or not direction.one_sided
    start = (direction.values, copy.gain if usable else direction.unit_gain, direction.memory)
    quick = _quick(before, experiments, effect, [start], base, _COPY)
    if quick is None:
        return None
    return _extension(before, quick, effect, experiments, screening.colour)


def extend_afresh(
    before: Fit, experiments: Sequence[Experiment], first: Extension, colour: Colour
) -> Extension:
    """Fit an effect again from an ordinary base and both signs of its gain; return the better.

    A base fit without the effect has bent its loop and its lags to imitate it, and may hold the
    search there.
    """
    effect = first.effect
    gain = next(p for p in effect.parameters if p.name == effect.gain)
    size = 2.5 * gain.typical(before.model.with_effect(effect, {gain.name: 0.0}).values)
    values = {
        n: first.fit.model.values[n] if isinstance(grid, str) else _declared(effect, n)
        for n, grid in effect.probe.items()
    }
    memory = tuple(before.starts())
    starts = [
        (values, sign * size, memory) for sign in (1.0, -1.0) if sign > 0 or gain.bounds[0] < 0
    ]
    ordinary = ordinary_values(before.model, [e.record for e in experiments])
    quick = _quick(before, experiments, effect, starts, ordinary, _AFRESH)
    if quick is None or quick.cost >= first.fit.cost:
        return first
    return _extension(before, quick, effect, experiments, colour)


def polish(
    before: Fit, extension: Extension, experiments: Sequence[Experiment], colour: Colour
) -> Extension:
    """Continue an extension's fit until it converges, loosely first, then at full tolerance."""
    current = extension.fit
    for rtol, tolerance, evaluations in _POLISHING:
        try:
            current = fit(
                current.model,
                experiments,
                current.unknowns.names,
                sigma=before.sigma,
                start_states=current.starts(),
                evaluations=evaluations,
                tolerance=tolerance,
                rtol=rtol,
            )
        except PsaError:
            return extension
    return _extension(before, current, extension.effect, experiments, colour, final=True)


def _declared(effect: Component, name: str) -> float:
    return next(p.value for p in effect.parameters if p.name == name)


def _extension(
    before: Fit,
    found: Fit,
    effect: Component,
    experiments: Sequence[Experiment],
    colour: Colour,
    *,
    final: bool = False,
) -> Extension:
    predicted = tuple(found.predicted(experiments))
    return Extension(
        effect=effect,
        fit=found,
        evidence=evidence(before, found, colour),
        holdout_rms=held_out_rms(experiments, predicted),
        predicted=predicted,
        removed=before.rms**2 - found.rms**2,
        final=final,
    )


def _quick(
    before: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    starts: Sequence[_Start],
    reset: dict[str, float],
    evaluations: int = _QUICK,
) -> Fit | None:
    """A few iterations from every start; the best of them.

    Where none comes below the fit without the effect, some more from there, with the gain at 0: the
    loop may be such that no other start of the gain fits to it.
    """
    fits = [_fit_from(before, experiments, effect, start, reset, evaluations) for start in starts]
    found = [f for f in fits if f is not None]
    if not any(f.cost < before.cost for f in found):
        states = tuple(before.starts())
        nested = (starts[0][0], 0.0, states)
        last = _fit_from(before, experiments, effect, nested, {}, 3 * _QUICK)
        found += [last] if last is not None else []
    return min(found, key=lambda f: f.cost) if found else None


def _fit_from(
    before: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    start: _Start,
    reset: dict[str, float],
    evaluations: int,
) -> Fit | None:
    values, gain, memory = start
    names = list(before.unknowns.names)
    names += [p.name for p in effect.parameters if p.name not in FIXED and p.name not in names]
    low, high = next(p.bounds for p in effect.parameters if p.name == effect.gain)
    for share in (1.0, 0.3):
        value = float(np.clip(share * gain, 0.9 * low, 0.9 * high))
        try:
            return fit(
                before.model.with_effect(effect, {**values, **reset, effect.gain or "": value}),
                experiments,
                names,
                sigma=before.sigma,
                start_states=memory,
                evaluations=evaluations,
                tolerance=1e-3,
                rtol=_QUICK_RTOL,
            )
        except PsaError:
            continue
    return None


def choose(
    extensions: Sequence[Extension],
    experiments: Sequence[Experiment],
    before: Fit,
    before_holdout: float,
    floor: float,
    colour: Colour,
    first: Extension | None,
) -> list[Extension]:
    """Return the extensions that are worth having, best first.

    Worth having: evidence; the effect in character; a share of the training residual's power above
    the noise `floor` removed; and held-out data predicted better. A further cause, beside the
    `first`, must also remove a share of what that one did. The order is that of the evidence;
    within the margin the better prediction leads.
    """
    excess = before.rms**2 - floor**2
    needed = HELD_OUT if first is None else HELD_OUT_FURTHER
    held = sum(int(e.held_out.sum()) for e in experiments) / colour.inflation
    good = [
        e
        for e in extensions
        if e.evidence > 0
        and not out_of_character(e, experiments)
        and e.removed > WORTHWHILE * excess
        and (first is None or e.removed > OF_FIRST * first.removed)
        and held * np.log(before_holdout / max(e.holdout_rms, 1e-300)) > needed
    ]
    good.sort(key=lambda e: -e.evidence)
    close = [e for e in good if good[0].evidence - e.evidence < MARGIN]
    close.sort(key=lambda e: e.holdout_rms)
    return close + [e for e in good if e not in close]


def out_of_character(extension: Extension, experiments: Sequence[Experiment]) -> bool:
    """Whether the data ask for something that is not this effect.

    A parameter pushed to the end of its range, or a tone among the harmonics of a periodic drive.
    """
    values = extension.fit.model.values
    tone = extension.effect.tone
    if tone is not None and any(among_harmonics(values[tone], e.record) for e in experiments):
        return True
    for p in extension.effect.parameters:
        if p.name in FIXED or p.name == extension.effect.gain:
            continue
        low, high = p.bounds
        margin = 1e-3 * (high - low) if not p.log else 0.0
        value = values[p.name]
        if p.log and (value < 1.01 * low or value > high / 1.01):
            return True
        if not p.log and (value <= low + margin or value >= high - margin):
            return True
    return False
