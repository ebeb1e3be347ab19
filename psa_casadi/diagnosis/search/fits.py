"""Fits of a model with one cause more, one less, or another: from its parent and defaults."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.diagnosis.screening import Copy, Score, Together
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, hypothesis, near_end
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.fitting.levenberg_marquardt import FIRST_RADIUS, LEAST_RADIUS
from psa_casadi.identification.refitting import quick_rtol, refit
from psa_casadi.identification.start.ordinary import has_loop, ordinary_values
from psa_casadi.model.component import Component
from psa_casadi.model.variables import Parameter
from psa_casadi.records.split import fitted
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.start import is_stack

#: Evaluations of a quick fit from a direction; with what it held, free again.
QUICK, _FREED = 8, 3

#: An effect's values without its gain, the gain, and the records' memories.
Start = tuple[dict[str, float], float, tuple[dict[str, float], ...]]


def quick_fit(
    before: Fit,
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
    fits: list[Fit] = []
    for values, gain, memory in starts:
        least = min([goal, before.cost, *(f.cost for f in fits)])
        added = [(effect, values, gain)]
        quick = fit_with_all(before, added, memory, reset, evaluations, least)
        fits += [quick] if quick is not None else []
    if not any(f.cost < before.cost for f in fits):
        nested, states = [(effect, starts[0][0], 0.0)], tuple(before.starts())
        last = fit_with_all(before, nested, states, {}, 3 * QUICK, goal)
        fits += [last] if last is not None else []
    return min(fits, key=lambda f: f.cost, default=None)


def fit_with_all(
    before: Fit,
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
    for share in (1.0, 0.3):
        model = before.model
        try:
            for effect, values, gain in added:
                low, high = _parameter(effect, effect.gain).bounds
                size = share * gain if effect.linear or effect.gain in effect.fitted else gain
                if not effect.linear:
                    size = float(np.clip(size, 0.9 * low, 0.9 * high))
                model = model.with_effect(effect, {**effect.at_gain(size, values), **reset})
            result = fit(
                model,
                before.experiments,
                names,
                sigma=before.sigma,
                start_states=memory,
                evaluations=evaluations,
                tolerance=1e-3,
                rtol=quick_rtol(before.sigma, before.experiments),
                goal=np.inf if held else goal,
            )
            return continued(result, _FREED) if held else result
        except PsaError:
            continue
    return None


def series_parameters(of: Fit) -> tuple[str, ...]:
    """Return the parameters of effects that are several of one: many, which quick fits hold."""
    return tuple(n for c in of.model.effects if c.more_of for n in c.fitted)


def continued(
    current: Fit, evaluations: int, goal: float = np.inf, *,
    tolerance: float = 1e-3, rtol: float = np.inf, patient: bool = False,
) -> Fit:  # fmt: skip
    """Go on with a fit from where it stopped, with all that is free. Raises PsaError.

    It ends early where its cost will stay above the `goal`; `patient` it goes on along a valley.
    The stepper's tolerance `rtol` is at most that of quick fits.
    """
    names = current.unknowns.names
    return fit(
        current.model,
        current.experiments,
        [*names, *(n for n in series_parameters(current) if n not in names)],
        sigma=current.sigma,
        start_states=current.starts(),
        evaluations=evaluations,
        tolerance=tolerance,
        rtol=min(rtol, quick_rtol(current.sigma, current.experiments)),
        goal=goal,
        patient=patient,
        radius=float(np.clip(current.radius, LEAST_RADIUS, FIRST_RADIUS)),
    )


def cost_beside(other: Hypothesis, of: Hypothesis) -> float:
    """Return the sum of squares that another fit leaves, weighted by the noise levels of a fit.

    Of the displacement and of further columns.
    """
    parts = [*zip(other.fit.record_residuals, of.fit.sigma, strict=True)]
    pairs = zip(other.fit.further, of.fit.further, strict=True)
    parts += [(f.residuals, g.level) for f, g in pairs]
    return sum(float(np.sum((part / level) ** 2)) for part, level in parts)


#: Evaluations of quick fits with other causes present, of sets from default values, and of one
#: effect whose fit continues; number of the best fits that continue, of one effect and of any;
#: start of the gain there, in ordinary sizes.
_BESIDE, _SET_AFRESH, _AFRESH = 12, 17, 45
_CONTINUED, _CONTINUED_ANY, _ORDINARY = 2, 4, 2.5
#: Shares of their gains with which the causes start that are left without another.
_SHARES = (1.0, 0.3, 0.0)
#: Shares of its gain with which a cause near the end of its range restarts.
_AGAIN = (0.5, 2.0)
#: Tolerance of stepper and fit, and evaluations, to the end.
_POLISHING = ((1e-5, 1e-3, 100), (FIT_RTOL, 1e-4, 8))


def with_cause(
    before: Hypothesis, scores: Sequence[Score], goal: float = np.inf
) -> Hypothesis | None:
    """Fit quickly with one more cause from its best directions; None if every fit fails.

    A fit whose cost will stay above the `goal` ends early, here and below.
    """
    effect = scores[0].direction.effect
    starts = [(s.direction.values, s.start, s.direction.memory) for s in scores]
    quick = quick_fit(before.fit, effect, starts, {}, goal=goal)
    return hypothesis((*before.causes, effect), quick)


def with_causes(before: Hypothesis, start: Together, goal: float = np.inf) -> Hypothesis | None:
    """Fit quickly with several more causes at once; None if that fails."""
    added = [
        (d.effect, d.values, d.unit_gain if d.finite else gain)
        for d, gain in zip(start.directions, start.gains, strict=True)
    ]
    memory = tuple(
        {k: v for d in start.directions for k, v in d.memory[r].items()} | state
        for r, state in enumerate(before.fit.starts())
    )
    quick = fit_with_all(before.fit, added, memory, {}, _SET_AFRESH, goal)
    return hypothesis((*before.causes, *(a[0] for a in added)), quick)


def with_causes_afresh(
    before: Hypothesis, start: Together, goal: float = np.inf
) -> Hypothesis | None:
    """Fit several more causes at once from an ordinary base, with gains of an ordinary size.

    Their signs are those that fit best together: a base fit without the causes has bent its loop to
    imitate them, and the sizes of their gains with it.
    """
    added = []
    for d, gain in zip(start.directions, start.gains, strict=True):
        linear = d.effect.linear  # the side to which the declared weights move with it
        side = sum(_parameter(d.effect, n).value * d.values[n] for n in linear) if linear else 1.0
        size = np.copysign(_ORDINARY * _typical(before.fit, d.effect), side * gain)
        values = _ordinary_form(d.effect, d.values)
        added.append((d.effect, values, d.unit_gain if d.finite else float(size)))
    ordinary, states = _ordinary_base(before.fit)
    quick = fit_with_all(before.fit, added, states, ordinary, _SET_AFRESH, goal)
    return hypothesis((*before.causes, *(a[0] for a in added)), quick)


def fit_from_default(
    before: Hypothesis, first: Hypothesis, goal: float = np.inf
) -> Hypothesis | None:
    """Fit the last cause of a hypothesis again from an ordinary base and gains of both signs.

    A base fit without the effect has bent its loop and its lags to imitate it, and may hold the
    search there. Where the gain acts by thresholds or lags, it starts at their steps as well.
    The result is of use below the cost of the first fit, and below the `goal`.
    """
    effect = first.causes[-1]
    fits = _from_ordinary(before.fit, effect, first.fit.model.values)
    goal = min(goal, cost_beside(first, before))
    final = _best_continued(fits, _CONTINUED, goal)
    return hypothesis(first.causes, final)


def fit_any_from_default(before: Hypothesis, scores: Sequence[Score]) -> Hypothesis | None:
    """Fit the effects of the scores from default values; return the best of all."""
    results = side_by_side(
        lambda d: _from_ordinary(before.fit, d.effect, d.values),
        [score.direction for score in scores],
    )
    every = [f for fits in results for f in fits]
    final = _best_continued(every, _CONTINUED_ANY)
    if final is None:
        return None
    effect = next(e for e in final.model.components if e not in before.fit.model.components)
    return hypothesis((*before.causes, effect), final)


def in_place(
    whole: Hypothesis,
    less: Hypothesis,
    reached: Fit,
    alone: Fit,
    effect: Component,
    goal: float = np.inf,
) -> Hypothesis | None:
    """Fit an effect with the causes of `less`, where the `whole` has another one.

    The effect starts from its values in the fit `alone`, the rest from those in the fit `reached`;
    what `reached` does not have stays as in `less`.
    """
    values = alone.model.values
    start = (
        {p.name: values[p.name] for p in effect.parameters if p.name != effect.gain},
        values[effect.gain or ""],
        tuple({**s, **r} for s, r in zip(alone.starts(), reached.starts(), strict=True)),
    )
    return exchanged(whole, less, effect, start, reached, goal)


def like(
    whole: Hypothesis, less: Hypothesis, copy: Copy, goal: float = np.inf
) -> Hypothesis | None:
    """Fit an effect that could copy a cause of the `whole`, from where that has led the base.

    `less` is the hypothesis without the cause; its base is bent to imitate it. The effect starts
    with the gain that copies best.
    """
    effect, direction = copy.direction.effect, copy.direction
    usable = copy.gain > 0 or not direction.one_sided
    start = (direction.values, copy.gain if usable else direction.unit_gain, direction.memory)
    return exchanged(whole, less, effect, start, whole.fit, goal)


def exchanged(
    whole: Hypothesis,
    less: Hypothesis,
    effect: Component,
    start: Start,
    reached: Fit,
    goal: float = np.inf,
) -> Hypothesis | None:
    """Fit an effect where the `whole` has the cause that `less` lacks, the rest as `reached`.

    `start` are the effect's values without its gain, the gain, and the records' memories.
    """
    values = reached.model.values
    base = {n: values[n] for n in less.fit.unknowns.names if n in values}
    causes = tuple(effect if c not in less.causes else c for c in whole.causes)
    quick = quick_fit(less.fit, effect, [start], base, _BESIDE, goal)
    return hypothesis(causes, quick)


def without(
    whole: Hypothesis, cause: Component, known: Hypothesis | None = None
) -> Hypothesis | None:
    """Fit without a cause from where the whole has led; None where that cannot be simulated.

    Causes that hold each other may have no rest one without the other: then their gains begin at
    less. It ends early where it will leave more than what is `known` without the cause.
    """
    least = known.fit.rms if known is not None else np.inf
    model = whole.fit.model.without([cause.name])
    names = [n for n in whole.fit.unknowns.names if n in model.values]
    causes = [c for c in whole.causes if c is not cause]
    gains = [c.gain for c in causes if c.gain]
    for share in _SHARES:
        try:
            start = model.with_values({n: share * model.values[n] for n in gains})
            sigma = None if is_stack(start) else whole.fit.sigma
            result = refit(replace(whole.fit, model=start), names, sigma=sigma, least=least)
        except PsaError:
            continue
        return hypothesis(causes, result, final=True)
    return None


def as_led(whole: Hypothesis, cause: Component) -> Hypothesis | None:
    """Return the model without a cause where the whole has led it, not fitted again.

    None where that cannot be simulated.
    """
    model = whole.fit.model.without([cause.name])
    names = [n for n in whole.fit.unknowns.names if n in model.values]
    start = replace(whole.fit, model=model)
    try:
        result = refit(start, names, sigma=whole.fit.sigma, evaluations=1)
    except PsaError:
        return None
    causes = [c for c in whole.causes if c is not cause]
    return hypothesis(causes, result)


def together(of: Hypothesis) -> Hypothesis | None:
    """Fit all parameters once more, weighted by the noise that the residuals now suggest."""
    try:
        result = refit(of.fit)
    except PsaError:
        return None
    return hypothesis(of.causes, result, final=True)


def to_end(of: Hypothesis, goal: float = np.inf) -> Hypothesis:
    """Continue a fit until it converges, loosely first, then at full tolerance.

    One whose cost will stay above the `goal` is not final.
    """
    current = of.fit
    for rtol, tolerance, evaluations in _POLISHING:
        try:
            current = continued(
                current, evaluations, goal, tolerance=tolerance, rtol=rtol, patient=True
            )
        except PsaError:
            return replace(of, final=True)
        if current.cost > goal:
            break
    ended = hypothesis(of.causes, current, final=current.cost <= goal)
    return ended or replace(of, final=True)


def refit_at_bound(of: Hypothesis) -> Hypothesis | None:
    """Fit once more where a cause has come near the end of its range: another minimum may hold it.

    That cause restarts from its declared values, at half and at twice its gain; the result is of
    use below the cost of the fit. None where no cause is near an end.
    """
    values = of.fit.model.values
    at_end = next((c for c in of.causes if near_end(values, c)), None)
    if at_end is None:
        return None
    kept = {at_end.gain, *at_end.linear}
    table = {n: _parameter(at_end, n).value for n in at_end.fitted if n not in kept}
    gains = at_end.linear or (at_end.gain or "",)

    def begin(share: float) -> Fit | None:
        try:
            model = of.fit.model.with_values({**table, **{n: share * values[n] for n in gains}})
            return continued(replace(of.fit, model=model), _AFRESH, of.fit.cost)
        except PsaError:
            return None

    fits = [f for f in side_by_side(begin, _AGAIN) if f is not None and f.cost < of.fit.cost]
    best = min(fits, key=lambda f: f.cost, default=None)
    result = hypothesis(of.causes, best)
    return None if result is None else to_end(result)


def _from_ordinary(before: Fit, effect: Component, known: Mapping[str, float]) -> list[Fit]:
    """Quick fits from an ordinary base and gains; forms and frequencies are the `known` ones."""
    gain, size = _parameter(effect, effect.gain), _typical(before, effect)
    sizes = [_ORDINARY, *(s for s in effect.finite_step if s > _ORDINARY)]
    if gain.bounds[0] < 0:
        sizes.append(-_ORDINARY)
    values = _ordinary_form(effect, known)
    loops = (False, True) if has_loop(before.model) else (False,)
    bases = [_ordinary_base(before, soon=soon) for soon in loops]

    def start(base: tuple[_Base, float]) -> Fit | None:
        (ordinary, states), share = base
        added = [(effect, values, share * size)]
        return fit_with_all(before, added, states, ordinary, QUICK)

    starts = list(itertools.product(bases, sizes))
    return [f for f in side_by_side(start, starts) if f is not None]


#: Values of a base, and the states in which records begin.
_Base = tuple[dict[str, float], tuple[dict[str, float], ...]]


def _ordinary_base(before: Fit, *, soon: bool = False) -> _Base:
    """Return an ordinary stack at rest; any other model goes on from its values and states.

    The states of a loop that is bent would bend the ordinary one.
    """
    if not is_stack(before.model):
        return {}, tuple(before.starts())
    records = [e.record for e in fitted(before.experiments)]
    return ordinary_values(before.model, records, soon=soon), ()


def _best_continued(fits: Sequence[Fit], count: int, goal: float = np.inf) -> Fit | None:
    """Continue the `count` best fits, unless they stay above the goal; return the best then."""

    def further(quick: Fit) -> Fit:
        try:
            return continued(quick, _AFRESH, goal)
        except PsaError:
            return quick

    best = list({f.cost: f for f in sorted(fits, key=lambda f: f.cost)}.values())[:count]
    return min([*fits, *side_by_side(further, best)], key=lambda f: f.cost, default=None)


def _typical(before: Fit, effect: Component) -> float:
    """Return an ordinary size of an effect's gain in the model of a fit."""
    gain = _parameter(effect, effect.gain)
    return gain.typical(before.model.with_effect(effect, {gain.name: 0.0}).values)


def _ordinary_form(effect: Component, known: Mapping[str, float]) -> dict[str, float]:
    """Return an effect's declared values where it has trials; forms and frequencies are `known`."""
    return {
        n: known[n] if isinstance(g, str) or n not in effect.fitted else _parameter(effect, n).value
        for n, g in effect.probe.items()
    }


def _parameter(effect: Component, name: str | None) -> Parameter:
    return next(p for p in effect.parameters if p.name == name)
