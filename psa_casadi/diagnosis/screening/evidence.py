"""How much the data speak for one more effect: Laplace's approximation of the Bayes factor.

    ln B = (n - k)/2 ln(S_before / S_after) - 1/2 ln det(1 + P H P)

S are sums of squares of n whitened residuals, of which k unknowns of the model before have taken
their part, the noise level being the data's own; H is the information on the unknowns that the
effect adds, those of the model before projected out, and P their prior standard deviations. An
unknown that the data do not tell costs nothing, a sharp one costs what its prior range is wider
than its interval (MacKay, Neural Computation 4 (1992), 415).
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise.colour import Colour
from psa_casadi.diagnosis.screening.screen import Score, Screening, whitened_residuals
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.fitting.unknowns import LINEAR_PRIOR, Fitted

FloatArray = npt.NDArray[np.float64]


def evidence(before: Fitted, after: Fitted, colour: Colour) -> float:
    """Return ln B of a fit with one more effect over the fit without it.

    The log-likelihoods of displacement and further columns add up, each with its own noise level.
    """
    share = _freedom(before) / len(before.residuals)
    gained = share * _gained(before.residuals, after.residuals, colour)
    jacobians = []
    level = _level(after.residuals, colour, 0.0)
    jacobians.append(colour.whiten(after.jacobian) / max(level, 1e-300))
    for own, f in zip(colour.further, after.further, strict=True):
        jacobians.append(own.whiten(f.jacobian) / _level(f.residuals, own, f.straight))
    gained += sum(further_gains(before, after, colour).values())
    added, jacobian = _added(before, after), np.concatenate(jacobians)
    kept = [k for k in range(after.unknowns.size) if k not in added]
    new, old = jacobian[:, added], jacobian[:, kept]
    free = new - old @ np.linalg.lstsq(old, new, rcond=1e-10)[0]
    prior = after.unknowns.prior[added]
    scaled = free * np.where(np.isfinite(prior), prior, 1.0)
    _, penalty = np.linalg.slogdet(np.eye(len(added)) + scaled.T @ scaled)
    return gained - 0.5 * float(penalty)


def further_gains(before: Fitted, after: Fitted, colour: Colour) -> dict[str, float]:
    """Return what every further column adds to the log-likelihood of a fit over another one."""
    rows = zip(colour.further, before.further, after.further, strict=True)
    return {
        new.column: _gained(old.residuals, new.residuals, own, new.straight)
        for own, old, new in rows
    }


def _gained(before: FloatArray, after: FloatArray, colour: Colour, straight: float = 0.0) -> float:
    """Return n/2 ln(S_before / S_after), each with what the sensor's form may cost."""
    levels = [_level(r, colour, straight) for r in (before, after)]
    return len(after) * float(np.log(max(levels[0], 1e-300) / max(levels[1], 1e-300)))


def _level(residual: FloatArray, colour: Colour, straight: float) -> float:
    """Return the rms of a whitened residual, at least that of what is `straight`."""
    return float(np.hypot(np.sqrt(np.mean(colour.whiten(residual) ** 2)), straight))


def estimated(before: Fitted, screening: Screening) -> dict[str, float]:
    """Return every effect's ln B as its trial directions tell it, without a full fit.

    Linear in the gain g with prior N(0, s^2), s = `LINEAR_PRIOR` ordinary sizes, and estimated to
    sigma: ln B = (n - k)/2 ln(S / (S - D)) - 1/2 ln(1 + s^2/sigma^2), D the decrease of S; averaged
    over the probe values, each as likely as the others.
    """
    found: dict[str, list[float]] = {}
    white = whitened_residuals(before, screening.colour)
    total = float(np.sum(white**2))
    for score in screening.scores:
        share = min(score.decrease * screening.colour.level**2 / max(total, 1e-300), 1.0 - 1e-9)
        gained = -0.5 * (len(white) - before.unknowns.size) * float(np.log1p(-share))
        found.setdefault(score.direction.effect.name, []).append(_linear(score, gained))
    return {name: float(np.logaddexp.reduce(v) - np.log(len(v))) for name, v in found.items()}


def levelled(
    evidences: Mapping[str, float],
    alike: Sequence[Sequence[str]],
    judged: Collection[str] = (),
) -> dict[str, float]:
    """Return the evidence with that of the best one for all effects that are `alike`.

    They are the same but for a form that none of them is known to have. Where some of a group are
    `judged` by a full fit, the best one of those counts.
    """
    found = dict(evidences)
    for group in alike:
        present = [n for n in group if n in found]
        known = [n for n in present if n in judged] or present
        found |= dict.fromkeys(present, max((found[n] for n in known), default=0.0))
    return found


def temperature(largest: float) -> float:
    """Return what evidence is divided by before it becomes a probability.

    The effects are not the true equations, so that their evidence differs by more than noise, and
    the more the larger the `largest` one is: that of a whole model over the plain base, as the form
    of each of its parts is approximate.
    """
    return max(thresholds().temperature, thresholds().temperature_share * largest)


def probabilities(evidences: Mapping[str, float], whole: float = 0.0) -> dict[str, float]:
    """Return the probability of each effect, given that one of them is the cause.

    `whole` is the evidence of the model with the cause over the plain base, where the effects'
    evidence is that over other causes and a better base.
    """
    if not evidences:
        return {}
    given = np.array(list(evidences.values()))
    values = given / temperature(max(whole, float(np.max(given))))
    weights = np.exp(values - np.logaddexp.reduce(values))
    return dict(zip(evidences, weights.tolist(), strict=True))


def credible_set(probability: Mapping[str, float], level: float) -> tuple[str, ...]:
    """Return the fewest effects whose probabilities sum to `level`, the most probable first."""
    chosen, total = [], 0.0
    for name, p in sorted(probability.items(), key=lambda item: -item[1]):
        if total >= level:
            break
        chosen.append(name)
        total += p
    return tuple(chosen)


def _freedom(fit: Fitted) -> int:
    """Return the number of residuals less that of the unknowns: what is left to tell the noise."""
    return max(len(fit.residuals) - fit.unknowns.size, 0)


def _linear(score: Score, gained: float) -> float:
    if score.penalty is not None:
        return gained - score.penalty
    if not np.isfinite(score.detectable_gain) or score.detectable_gain == 0.0:
        return 0.0
    width = LINEAR_PRIOR * score.direction.unit_gain / abs(score.detectable_gain)
    return gained * width**2 / (1.0 + width**2) - 0.5 * float(np.log1p(width**2))


def _added(before: Fitted, after: Fitted) -> list[int]:
    """Return the coordinates of `after` that `before` has not."""
    known, names = before.unknowns, after.unknowns
    added = [k for k, n in enumerate(names.names) if n not in known.names]
    for record, states in enumerate(names.started):
        first = names.first(record)
        added += [first + k for k, s in enumerate(states) if s not in known.started[record]]
    return added
