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

FloatArray = npt.NDArray[np.float64]

#: How many effects are fitted fully in each round, and how many starts each gets.
FULL_FITS = 4
_STARTS = 2
#: An effect whose screening score is below this share of the best one is not worth a full fit.
_WORTH = 0.1
_ITERATIONS = 25
#: Evidence (in units of the log-likelihood) within which two effects cannot be told apart.
MARGIN = 10.0


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
    """Fit the model with one more effect from every start given; return the best, if any."""
    fits = [f for f in (_fit_from(before, experiments, s) for s in scores) if f is not None]
    if not fits:
        return None
    best = min(fits, key=lambda f: f.cost)
    predicted = tuple(best.predicted(experiments))
    return Extension(
        effect=scores[0].direction.effect,
        fit=best,
        evidence=evidence(before, best, inflation),
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


def _fit_from(before: Fit, experiments: Sequence[Experiment], score: Score) -> Fit | None:
    direction = score.direction
    effect = direction.effect
    gain = effect.gain or ""
    names = list(before.unknowns.names)
    names += [p.name for p in effect.parameters if p.name not in FIXED and p.name not in names]
    low, high = next(p.bounds for p in effect.parameters if p.name == gain)
    start = direction.unit_gain if direction.finite else score.gain
    for share in (1.0, 0.3):
        value = float(np.clip(share * start, low + 1e-3 * (0 - low) * (low < 0), high))
        try:
            model = before.model.with_effect(effect, {**direction.values, gain: value})
            return fit(
                model,
                experiments,
                names,
                sigma=before.sigma,
                start_memory=direction.memory,
                evaluations=_ITERATIONS,
                tolerance=1e-4,
            )
        except PsaError:
            continue
    return None


def choose(extensions: Sequence[Extension], before_holdout: float) -> list[Extension]:
    """Return the extensions that gain evidence and predict held-out data better, best first.

    The order is that of the evidence; where two are within the margin, the better prediction leads.
    """
    good = [e for e in extensions if e.evidence > 0 and e.holdout_rms < before_holdout]
    good.sort(key=lambda e: -e.evidence)
    close = [e for e in good if good[0].evidence - e.evidence < MARGIN]
    close.sort(key=lambda e: e.holdout_rms)
    return close + [e for e in good if e not in close]
