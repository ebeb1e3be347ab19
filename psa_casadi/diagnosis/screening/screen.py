"""Screening: which effects would lower the residual, the base parameters being free to follow.

Every direction is prewhitened, the fitted parameters' directions are projected out, and the
decrease of the sum of squares is compared with one threshold for the maximum over all directions,
drawn from Gaussian noise along the actual directions (family-wise; Davies 1987, Hansen 1996).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise.colour import Colour, colour_of
from psa_casadi.diagnosis.screening.probes import Direction
from psa_casadi.diagnosis.screening.spans import Span, combined, declared, spans
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.fitting.unknowns import Fitted

FloatArray = npt.NDArray[np.float64]

_DRAWS = 4000
_SEED = 20150810  # of the threshold's simulation: the same data give the same verdict
#: An effect whose score is below this share of the best one is not fitted; so many of the others
#: are, more of them where their scores are this close to the best one's.
_WORTH, _LEADING, _MOST, _AS_NEAR = 0.1, 4, 7, 0.4


@dataclass(frozen=True, eq=False)
class Score:
    """One direction's decrease of the whitened sum of squares, and the gain it suggests.

    Of a span (see `spans`) the direction is the best one in it; `penalty` is what the evidence
    loses by its weights.
    """

    direction: Direction
    decrease: float
    gain: float
    detectable_gain: float
    penalty: float | None = None

    @property
    def start(self) -> float:
        """Gain to start a fit from: the linear estimate, or the finite step that was tried.

        A base fit without a one-sided effect may overshoot in its place, so that the estimate has
        the wrong sign; the fit then starts from an ordinary size.
        """
        if self.direction.finite or (self.direction.one_sided and self.gain <= 0):
            return self.direction.unit_gain
        return self.gain


@dataclass(frozen=True, eq=False)
class Screening:
    """Scores in falling order, the threshold for the largest, and the noise they were judged by."""

    scores: tuple[Score, ...]
    threshold: float
    colour: Colour

    def best_by_effect(self) -> dict[str, Score]:
        """Return each effect's best score, in falling order."""
        best: dict[str, Score] = {}
        for score in self.scores:
            best.setdefault(score.direction.effect.name, score)
        return best

    def leading(self) -> list[str]:
        """Return the effects worth a fit, the best one first."""
        best = self.best_by_effect()
        if not best:
            return []
        top = next(iter(best.values())).decrease
        limit = max(self.threshold, _WORTH * top)
        near = [s for s in best.values() if s.decrease >= max(limit, _AS_NEAR * top)]
        count = max(_LEADING, min(len(near), _MOST))
        return [name for name, score in best.items() if score.decrease >= limit][:count]


def screen(
    fit: Fitted,
    trials: Sequence[Direction],
    lengths: Sequence[int],
    known: Sequence[FloatArray | None] | None = None,
    *,
    colour: Colour | None = None,
) -> Screening:
    """Score the directions on a fit's residuals; `lengths` are the records' numbers of samples.

    `known` is the colour of the records' noise where it is known without a model; `colour` replaces
    the whole estimate.
    """
    basis = independent(fit.jacobian)
    none: FloatArray = np.zeros((len(fit.residuals), 0))
    columns = np.hstack([none, *(d.column[:, None] for d in trials)])
    if colour is None:
        every = independent(np.hstack([basis, without(columns, basis)]))
        colour = colour_of(without(fit.residuals, every), lengths, known, every)
    beside = further_columns(fit, trials)
    colour = replace(colour, further=_further_colours(fit, beside))
    white_basis = independent(whitened_jacobian(fit, colour))
    residual = without(whitened_residuals(fit, colour), white_basis)
    whole = colour.whiten_all(columns, beside)
    white = without(whole, white_basis)
    raw = np.linalg.norm(whole, axis=0)
    norm = np.linalg.norm(white, axis=0)
    usable = norm > 1e-6 * raw
    norm = np.where(usable, norm, 1.0)
    unit = np.where(usable, white / norm, 0.0)
    t = unit.T @ residual / colour.level
    scores, seen = [], []
    gram = unit.T @ unit
    for places in spans(trials):
        own = [trials[k] for k in places]
        if own[0].weight:
            span = Span(gram[np.ix_(places, places)], norm[places] * usable[places] / colour.level)
            seen.append((places, span))
            scores.append(_of_span(own, span, t[places]))
            continue
        k, direction = places[0], own[0]
        allowed = usable[k] and (t[k] > 0 or not direction.finite)
        scores.append(
            Score(
                direction,
                float(t[k] ** 2) if allowed else 0.0,
                float(t[k] * colour.level / norm[k] * direction.unit_gain),
                float(direction.unit_gain * colour.level / norm[k]) if usable[k] else np.inf,
            )
        )
    scores.sort(key=lambda s: -s.decrease)
    return Screening(tuple(scores), _threshold(gram, seen), colour)


def _of_span(own: Sequence[Direction], span: Span, t: FloatArray) -> Score:
    """Return the score of a span's best direction; `t` (m,) are the residual's projections."""
    return Score(
        combined(own, span.gains(t)),
        float(span.decrease(t)),
        1.0,
        span.detectable(declared(own)),
        float(np.sum(span.penalties)) - 0.5 * span.surplus,
    )


