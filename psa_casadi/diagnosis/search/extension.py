"""Fits with one more effect: from its trial directions, from another effect's fit, afresh."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.held_out.errors import held_out_rms
from psa_casadi.diagnosis.noise.colour import Colour
from psa_casadi.diagnosis.screening.evidence import evidence
from psa_casadi.diagnosis.screening.screen import Copy, Score
from psa_casadi.diagnosis.search.quick_fits import QUICK, continued, fit_from, quick_fit
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.search.refitting import quick_rtol
from psa_casadi.identification.start.ordinary import ordinary_values
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.timings import stage

FloatArray = npt.NDArray[np.float64]

#: Evaluations of quick fits beside another effect, and of those afresh that go on: the best so
#: many, of one effect and of any; there the gain begins at so many ordinary sizes.
_COPY, _AFRESH = 12, 17
_CONTINUED, _CONTINUED_ANY, _ORDINARY = 2, 4, 2.5
#: Tolerance of stepper and fit, and evaluations, to the end.
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


def extend(
    before: Fit, experiments: Sequence[Experiment], scores: Sequence[Score], colour: Colour
) -> Extension | None:
    """Fit quickly with one more effect from its best directions; None if every fit fails."""
    starts = [(s.direction.values, s.start, s.direction.memory) for s in scores]
    quick = quick_fit(before, experiments, scores[0].direction.effect, starts, {})
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
    colour: Colour,
) -> Extension | None:
    """Fit an effect from where the best one has led the base, with the gain that copies that one.

    The base without either is bent to imitate them; beside the best one it is nearly right.
    """
    effect, direction = copy.direction.effect, copy.direction
    values = best.fit.model.values
    base = {n: values[n] for n in before.unknowns.names}
    usable = copy.gain > 0 or not direction.one_sided
    start = (direction.values, copy.gain if usable else direction.unit_gain, direction.memory)
    quick = quick_fit(before, experiments, effect, [start], base, _COPY)
    if quick is None:
        return None
    return _extension(before, quick, effect, experiments, colour)


def extend_within(
    before: Fit,
    experiments: Sequence[Experiment],
    reached: Fit,
    own: Fit,
    effect: Component,
    colour: Colour,
) -> Extension | None:
    """Fit an effect with its values from one fit that has it, and the others' from another one.

    Values that `reached` does not have stay those of `before`.
    """
    other, values = reached.model.values, own.model.values
    start = (
        {p.name: values[p.name] for p in effect.parameters if p.name != effect.gain},
        values[effect.gain or ""],
        tuple({**s, **r} for s, r in zip(own.starts(), reached.starts(), strict=True)),
    )
    base = {n: other[n] for n in before.unknowns.names if n in other}
    quick = quick_fit(before, experiments, effect, [start], base, _COPY)
    return None if quick is None else _extension(before, quick, effect, experiments, colour)


def extend_afresh(
    before: Fit, experiments: Sequence[Experiment], first: Extension, colour: Colour
) -> Extension:
    """Fit an effect again from an ordinary base and gains of both signs; return the better.

    A base fit without the effect has bent its loop and its lags to imitate it, and may hold the
    search there. Where the gain acts by thresholds or lags, it starts at their steps as well.
    """
    fits = _from_ordinary(before, experiments, first.effect, first.fit.model.values)
    final = _best_continued(fits, experiments, _CONTINUED)
    if final is None or final.cost >= first.fit.cost:
        return first
    return _extension(before, final, first.effect, experiments, colour)


@stage("fits afresh")
def extend_any(
    before: Fit,
    experiments: Sequence[Experiment],
    scores: Sequence[Score],
    colour: Colour,
) -> Extension | None:
    """Fit the effects of the scores afresh, as `extend_afresh` does, and return the best of all."""
    found = side_by_side(
        lambda d: _from_ordinary(before, experiments, d.effect, d.values),
        [score.direction for score in scores],
    )
    final = _best_continued([f for own in found for f in own], experiments, _CONTINUED_ANY)
    if final is None:
        return None
    effect = next(e for e in final.model.components if e not in before.model.components)
    return _extension(before, final, effect, experiments, colour)


def _from_ordinary(
    before: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    known: Mapping[str, float],
) -> list[Fit]:
    """Quick fits from an ordinary base and gains; forms and frequencies are the `known` ones."""
    gain = next(p for p in effect.parameters if p.name == effect.gain)
    size = gain.typical(before.model.with_effect(effect, {gain.name: 0.0}).values)
    sizes = [_ORDINARY, *(s for s in effect.finite_step if s > _ORDINARY)]
    if gain.bounds[0] < 0:
        sizes.append(-_ORDINARY)
    values = {
        n: known[n] if isinstance(grid, str) or n not in effect.fitted else _declared(effect, n)
        for n, grid in effect.probe.items()
    }
    ordinary = ordinary_values(before.model, [e.record for e in experiments])
    starts = [(values, s * size, tuple(before.starts())) for s in sizes]
    found = side_by_side(
        lambda s: fit_from(before, experiments, effect, s, ordinary, QUICK), starts
    )
    return [f for f in found if f is not None]


def _best_continued(
    fits: Sequence[Fit], experiments: Sequence[Experiment], count: int
) -> Fit | None:
    """Go on with the best so many fits; return the best then."""

    def further(quick: Fit) -> Fit:
        try:
            rtol = quick_rtol(quick.sigma, experiments)
            return continued(quick, experiments, rtol, 1e-3, _AFRESH)
        except PsaError:
            return quick

    best = sorted(fits, key=lambda f: f.cost)[:count]
    return min([*fits, *side_by_side(further, best)], key=lambda f: f.cost, default=None)


def stripped(extension: Extension, experiments: Sequence[Experiment]) -> Fit:
    """Return an extension's fit without its effect, all other values as they are, none fitted.

    Only the offset of a record is guessed anew. Raises PsaError where that cannot be simulated.
    """
    whole = extension.fit
    model = whole.model.without([extension.effect.name])
    names = [n for n in whole.unknowns.names if n in model.values]
    return fit(
        model, experiments, names, sigma=whole.sigma, start_states=whole.starts(), evaluations=1
    )


def polish(
    before: Fit, extension: Extension, experiments: Sequence[Experiment], colour: Colour
) -> Extension:
    """Continue an extension's fit until it converges, loosely first, then at full tolerance."""
    current = extension.fit
    loosest = quick_rtol(current.sigma, experiments)
    for rtol, tolerance, evaluations in _POLISHING:
        try:
            current = continued(current, experiments, min(rtol, loosest), tolerance, evaluations)
        except PsaError:
            return replace(extension, final=True)
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
