"""Screening: which effects, alone or several at once, would lower the residual.

Every direction is prewhitened, the fitted parameters' directions are projected out, and the
decrease of the sum of squares is compared with one threshold for the maximum over all directions,
drawn from Gaussian noise along the actual directions (family-wise; Davies 1987, Hansen 1996).

A base fit bends itself to several missing causes at once, so that the effect that explains most
alone need not be one of them. Linear in the gains, the best set of each size (best subset
regression) costs one small system of equations each, over products of directions that are known.

    ln B = (n - k)/2 ln(S_before / S_after) - 1/2 ln det(1 + P H P)

S are sums of squares of n whitened residuals, of which k unknowns of the model before have taken
their part, the noise level being estimated from the data; H is the information on the unknowns that
the effect adds, those of the model before projected out, and P their prior standard deviations. An
unknown that the data leave open costs nothing, a sharp one costs what its prior range is wider than
its interval (MacKay, Neural Computation 4 (1992), 415).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy

from psa_casadi.common.units import FloatArray, IndexArray
from psa_casadi.diagnosis.colour import Colour, colour_of
from psa_casadi.diagnosis.probes import Direction, Span, combined, declared, spans
from psa_casadi.diagnosis.task import LIMITS, Thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import Further
from psa_casadi.identification.fitting.unknowns import LINEAR_PRIOR

_DRAWS = 4000
_SEED = 20150810  # of the threshold's simulation: the same data give the same verdict
#: Share of the best score below which an effect is not fitted; number of the others that are, and
#: largest number where more have a score above the last share of the best one.
_WORTH, _LEADING, _MOST, _AS_NEAR = 0.1, 4, 7, 0.4
#: Fewest degrees of freedom for a noise level: its standard error is 1/sqrt(2 f), here 18 %.
_FREEDOM = 16


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
        """Return the effects that are to be fitted, the best one first."""
        best = self.best_by_effect()
        if not best:
            return []
        top = next(iter(best.values())).decrease
        limit = max(self.threshold, _WORTH * top)
        near = [s for s in best.values() if s.decrease >= max(limit, _AS_NEAR * top)]
        count = max(_LEADING, min(len(near), _MOST))
        return [name for name, score in best.items() if score.decrease >= limit][:count]


def screen(
    fit: Fit,
    trials: Sequence[Direction],
    known: Sequence[FloatArray | None] | None = None,
    *,
    colour: Colour | None = None,
    limits: Thresholds = LIMITS,
) -> Screening:
    """Score the directions on a fit's residuals.

    `known` is the colour of the records' noise where it is known without a model; `colour` replaces
    the whole estimate.
    """
    columns = channel_columns(fit, trials)
    if colour is None:
        lengths = [part.size for part in fit.record_residuals]
        colour = _unexplained(fit.channels[0], columns[0], lengths, known)
    if not colour.further:
        rows = zip(fit.further, columns[1:], strict=True)
        colour = replace(colour, further=tuple(_unexplained(f, c, f.lengths) for f, c in rows))
    basis = independent(whitened_jacobian(fit, colour))
    residual = without(whitened_residuals(fit, colour), basis)
    whole = colour.whiten_all(columns)
    unit, norms = _unit_vectors(without(whole, basis), whole, _LEFT)
    t = unit.T @ residual / colour.level
    scores, span_places = [], []
    gram = unit.T @ unit
    for places in spans(trials):
        k, direction = places[0], trials[places[0]]
        if direction.weight:
            sizes = norms[places] / colour.level
            span = Span(gram[np.ix_(places, places)], sizes, limits.false_alarm)
            span_places.append((places, span))
            scores.append(_of_span([trials[k] for k in places], span, t[places]))
            continue
        norm = norms[k] or np.inf
        decrease = float(t[k] ** 2) if norms[k] and (t[k] > 0 or not direction.finite) else 0.0
        gain = float(t[k] * colour.level / norm * direction.unit_gain)
        least = float(direction.unit_gain * colour.level / norm) if norms[k] else np.inf
        scores.append(Score(direction, decrease, gain, least))
    scores.sort(key=lambda s: -s.decrease)
    return Screening(tuple(scores), _threshold(gram, span_places, limits.false_alarm), colour)


def _unexplained(
    f: Further, columns: FloatArray, lengths: Sequence[int],
    known: Sequence[FloatArray | None] | None = None,
) -> Colour:  # fmt: skip
    """Return the colour of what neither fit nor directions explain of a channel.

    Where directions leave too few degrees of freedom, of what the fit alone does not explain.
    """
    fitted = independent(f.jacobian)
    every = independent(np.hstack([f.basis, fitted, without(columns, fitted)]))
    if len(f.residuals) - every.shape[1] < _FREEDOM:
        every = independent(np.hstack([f.basis, fitted]))
    return colour_of(without(f.residuals, every), lengths, known, every)


def _unit_vectors(
    left: FloatArray, whole: FloatArray, least: float
) -> tuple[FloatArray, FloatArray]:
    """Return the unit vectors of columns (n, k), and their norms (k,).

    Both are 0 for a column of which no more than the share `least` of the `whole` is `left`.
    """
    norms = np.linalg.norm(left, axis=0)
    usable = norms > least * np.linalg.norm(whole, axis=0)
    return np.where(usable, left / np.where(usable, norms, 1.0), 0.0), np.where(usable, norms, 0.0)


def _of_span(directions: Sequence[Direction], span: Span, t: FloatArray) -> Score:
    """Return the score of a span's best direction; `t` (m,) are the residual's projections."""
    return Score(
        combined(directions, span.gains(t)),
        float(span.decrease(t)),
        1.0,
        span.detectable(declared(directions)),
        float(np.sum(span.penalties)) - 0.5 * span.surplus,
    )


def whitened_residuals(fit: Fit, colour: Colour) -> FloatArray:
    """Return the whitened residuals (samples,), those of the further columns below."""
    return colour.whiten_all([f.residuals for f in fit.channels])


def whitened_jacobian(fit: Fit, colour: Colour) -> FloatArray:
    """Return the whitened derivatives by theta (samples, size), the further columns' below."""
    return colour.whiten_all([f.jacobian for f in fit.channels])


