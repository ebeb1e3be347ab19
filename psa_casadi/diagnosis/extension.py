"""Fits with one more effect: from its trial directions, from another effect's fit, afresh."""

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
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.search import FIXED
from psa_casadi.identification.starting import ordinary_values

FloatArray = npt.NDArray[np.float64]

#: Evaluations of quick fits: from directions, beside another effect, and afresh.
_QUICK, _COPY, _AFRESH = 8, 12, 25
#: Tolerance of the stepper in quick fits, then of stepper and fit, and evaluations, to the end.
_QUICK_RTOL = 1e-4
_POLISHING = ((1e-5, 1e-3, 30), (FIT_RTOL, 1e-4, 8))


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
