"""Effects that are linear in weights: what they could add lies in a span, seen as a whole.

There is one direction for each weight, at its ordinary size. With the whitened directions W over
the noise level, the residual r over it, and weights g with the prior N(0, s^2 I), s =
`LINEAR_PRIOR` (Bayesian linear regression),

    g = (W'W + I/s^2)^-1 W'r,    D = r'W g,

D the decrease of the sum of squares, that of the prior included. Noise alone makes D nearly a
chi-square variable of as many degrees of freedom as (W'W + I/s^2)^-1 W'W has trace.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.diagnosis.screening.probes import Direction
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.fitting.unknowns import LINEAR_PRIOR

FloatArray = npt.NDArray[np.float64]


def spans(trials: Sequence[Direction]) -> list[list[int]]:
    """Return the places of directions that belong together: those of a span, or single ones."""
    found: dict[object, list[int]] = {}
    for k, d in enumerate(trials):
        others = tuple(v for n, v in d.values.items() if n not in d.effect.linear)
        found.setdefault((d.effect.name, others) if d.weight else k, []).append(k)
    return list(found.values())


def combined(directions: Sequence[Direction], gains: FloatArray) -> Direction:
    """Return the direction along which all weights of a span move at once by their gains (m,)."""
    first = directions[0]
    values = {**first.values, **dict.fromkeys(first.effect.linear, 0.0)}
    for d, gain in zip(directions, gains, strict=True):
        values[d.weight] = float(gain) * d.values[d.weight]
    every = zip(*(d.further for d in directions), strict=True)
    return Direction(
        first.effect,
        values,
        first.memory,
        1.0,
        np.column_stack([d.column for d in directions]) @ gains,
        one_sided=False,
        finite=False,
        further=tuple(np.column_stack(own) @ gains for own in every),
    )


def declared(directions: Sequence[Direction]) -> FloatArray:
    """Return the gains (m,) of a span's directions at the effect's declared weights."""
    own = {p.name: p.value for p in directions[0].effect.parameters}
    return np.array([own[d.weight] / d.values[d.weight] for d in directions])


@dataclass(frozen=True, eq=False)
class Span:
    """Directions of a span: the `gram` (m, m) of their unit vectors, their `norms` over the noise.

    Residuals come as projections t (..., m) on the unit vectors, over the noise level.
    """

    gram: FloatArray
    norms: FloatArray

    @cached_property
    def information(self) -> FloatArray:
        """W'W (m, m)."""
        found: FloatArray = self.norms[:, None] * self.gram * self.norms
        return found

    @cached_property
    def covariance(self) -> FloatArray:
        """That of the weights (m, m), with their prior."""
        weighted = self.information + np.eye(len(self.norms)) / LINEAR_PRIOR**2
        found: FloatArray = np.linalg.inv(weighted).astype(np.float64)
        return found

    def gains(self, t: FloatArray) -> FloatArray:
        """Return the weights (..., m), in ordinary sizes, that fit best."""
        found: FloatArray = (t * self.norms) @ self.covariance
        return found

    def decrease(self, t: FloatArray) -> FloatArray:
        """Return D (...), less what noise makes of more weights than one, at least 0.

        Compared with the threshold for single directions, noise passes it as rarely.
        """
        removed = np.sum(self.gains(t) * t * self.norms, axis=-1)
        found: FloatArray = np.maximum(removed - self.surplus, 0.0).astype(np.float64)
        return found

    @cached_property
    def surplus(self) -> float:
        """What a chi-square that is passed as rarely as a false alarm is above that of one."""
        freedom = max(float(np.sum(self.covariance * self.information)), 1.0)
        share = thresholds().false_alarm
        largest, of_one = (
            2.0 * float(scipy.special.gammainccinv(0.5 * f, share)) for f in (freedom, 1.0)
        )
        return largest - of_one

    @cached_property
    def penalties(self) -> FloatArray:
        """What the evidence loses by each combination of the weights (m,), rising."""
        values = np.linalg.eigvalsh(self.information)
        found: FloatArray = 0.5 * np.log1p(LINEAR_PRIOR**2 * np.maximum(values, 0.0))
        return found

    def detectable(self, gains: FloatArray) -> float:
        """Return the multiple of these weights (m,) that is as large as the noise."""
        power = float(gains @ self.information @ gains)
        return 1.0 / math.sqrt(power) if power > 0.0 else math.inf