def channel_columns(fit: Fit, trials: Sequence[Direction]) -> list[FloatArray]:
    """Return for every channel what the directions change in it (samples, directions)."""
    return [
        np.hstack([np.zeros((len(f.residuals), 0)), *(d.columns[k][:, None] for d in trials)])
        for k, f in enumerate(fit.channels)
    ]


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
    fit: Fit, added: FloatArray, trials: Sequence[Direction], colour: Colour, limits: Thresholds
) -> tuple[float, dict[str, Copy]]:
    """Return the power of a contribution over the noise's, and how each effect can copy it.

    `added` (samples,) [m] is what another effect adds to the prediction. The fitted parameters are
    projected out of it and of the trial directions.
    """
    basis = independent(colour.whiten(fit.jacobian))
    target = without(colour.whiten(added), basis)
    power = float(target @ target)
    result: dict[str, Copy] = {}
    for name in dict.fromkeys(d.effect.name for d in trials):
        matching = [d for d in trials if d.effect.name == name]
        columns = np.column_stack([d.columns[0] for d in matching])
        free = without(colour.whiten(columns), basis)
        unit, sizes = _unit_vectors(free, columns, _LEFT)
        if power <= 0 or not sizes.any():
            continue
        share = float(np.sum((independent(free[:, sizes > 0.0]).T @ target) ** 2)) / power
        along = unit.T @ target / colour.level
        ways = [
            _copy(matching, p, unit, sizes / colour.level, along, limits) for p in spans(matching)
        ]
        _, direction, gain = max(ways, key=lambda w: w[0])
        result[name] = Copy(share, direction, gain)
    return power / colour.level**2, result


def _copy(
    trials: Sequence[Direction],
    places: list[int],
    unit: FloatArray,
    norms: FloatArray,
    along: FloatArray,
    limits: Thresholds,
) -> tuple[float, Direction, float]:
    """Return how much of a target a span or a direction explains, and how it does so best."""
    first, t, sizes = trials[places[0]], along[places], norms[places]
    if not first.weight:
        return float(t[0]) ** 2, first, float(t[0]) / max(float(sizes[0]), 1e-300) * first.unit_gain
    span = Span(unit[:, places].T @ unit[:, places], sizes, limits.false_alarm)
    return float(span.decrease(t)), combined([trials[k] for k in places], span.gains(t)), 1.0


