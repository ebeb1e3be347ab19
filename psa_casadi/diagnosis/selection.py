"""Full fits of the leading effects, and the choice among them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.errors_of import held_out_residuals, rms
from psa_casadi.diagnosis.screening import Score, Screening
from psa_casadi.errors import PsaError
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.fit import Fit, fit
from psa_casadi.identification.identify import FIXED
from psa_casadi.identification.starting import ordinary_loop

FloatArray = npt.NDArray[np.float64]

#: How many effects are fitted fully in each round, and how many starts each gets.
FULL_FITS = 4
_STARTS = 1
#: An effect whose screening score is below this share of the best one is not worth a full fit.
_WORTH = 0.1
_ITERATIONS = 30
#: Tolerance of the stepper while searching; the final fit uses that of every fit.
_SEARCH_RTOL = 1e-5
#: Evidence (in units of the log-likelihood) within which two effects cannot be told apart.
MARGIN = 10.0
#: Share of the held-out excess power that an effect must remove to be added.
WORTHWHILE = 0.25
#: ... and the held-out rms must fall at least to this share: less is of no use to anybody.
NOTICEABLE = 0.98


@dataclass(frozen=True, eq=False)
class Extension:
    """One more effect, fully fitted: its fit, evidence over the model before it, held-out rms [m]."""

    effect: Component
    fit: Fit
    evidence: float
    holdout_rms: float
    predicted: tuple[FloatArray, ...]


def leading(screening: Screening) -> list[tuple[str, list[Score]]]:
    """Return the effects worth a full fit with their best starts, best first."""
    best = screening.best_by_effect()
    if not best:
        return []
    top = next(iter(best.values())).decrease
    limit = max(screening.threshold, _WORTH * top)
    chosen = [name for name, score in best.items() if score.decrease >= limit][:FULL_FITS]
    starts: dict[str, list[Score]] = {name: [] for name in chosen}
    for score in screening.scores:
        name = score.direction.effect.name
        if name not in starts or len(starts[name]) >= _STARTS:
            continue
        known = [s.direction.values for s in starts[name]]
        if score.decrease >= 0.5 * best[name].decrease and (
            score.direction.values not in known or score.direction.finite
        ):
            starts[name].append(score)
    return list(starts.items())


def extend(
    before: Fit, experiments: Sequence[Experiment], scores: Sequence[Score], inflation: float
) -> Extension | None:
    """Fit the model with one more effect from the best directions; None where every fit fails."""
    starts = [(s.direction.values, s.start, s.direction.memory) for s in scores]
    return _best_of(before, experiments, scores[0].direction.effect, starts, {}, inflation)


def extend_afresh(
    before: Fit, experiments: Sequence[Experiment], first: Extension, inflation: float
) -> Extension:
    """Fit an effect again from an ordinary loop and both signs of its gain; return the better.

    A base fit without the effect has bent its loop to imitate it, and may hold the search there.
    """
    effect = first.effect
    gain = next(p for p in effect.parameters if p.name == effect.gain)
    size = 2.5 * gain.typical({**before.model.values, gain.name: 0.0})
    values = {
        n: first.fit.model.values[n] if isinstance(grid, str) else _declared(effect, n)
        for n, grid in effect.probe.items()
    }
    memory = tuple(before.memory(r) for r in range(len(experiments)))
    starts = [(values, sign * size, memory) for sign in (1.0, -1.0) if sign > 0 or gain.bounds[0] < 0]
    loop = ordinary_loop(before.model)
    again = _best_of(before, experiments, effect, starts, loop, inflation)
    return again if again is not None and again.fit.cost < first.fit.cost else first


def _declared(effect: Component, name: str) -> float:
    return next(p.value for p in effect.parameters if p.name == name)


_Start = tuple[dict[str, float], float, tuple[dict[str, float], ...]]


def _best_of(
    before: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    starts: Sequence[_Start],
    loop: dict[str, float],
    inflation: float,
) -> Extension | None:
    fits = [_fit_from(before, experiments, effect, start, loop) for start in starts]
    found = [f for f in fits if f is not None]
    if not found:
        return None
    best = min(found, key=lambda f: f.cost)
    final = fit(
        best.model,
        experiments,
        best.unknowns.names,
        sigma=before.sigma,
        start_memory=[best.memory(r) for r in range(len(experiments))],
        evaluations=_ITERATIONS,
        tolerance=1e-4,
    )
    predicted = tuple(final.predicted(experiments))
    return Extension(
        effect=effect,
        fit=final,
        evidence=evidence(before, final, inflation),
        holdout_rms=rms(np.concatenate(held_out_residuals(experiments, predicted))),
        predicted=predicted,
    )


def evidence(before: Fit, after: Fit, inflation: float) -> float:
    """Return the gain in log-likelihood less Schwarz' penalty for the unknowns added.

    n/2 ln(S_before/S_after) - k/2 ln n, with n samples divided by the inflation for correlated noise.
    """
    n = len(before.residuals) / inflation
    added = after.unknowns.size - before.unknowns.size
    return 0.5 * n * float(np.log(before.cost / after.cost)) - 0.5 * added * float(np.log(n))


def _fit_from(
    before: Fit,
    experiments: Sequence[Experiment],
    effect: Component,
    start: _Start,
    loop: dict[str, float],
) -> Fit | None:
    values, gain, memory = start
    names = list(before.unknowns.names)
    names += [p.name for p in effect.parameters if p.name not in FIXED and p.name not in names]
    low, high = next(p.bounds for p in effect.parameters if p.name == effect.gain)
    for share in (1.0, 0.3):
        value = float(np.clip(share * gain, 0.9 * low, 0.9 * high))
        try:
            return fit(
                before.model.with_effect(effect, {**values, **loop, effect.gain or "": value}),
                experiments,
                names,
                sigma=before.sigma,
                start_memory=memory,
                evaluations=_ITERATIONS,
                tolerance=1e-3,
                rtol=_SEARCH_RTOL,
            )
        except PsaError:
            continue
    return None


def choose(
    extensions: Sequence[Extension], before_holdout: float, floor: float
) -> list[Extension]:
    """Return the extensions that are worth having, best first.

    Worth having: evidence, and at least `WORTHWHILE` of the held-out power above the noise `floor`
    removed. The order is that of the evidence; within the margin the better prediction leads.
    """
    excess = before_holdout**2 - floor**2
    good = [
        e
        for e in extensions
        if e.evidence > 0 and before_holdout**2 - e.holdout_rms**2 > WORTHWHILE * excess
        and e.holdout_rms < NOTICEABLE * before_holdout
    ]
    good.sort(key=lambda e: -e.evidence)
    close = [e for e in good if good[0].evidence - e.evidence < MARGIN]
    close.sort(key=lambda e: e.holdout_rms)
    return close + [e for e in good if e not in close]
