"""Fits with one more effect that stop early: a few iterations from each start."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.component import Component
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.fitting.levenberg_marquardt import FIRST_RADIUS, LEAST_RADIUS
from psa_casadi.identification.refitting import quick_rtol
from psa_casadi.records.split import Experiment

#: Evaluations of a quick fit from a direction; with what it held, free again.
QUICK, _FREED = 8, 3

#: An effect's values without its gain, the gain, and the records' memories.
Start = tuple[dict[str, float], float, tuple[dict[str, float], ...]]


def quick_fit(
    before: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    starts: Sequence[Start],
    reset: dict[str, float],
    evaluations: int = QUICK,
    goal: float = np.inf,
) -> Fit | None:
    """A few iterations from every start; the best of them.

    A start ends early where its cost will stay above the `goal`, that of the fit without the effect
    or that of another start. Where none comes below that without the effect, some more from there,
    with the gain at 0: the loop may be such that no other start of the gain fits to it.
    """
    found: list[Fit] = []
    for start in starts:
        least = min([goal, before.cost, *(f.cost for f in found)])
        own = fit_from(before, experiments, effect, start, reset, evaluations, least)
        found += [own] if own is not None else []
    if not any(f.cost < before.cost for f in found):
        states = tuple(before.starts())
        nested = (starts[0][0], 0.0, states)
        last = fit_from(before, experiments, effect, nested, {}, 3 * QUICK, goal)
        found += [last] if last is not None else []
    return min(found, key=lambda f: f.cost) if found else None


def fit_from(
    before: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    start: Start,
    reset: dict[str, float],
    evaluations: int,
    goal: float = np.inf,
) -> Fit | None:
    """Fit with one more effect from a start, the other values `reset`; None if that fails."""
    values, gain, memory = start
    added = [(effect, values, gain)]
    return fit_with_all(before, experiments, added, memory, reset, evaluations, goal)


def fit_with_all(
    before: Fit,
    experiments: Sequence[Experiment],
    added: Sequence[tuple[Component, dict[str, float], float]],
    memory: tuple[dict[str, float], ...],
    reset: dict[str, float],
    evaluations: int,
    goal: float = np.inf,
) -> Fit | None:
    """Fit with more effects, each from its values and its gain; None if that fails.

    A series of modes that is there already stays as it is until the last evaluations. A fit whose
    cost will stay above the `goal` ends early.
    """
    held = series_parameters(before)
    names = [n for n in before.unknowns.names if n not in held]
    names += [n for effect, _, _ in added for n in effect.fitted if n not in names]
    rtol = quick_rtol(before.sigma, experiments)
    for share in (1.0, 0.3):
        model = before.model
        try:
            for effect, values, gain in added:
                low, high = next(p.bounds for p in effect.parameters if p.name == effect.gain)
                moved = effect.linear or effect.gain in effect.fitted
                own = share * gain if moved else gain
                if not effect.linear:
                    own = float(np.clip(own, 0.9 * low, 0.9 * high))
                model = model.with_effect(effect, {**effect.at_gain(own, values), **reset})
            found = fit(
                model,
                experiments,
                names,
                sigma=before.sigma,
                start_states=memory,
                evaluations=evaluations,
                tolerance=1e-3,
                rtol=rtol,
                goal=np.inf if held else goal,
            )
            return continued(found, experiments, rtol, 1e-3, _FREED) if held else found
        except PsaError:
            continue
    return None


def series_parameters(of: Fit) -> tuple[str, ...]:
    """Return the parameters of effects that are several of one: many, which quick fits hold."""
    return tuple(n for c in of.model.effects if c.more_of for n in c.fitted)


def continued(
    current: Fit,
    experiments: Sequence[Experiment],
    rtol: float,
    tolerance: float,
    evaluations: int,
    goal: float = np.inf,
    *,
    patient: bool = False,
) -> Fit:
    """Go on with a fit from where it stopped, with all that is free. Raises PsaError.

    It ends early where its cost will stay above the `goal`; `patient` it goes on along a valley.
    """
    names = current.unknowns.names
    return fit(
        current.model,
        experiments,
        [*names, *(n for n in series_parameters(current) if n not in names)],
        sigma=current.sigma,
        start_states=current.starts(),
        evaluations=evaluations,
        tolerance=tolerance,
        rtol=rtol,
        goal=goal,
        patient=patient,
        radius=float(np.clip(current.radius, LEAST_RADIUS, FIRST_RADIUS)),
    )


def cost_beside(other: Fit, of: Fit, experiments: Sequence[Experiment]) -> float:
    """Return the sum of squares that another fit leaves, weighted by the noise levels of a fit.

    Of the displacement and of further columns.
    """
    parts = [*zip(other.residuals_of(experiments), of.sigma, strict=True)]
    parts += [(f.residuals, g.level) for f, g in zip(other.further, of.further, strict=True)]
    return sum(float(np.sum((part / level) ** 2)) for part, level in parts)