def independent(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the columns' span; tiny directions are dropped.

    The columns are scaled first.
    """
    norm = np.linalg.norm(columns, axis=0)
    scaled: FloatArray = columns[:, norm > 0] / norm[norm > 0]
    if not scaled.shape[1]:
        return scaled
    try:
        u, s, _ = np.linalg.svd(scaled, full_matrices=False)
    except np.linalg.LinAlgError:  # divide and conquer may fail where the plain method does not
        u, s, _ = scipy.linalg.svd(scaled, full_matrices=False, lapack_driver="gesvd")
    return u[:, s > 1e-7 * s[0]]


def without(vectors: FloatArray, basis: FloatArray) -> FloatArray:
    """Return vectors (samples,) or columns less what an orthonormal basis spans of them."""
    return vectors - basis @ (basis.T @ vectors)


def _threshold(
    gram: FloatArray, in_spans: Sequence[tuple[list[int], Span]], false_alarm: float
) -> float:
    """Quantile of the largest decrease that white noise makes along directions and spans.

    `gram` is that of the unit directions, `in_spans` has the places of those in spans.
    """
    if not len(gram):
        return np.inf
    values, vectors = np.linalg.eigh(gram)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    noise = np.random.default_rng(_SEED).standard_normal((_DRAWS, len(gram)))
    drawn = noise @ root.T
    single = np.ones(len(gram), dtype=bool)
    single[[k for places, _ in in_spans for k in places]] = False
    every = [*(drawn[:, single] ** 2).T, *(span.decrease(drawn[:, p]) for p, span in in_spans)]
    largest = np.max(every, axis=0)
    return float(np.quantile(largest, 1.0 - false_alarm))


#: A direction of which less than this is new besides the fitted parameters is left out: of a set,
#: and alone.
_NEW, _LEFT = 1e-4, 1e-6


@dataclass(frozen=True, eq=False)
class Together:
    """Directions of different effects, the gains that fit best together, and what they promise.

    `promise` is n/2 ln(S / (S - D)): S the whitened sum of squares, D its decrease. What the
    evidence loses by more weights than one of a span (see `spans`) is taken off.
    """

    directions: tuple[Direction, ...]
    gains: tuple[float, ...]
    promise: float

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(d.effect.name for d in self.directions)


def _ways(
    trials: Sequence[Direction], gram: FloatArray, sizes: FloatArray, limits: Thresholds
) -> tuple[dict[str, IndexArray], FloatArray, FloatArray]:
    """Return the directions (ways, m) of each effect, what priors add to the gram, and costs.

    `gram` is that of unit directions, `sizes` are theirs over the noise level, 0 where the fitted
    parameters can follow one. `costs` stand at the first place of a span: what the evidence loses
    by its weights but for the best determined combination. A span that lacks a weight is left out.
    """
    table: dict[str, list[list[int]]] = {}
    weak, cost = np.full(len(trials), _NEW**2), np.zeros(len(trials))
    for places in spans(trials):
        first, of_span = trials[places[0]], sizes[places]
        if first.weight:
            span = Span(gram[np.ix_(places, places)], of_span, limits.false_alarm)
            weak[places] += 1.0 / np.maximum(LINEAR_PRIOR * of_span, _NEW) ** 2
            cost[places[0]] = float(np.sum(span.penalties[:-1]))
        if first.weight or of_span[0]:
            table.setdefault(first.effect.name, []).append(places)
    most = {name: max(map(len, of_span)) for name, of_span in table.items()}
    whole = {n: [p for p in of_span if len(p) == most[n]] for n, of_span in table.items()}
    return {n: np.array(of_span, dtype=np.int64) for n, of_span in whole.items()}, weak, cost


def _together(
    trials: Sequence[Direction],
    indices: Sequence[IndexArray],
    places: IndexArray,
    multiples: FloatArray,
    promise: float,
) -> Together:
    """Return the directions at these places with their multiples, those of a span as one."""
    ends = np.cumsum([p.shape[1] for p in indices])[:-1]
    directions, gains = [], []
    for of_one, sizes in zip(np.split(places, ends), np.split(multiples, ends), strict=True):
        these = [trials[int(k)] for k in of_one]
        one = combined(these, sizes) if these[0].weight else these[0]
        directions.append(one)
        gains.append(one.unit_gain if these[0].weight else float(sizes[0]) * one.unit_gain)
    return Together(tuple(directions), tuple(gains), promise)


def best_sets(
    fit: Fit,
    trials: Sequence[Direction],
    colour: Colour,
    size: int,
    texts: Sequence[Sequence[str]] = (),
    limits: Thresholds = LIMITS,
) -> list[Together]:
    """Return the best directions of every set of `size` effects, the best set first.

    The fitted parameters are free to follow. Gains have the sign that makes sense. Of sets that are
    the same but for effects that are `texts` only the best one is returned.
    """
    basis = independent(whitened_jacobian(fit, colour))
    residual = without(whitened_residuals(fit, colour), basis)
    columns = colour.whiten_all(channel_columns(fit, trials))
    unit, norms = _unit_vectors(without(columns, basis), columns, _NEW)
    gram, along = unit.T @ unit, unit.T @ residual
    positive = np.array([d.one_sided or d.finite for d in trials], dtype=bool)
    ways, weak, cost = _ways(trials, gram, norms / colour.level, limits)
    gram += np.diag(weak)
    total, n = float(residual @ residual), len(residual)
    sets = []
    for names in combinations(ways, size):
        if any(len(set(names) & set(group)) > 1 for group in texts):
            continue
        of_each = [ways[name] for name in names]
        grids = np.meshgrid(*(np.arange(len(p)) for p in of_each), indexing="ij")
        index = np.hstack([p[g.ravel()] for p, g in zip(of_each, grids, strict=True)])
        systems = gram[index[:, :, None], index[:, None, :]]
        gains = np.linalg.solve(systems, along[index][:, :, None])[:, :, 0]
        decrease = np.sum(gains * along[index], axis=1)
        decrease[np.any(positive[index] & (gains <= 0.0), axis=1)] = 0.0
        best = int(np.argmax(decrease))
        share = min(float(decrease[best]) / max(total, 1e-300), 1.0 - 1e-9)
        promise = -0.5 * n * float(np.log1p(-share)) - float(np.sum(cost[index[best]]))
        multiples = gains[best] / np.maximum(norms[index[best]], 1e-300)
        sets.append(_together(trials, of_each, index[best], multiples, promise))
    heads = {n: group[0] for group in texts for n in group}
    best_of: dict[frozenset[str], Together] = {}
    for each in sorted(sets, key=lambda t: -t.promise):
        best_of.setdefault(frozenset(heads.get(n, n) for n in each.names), each)
    return list(best_of.values())


def evidence(before: Fit, after: Fit, colour: Colour) -> float:
    """Return ln B of a fit with one more effect over the fit without it.

    The log-likelihoods of displacement and further columns add up, each with its noise level.
    """
    # what is left besides the unknowns to estimate the noise
    share = max(len(before.residuals) - before.unknowns.size, 0) / len(before.residuals)
    gained = share * _gained(before.residuals, after.residuals, colour)
    gained += sum(further_gains(before, after, colour).values())
    pairs = zip(colour.further, after.further, strict=True)
    further = [_level(f.residuals, c, f.straight) for c, f in pairs]
    return gained - occam(before, after, colour, [_level(after.residuals, colour, 0.0), *further])


def occam(before: Fit, after: Fit, colour: Colour, levels: Sequence[float]) -> float:
    """Return 1/2 ln det(1 + P H P), what the evidence loses by the unknowns that a fit adds.

    `levels` are those of the noise in every channel.
    """
    rows = zip(colour.each, after.channels, levels, strict=True)
    jacobian = np.concatenate([c.whiten(f.jacobian) / max(level, 1e-300) for c, f, level in rows])
    known, other = before.unknowns, after.unknowns
    added = [k for k, n in enumerate(other.names) if n not in known.names]
    for record, states in enumerate(other.started):
        first, old_ones = other.first(record), known.started[record]
        added += [first + k for k, s in enumerate(states) if s not in old_ones]
    kept = [k for k in range(after.unknowns.size) if k not in added]
    new, old = jacobian[:, added], jacobian[:, kept]
    free = new - old @ np.linalg.lstsq(old, new, rcond=1e-10)[0]
    prior = after.unknowns.prior[added]
    scaled = free * np.where(np.isfinite(prior), prior, 1.0)
    return 0.5 * float(np.linalg.slogdet(np.eye(len(added)) + scaled.T @ scaled)[1])


def further_gains(before: Fit, after: Fit, colour: Colour) -> dict[str, float]:
    """Return what every further column adds to the log-likelihood of a fit over another one."""
    rows = zip(colour.further, before.further, after.further, strict=True)
    return {n.column: _gained(b.residuals, n.residuals, c, n.straight) for c, b, n in rows}


def _gained(before: FloatArray, after: FloatArray, colour: Colour, straight: float = 0.0) -> float:
    """Return n/2 ln(S_before / S_after), each with what the sensor's form may cost."""
    levels = [_level(r, colour, straight) for r in (before, after)]
    return len(after) * float(np.log(max(levels[0], 1e-300) / max(levels[1], 1e-300)))


def _level(residual: FloatArray, colour: Colour, straight: float) -> float:
    """Return the rms of a whitened residual, at least that of what is `straight`."""
    return float(np.hypot(np.sqrt(np.mean(colour.whiten(residual) ** 2)), straight))


def estimated(before: Fit, screening: Screening) -> dict[str, float]:
    """Return every effect's ln B as its trial directions estimate it, without a full fit.

    Linear in the gain g with prior N(0, s^2), s = `LINEAR_PRIOR` ordinary sizes, and estimated to
    sigma: ln B = (n - k)/2 ln(S / (S - D)) - 1/2 ln(1 + s^2/sigma^2), D the decrease of S; averaged
    over the probe values, each as likely as the others.
    """
    table: dict[str, list[float]] = {}
    white = whitened_residuals(before, screening.colour)
    total = float(np.sum(white**2))
    for score in screening.scores:
        share = min(score.decrease * screening.colour.level**2 / max(total, 1e-300), 1.0 - 1e-9)
        gained = -0.5 * (len(white) - before.unknowns.size) * float(np.log1p(-share))
        table.setdefault(score.direction.effect.name, []).append(_linear(score, gained))
    return {name: float(np.logaddexp.reduce(v) - np.log(len(v))) for name, v in table.items()}


def levelled(
    evidences: Mapping[str, float], texts: Sequence[Sequence[str]], judged: Collection[str] = ()
) -> dict[str, float]:
    """Return the evidence with that of the best one for all effects that are `texts`.

    They are the same but for a form that none of them is known to have. Where some of a group are
    `judged` by a full fit, the best one of those counts.
    """
    values = dict(evidences)
    for group in texts:
        present = [n for n in group if n in values]
        known = [n for n in present if n in judged] or present
        values |= dict.fromkeys(present, max((values[n] for n in known), default=0.0))
    return values


def temperature(largest: float, limits: Thresholds = LIMITS) -> float:
    """Return what evidence is divided by before it becomes a probability.

    The effects are not the true equations, so that their evidence differs by more than noise, and
    the more the larger the `largest` one is: that of a whole model over the plain base, as the form
    of each of its parts is approximate.
    """
    return max(limits.temperature, limits.temperature_share * largest)


def probabilities(
    evidences: Mapping[str, float], whole: float = 0.0, limits: Thresholds = LIMITS
) -> dict[str, float]:
    """Return the probability of each effect, on condition that one of them is the cause.

    `whole` is the evidence of the model with the cause over the plain base, where the effects'
    evidence is that over other causes and a better base.
    """
    if not evidences:
        return {}
    inputs = np.array(list(evidences.values()))
    values = inputs / temperature(max(whole, float(np.max(inputs))), limits)
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


def _linear(score: Score, gained: float) -> float:
    if score.penalty is not None:
        return gained - score.penalty
    if not np.isfinite(score.detectable_gain) or score.detectable_gain == 0.0:
        return 0.0
    width = LINEAR_PRIOR * score.direction.unit_gain / abs(score.detectable_gain)
    return gained * width**2 / (1.0 + width**2) - 0.5 * float(np.log1p(width**2))
