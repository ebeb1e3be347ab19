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
from psa_casadi.identification.fitting.fitted import Fitted

FloatArray = npt.NDArray[np.float64]

#: A direction of which less than this is new beside the fitted parameters is left out.
_NEW = 1e-4


@dataclass(frozen=True, eq=False)
class Together:
    """Directions of different effects, the gains that fit best together, and what they promise.

    `promise` is n/2 ln(S / (S - D)): S the whitened sum of squares, D its decrease.
    """

    directions: tuple[Direction, ...]
    gains: tuple[float, ...]
    promise: float

    @property
    def names(self) -> frozenset[str]:
        """Names of the effects."""
        return frozenset(d.effect.name for d in self.directions)


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
    usable = np.flatnonzero(norm > _NEW * np.linalg.norm(columns, axis=0))
    unit = free[:, usable] / norm[usable]
    gram, along = unit.T @ unit + _NEW**2 * np.eye(len(usable)), unit.T @ residual
    own = [trials[int(k)] for k in usable]
    positive = np.array([d.one_sided or d.finite for d in own], dtype=bool)
    of_effect: dict[str, list[int]] = {}
    for k, direction in enumerate(own):
        of_effect.setdefault(direction.effect.name, []).append(k)
    total, n = float(residual @ residual), len(residual)
    found = []
    for names in combinations(of_effect, size):
        if any(len(set(names) & set(group)) > 1 for group in alike):
            continue
        grids = np.meshgrid(*(of_effect[name] for name in names), indexing="ij")
        index = np.stack([g.ravel() for g in grids], axis=1)
        systems = gram[index[:, :, None], index[:, None, :]]
        gains = np.linalg.solve(systems, along[index][:, :, None])[:, :, 0]
        decrease = np.sum(gains * along[index], axis=1)
        decrease[np.any(positive[index] & (gains <= 0.0), axis=1)] = 0.0
        best = int(np.argmax(decrease))
        share = min(float(decrease[best]) / max(total, 1e-300), 1.0 - 1e-9)
        chosen = [own[k] for k in index[best]]
        sizes = gains[best] / norm[usable[index[best]]]
        found.append(
            Together(
                tuple(chosen),
                tuple(float(g) * d.unit_gain for g, d in zip(sizes, chosen, strict=True)),
                -0.5 * n * float(np.log1p(-share)),
            )
        )
    first = {n: group[0] for group in alike for n in group}
    best_of: dict[frozenset[str], Together] = {}
    for each in sorted(found, key=lambda t: -t.promise):
        best_of.setdefault(frozenset(first.get(n, n) for n in each.names), each)
    return list(best_of.values())
