r"""Devices that do not belong to the others: leave one out, predict it, compare.

Without device i the others have mean mu, its standard error s_mu and spread tau. If i is one of
them, its estimate is

    theta_i ~ N(mu, s_i^2 + tau^2 + s_mu^2),    z_i = (theta_i - mu) / sqrt(s_i^2 + tau^2 + s_mu^2)

with Student's t of n - 2 degrees of freedom as the distribution of z, since tau is estimated
(W. Viechtbauer and M. W.-L. Cheung, Res. Synth. Methods 1 (2010) 112: studentized deleted
residuals). A device far out widens tau and hides others, so those already found are left out of the
others' mean and spread, and all are tested again, until no more are found (forward search).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy
from numpy.typing import ArrayLike

from psa_casadi.errors import InputError
from psa_casadi.population.mixed_regression import MOST_STEPS, PRECISION, mixed_regression
from psa_casadi.population.several_tests import LIMIT, Adjustment, adjusted
from psa_casadi.units import FloatArray

#: The others must be so many; rounds after which the search ends.
FEWEST, _ROUNDS = 3, 20
#: At most this share of the devices may be outliers: else they are a second kind.
_MOST = 0.3
#: Numbers in one matrix while devices are left out in turn.
_AT_ONCE = 2_000_000
BoolArray = npt.NDArray[np.bool_]
IndexArray = npt.NDArray[np.int_]


@dataclass(frozen=True, eq=False)
class Outliers:
    """z (n,), its two-sided p value, the adjusted one, and which devices are told."""

    z: FloatArray
    p: FloatArray
    p_adjusted: FloatArray
    found: BoolArray


def outliers(
    theta: ArrayLike, errors: ArrayLike, how: Adjustment = "benjamini-hochberg"
) -> Outliers:
    """Return how far every device lies from what the others predict.

    `theta` (n,) are estimates, `errors` (n,) their standard errors, in one unit.

    Raises:
        InputError: there are fewer than four devices.
    """
    y, s = np.asarray(theta, dtype=float), np.asarray(errors, dtype=float)
    if y.size <= FEWEST:
        raise InputError(f"{y.size} devices have no outliers that could be told; give more.")
    found = np.zeros(y.size, dtype=np.bool_)
    z, p, corrected = _tested(y, s, found, how)
    for _ in range(_ROUNDS):
        more = found | (corrected < LIMIT)
        if (more == found).all() or more.sum() > _MOST * y.size or (~more).sum() <= FEWEST:
            break
        found = more
        z, p, corrected = _tested(y, s, found, how)
    return Outliers(z, p, corrected, corrected < LIMIT)


def _tested(
    y: FloatArray, s: FloatArray, apart: BoolArray, how: Adjustment
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return z, p and adjusted p of every device against the others that are not `apart`."""
    kept = ~apart
    z, dof = np.empty(y.size), np.full(y.size, kept.sum() - 2)
    z[kept] = _left_out(y[kept], s[kept])
    if apart.any():
        whole = mixed_regression(y[kept], s[kept])
        spread = s[apart] ** 2 + whole.tau**2 + whole.covariance[0, 0]
        z[apart], dof[apart] = (y[apart] - whole.b[0]) / np.sqrt(spread), whole.dof
    p = np.asarray(2.0 * scipy.stats.t.sf(np.abs(z), dof))
    return z, p, adjusted(p, how)


def _left_out(y: FloatArray, s: FloatArray) -> FloatArray:
    """Return z of every device against all others, (n,); blocks of devices at once.

    The mean and tau of `mixed_regression` without columns, in closed form.
    """
    n = y.size
    unit = float(np.median(s))
    y, variance = (y - np.median(y)) / unit, (s / unit) ** 2
    block = max(1, _AT_ONCE // n)
    parts = [_block(y, variance, np.arange(k, min(k + block, n))) for k in range(0, n, block)]
    return np.concatenate(parts)


def _block(y: FloatArray, variance: FloatArray, left_out: IndexArray) -> FloatArray:
    others = np.ones((left_out.size, y.size))
    others[np.arange(left_out.size), left_out] = 0.0
    tau2, dof = np.zeros(left_out.size), y.size - 2
    for _ in range(MOST_STEPS):
        w = others / (variance + tau2[:, None])
        total = w.sum(axis=1)
        mean = (w @ y) / total
        rest = (w * (y - mean[:, None])) ** 2  # (w r)^2
        q = np.sum(rest * (variance + tau2[:, None]), axis=1)
        step = np.where(q > dof, (q - dof) / np.maximum(rest.sum(axis=1), 1e-300), 0.0)
        if np.all(step <= PRECISION * tau2):
            break
        tau2 += step
    scale = np.maximum(1.0, q / dof)
    return np.asarray((y[left_out] - mean) / np.sqrt(variance[left_out] + tau2 + scale / total))
