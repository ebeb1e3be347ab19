"""The density that is sampled: a fit's likelihood and weak priors, with exact gradients."""

from dataclasses import dataclass

import numpy as np

from psa_casadi.identification.fitting.levenberg_marquardt import Evaluate
from psa_casadi.posterior.within import Within
from psa_casadi.units import FloatArray


@dataclass(frozen=True, eq=False)
class Block:
    """The weighted residuals `rows` of one record, whose noise level is unknown.

    `count` is how many independent samples they are worth: fewer than rows where they are coloured.
    """

    rows: slice
    count: float


@dataclass(frozen=True, eq=False)
class Density:
    """ln p(u | records), up to a constant, with its gradient, in whitened coordinates u.

    ln p = -sum_b (m_b / 2) ln |r_b|^2 - |r_p|^2 / 2 + ln |d theta / d z|, with the weighted
    residuals r_b of every block and m_b the samples that they are worth: each record's noise level
    has Jeffreys' prior 1 / sigma and is integrated out. r_p are the rows outside the blocks: weak
    priors and further columns, whose levels are known. theta lies within its bounds (`Within`), and
    z = z_0 + L u, with the factor L of the covariance at the fit, so that u has nearly the
    covariance 1. The gradient is that of J^T r, with the sensitivities' exact Jacobian.
    """

    evaluate: Evaluate
    blocks: tuple[Block, ...]
    within: Within
    centre: FloatArray
    factor: FloatArray

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.centre)

    def theta(self, u: FloatArray) -> FloatArray:
        """Return the fit's coordinates (size,) at u."""
        return self.within.theta(self.centre + self.factor @ u)[0]

    def __call__(self, u: FloatArray) -> tuple[float, FloatArray]:
        """Return ln p and its gradient (size,) at u; -inf where the model cannot be simulated."""
        z = self.centre + self.factor @ u
        theta, slope, bend = self.within.theta(z)
        with np.errstate(all="ignore"):
            found = self.evaluate(theta) if np.isfinite(theta).all() else None
            value, by_theta = (-np.inf, np.zeros_like(u)) if found is None else self._sum(*found)
            value += float(np.sum(np.log(np.abs(slope))))
            gradient = self.factor.T @ (by_theta * slope + bend)
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            return -np.inf, np.zeros_like(u)
        return value, gradient

    def _sum(self, residual: FloatArray, jacobian: FloatArray) -> tuple[float, FloatArray]:
        rest = np.ones(len(residual), dtype=bool)
        value, pull = 0.0, np.zeros_like(residual)
        for block in self.blocks:
            own = residual[block.rows]
            power = float(own @ own)
            value -= 0.5 * block.count * float(np.log(power))
            pull[block.rows] = own * (block.count / power)
            rest[block.rows] = False
        pull[rest] = residual[rest]
        value -= 0.5 * float(residual[rest] @ residual[rest])
        return value, -(jacobian.T @ pull)
