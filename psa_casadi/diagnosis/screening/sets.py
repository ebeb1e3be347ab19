"""Screening of several effects at once: the sets of directions that explain most together.

A base fit bends itself to several missing causes at once, so that the effect that explains most
alone need not be one of them. Linear in the gains, the best set of so many effects (best subset
regression) costs one small system of equations each, over products of directions that are known.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise.colour import Colour
from psa_casadi.diagnosis.screening.probes import Direction
from psa_casadi.diagnosis.screening.screen import (
    further_columns,
    independent,
    whitened_jacobian,
    whitened_residuals,
    without,
)
from psa_casadi.diagnosis.screening.spans import Span, combined, spans
from psa_casadi.identification.fitting.unknowns import LINEAR_PRIOR, Fitted

FloatArray = npt.NDArray[np.float64]

#: A direction of which less than this is new beside the fitted parameters is left out.
_NEW = 1e-4


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
    trials: Sequence[Direction], gram: FloatArray, sizes: FloatArray
) -> tuple[dict[str, npt.NDArray[np.int64]], FloatArray, FloatArray]:
    """Return the directions (ways, m) of each effect, what priors add to the gram, and costs.

    `gram` is that of unit directions, `sizes` are theirs over the noise level, 0 where the fitted
    parameters can follow one. `costs` stand at the first place of a span: what the evidence loses
    by its weights but for the best told combination. A span that lacks a weight is left out.
    """
    found: dict[str, list[list[int]]] = {}
    weak, cost = np.full(len(trials), _NEW**2), np.zeros(len(trials))
    for places in spans(trials):
        first, own = trials[places[0]], sizes[places]
        if first.weight:
            span = Span(gram[np.ix_(places, places)], own)
            weak[places] += 1.0 / np.maximum(LINEAR_PRIOR * own, _NEW) ** 2
            cost[places[0]] = float(np.sum(span.penalties[:-1]))
        if first.weight or own[0]:
            found.setdefault(first.effect.name, []).append(places)
    most = {name: max(map(len, own)) for name, own in found.items()}
    whole = {n: [p for p in own if len(p) == most[n]] for n, own in found.items()}
    return {n: np.array(own, dtype=np.int64) for n, own in whole.items()}, weak, cost


def _together(
    trials: Sequence[Direction],
    own: Sequence[npt.NDArray[np.int64]],
    places: npt.NDArray[np.int64],
    multiples: FloatArray,
    promise: float,
) -> Together:
    """Return the directions at these places with their multiples, those of a span as one."""
    ends = np.cumsum([p.shape[1] for p in own])[:-1]
    directions, gains = [], []
    for of_one, sizes in zip(np.split(places, ends), np.split(multiples, ends), strict=True):
        these = [trials[int(k)] for k in of_one]
        whole = combined(these, sizes) if these[0].weight else these[0]
        directions.append(whole)
        gains.append(whole.unit_gain if these[0].weight else float(sizes[0]) * whole.unit_gain)
    return Together(tuple(directions), tuple(gains), promise)


def best_sets(
    fit: Fitted,
    trials: Sequence[Direction],
    colour: Colour,
    size: int,
    alike: Sequence[Sequence[str]] = (),
) -> list[Together]:
    """Return the best directions of every set of so many effects, the best set first.

    The fitted parameters are free to follow. Gains have the sign that makes sense. Of sets that are
    the same but for effects that are `alike` only the best one is returned.
    """
    basis = independent(whitened_jacobian(fit, colour))
    residual = without(whitened_residuals(fit, colour), basis)
    main = np.column_stack([d.column for d in trials])
    columns = colour.whiten_all(main, further_columns(fit, trials))
    free = without(columns, basis)
    norm = np.linalg.norm(free, axis=0)
    usable = norm > _NEW * np.linalg.norm(columns, axis=0)
    unit = np.where(usable, free / np.where(usable, norm, 1.0), 0.0)
    gram, along = unit.T @ unit, unit.T @ residual
    positive = np.array([d.one_sided or d.finite for d in trials], dtype=bool)
    ways, weak, cost = _ways(trials, gram, norm * usable / colour.level)
    gram += np.diag(weak)
    total, n = float(residual @ residual), len(residual)
    found = []
    for names in combinations(ways, size):
        if any(len(set(names) & set(group)) > 1 for group in alike):
            continue
        own = [ways[name] for name in names]
        grids = np.meshgrid(*(np.arange(len(p)) for p in own), indexing="ij")
        index = np.hstack([p[g.ravel()] for p, g in zip(own, grids, strict=True)])
        systems = gram[index[:, :, None], index[:, None, :]]
        gains = np.linalg.solve(systems, along[index][:, :, None])[:, :, 0]
        decrease = np.sum(gains * along[index], axis=1)
        decrease[np.any(positive[index] & (gains <= 0.0), axis=1)] = 0.0
        best = int(np.argmax(decrease))
        share = min(float(decrease[best]) / max(total, 1e-300), 1.0 - 1e-9)
        promise = -0.5 * n * float(np.log1p(-share)) - float(np.sum(cost[index[best]]))
        multiples = gains[best] / np.maximum(norm[index[best]], 1e-300)
        found.append(_together(trials, own, index[best], multiples, promise))
    heads = {n: group[0] for group in alike for n in group}
    best_of: dict[frozenset[str], Together] = {}
    for each in sorted(found, key=lambda t: -t.promise):
        best_of.setdefault(frozenset(heads.get(n, n) for n in each.names), each)
    return list(best_of.values())