def whitened_residuals(fit: Fitted, colour: Colour) -> FloatArray:
    """Return the whitened residuals (samples,), those of the further columns below."""
    return colour.whiten_all(fit.residuals, [f.residuals for f in fit.further])


def whitened_jacobian(fit: Fitted, colour: Colour) -> FloatArray:
    """Return the whitened derivatives by theta (samples, size), the further columns' below."""
    return colour.whiten_all(fit.jacobian, [f.jacobian for f in fit.further])


def further_columns(fit: Fitted, trials: Sequence[Direction]) -> list[FloatArray]:
    """Return for every further column what the directions change in it (samples, directions)."""
    return [
        np.hstack([np.zeros((len(f.residuals), 0)), *(d.further[k][:, None] for d in trials)])
        for k, f in enumerate(fit.further)
    ]


def _further_colours(fit: Fitted, columns: Sequence[FloatArray]) -> tuple[Colour, ...]:
    """Return the colour of what neither the fit nor a direction explains of the further columns."""
    found = []
    for f, own in zip(fit.further, columns, strict=True):
        basis = independent(f.jacobian)
        every = independent(np.hstack([f.basis, basis, without(own, basis)]))
        found.append(colour_of(without(f.residuals, every), f.lengths, None, every))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class Copy:
    """How well an effect can copy what another one adds.

    `share` of the contribution's power, with all of the effect's directions; the `direction` that
    does best alone, and the `gain` at which it does.
    """

    share: float
    direction: Direction
    gain: float


def copies(
    fit: Fitted, added: FloatArray, trials: Sequence[Direction], colour: Colour
) -> tuple[float, dict[str, Copy]]:
    """Return the power of a contribution over the noise's, and how each effect can copy it.

    `added` (samples,) [m] is what another effect adds to the prediction. The fitted parameters are
    projected out of it and of the trial directions.
    """
    basis = independent(colour.whiten(fit.jacobian))
    target = without(colour.whiten(added), basis)
    power = float(target @ target)
    found: dict[str, Copy] = {}
    for name in dict.fromkeys(d.effect.name for d in trials):
        own = [d for d in trials if d.effect.name == name]
        columns = np.column_stack([d.column for d in own])
        free = without(colour.whiten(columns), basis)
        norms = np.linalg.norm(free, axis=0)
        usable = norms > 1e-6 * np.linalg.norm(columns, axis=0)
        if power <= 0 or not usable.any():
            continue
        share = float(np.sum((independent(free[:, usable]).T @ target) ** 2)) / power
        unit, sizes = np.where(usable, free / np.where(usable, norms, 1.0), 0.0), usable * norms
        along = unit.T @ target / colour.level
        ways = [_copy(own, p, unit, sizes / colour.level, along) for p in spans(own)]
        _, direction, gain = max(ways, key=lambda w: w[0])
        found[name] = Copy(share, direction, gain)
    return power / colour.level**2, found


def _copy(
    trials: Sequence[Direction],
    places: list[int],
    unit: FloatArray,
    norms: FloatArray,
    along: FloatArray,
) -> tuple[float, Direction, float]:
    """Return how much of a target a span or a direction explains, and how it does so best."""
    first = trials[places[0]]
    if not first.weight:
        t, norm = float(along[places[0]]), float(norms[places[0]])
        return t**2, first, t / max(norm, 1e-300) * first.unit_gain
    span = Span(unit[:, places].T @ unit[:, places], norms[places])
    own, t_own = [trials[k] for k in places], along[places]
    return float(span.decrease(t_own)), combined(own, span.gains(t_own)), 1.0


def independent(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the columns' span; tiny directions are dropped.

    The columns are scaled first.
    """
    norm = np.linalg.norm(columns, axis=0)
    scaled: FloatArray = columns[:, norm > 0] / norm[norm > 0]
    if not scaled.shape[1]:
        return scaled
    u, s, _ = np.linalg.svd(scaled, full_matrices=False)
    basis: FloatArray = u[:, s > 1e-7 * s[0]]
    return basis


def without(vectors: FloatArray, basis: FloatArray) -> FloatArray:
    """Return vectors (samples,) or columns less what an orthonormal basis spans of them."""
    projected: FloatArray = vectors - basis @ (basis.T @ vectors)
    return projected


def _threshold(gram: FloatArray, seen: Sequence[tuple[list[int], Span]]) -> float:
    """Quantile of the largest decrease that white noise makes along directions and spans.

    `gram` is that of the unit directions, `seen` has the places of those that are in spans.
    """
    if not len(gram):
        return np.inf
    values, vectors = np.linalg.eigh(gram)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    noise = np.random.default_rng(_SEED).standard_normal((_DRAWS, len(gram)))
    drawn = noise @ root.T
    single = np.ones(len(gram), dtype=bool)
    single[[k for places, _ in seen for k in places]] = False
    every = [*(drawn[:, single] ** 2).T, *(span.decrease(drawn[:, p]) for p, span in seen)]
    largest = np.max(every, axis=0)
    return float(np.quantile(largest, 1.0 - thresholds().false_alarm))
