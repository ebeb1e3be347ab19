r"""Batches that differ, and drift over the date, told from the spread of devices and their noise.

Batches: theta_ij = mu_j + u_ij + e_ij with one spread tau within all batches (`mixed_regression`
with a column for each). That all mu_j are equal is tested by

    F = [Q_0 - Q_J] / (J - 1) / max(1, Q_J / (n - J)),    F ~ F(J - 1, n - J)

with the weights of the model with batches in both sums; one batch against the others by a contrast
of the means with Student's t, adjusted over the batches (Holm).

Drift: theta_i = a + c t_i + u_i + e_i; c with Student's t (Knapp and Hartung 2003).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from psa_casadi.errors import InputError
from psa_casadi.population.mixed_regression import MixedFit, mixed_regression
from psa_casadi.population.several_tests import adjusted
from psa_casadi.units import FloatArray


@dataclass(frozen=True)
class Batch:
    """The mean of one batch with its 95 % interval, and how it differs from the others' mean."""

    name: str
    devices: int
    mean: float
    interval: tuple[float, float]
    differs_by: float
    p_adjusted: float


@dataclass(frozen=True)
class BatchTest:
    """Whether batches differ: F with its p value, spread within them, and each batch."""

    f: float
    p_value: float
    within: float
    batches: tuple[Batch, ...]


@dataclass(frozen=True)
class Drift:
    """Change of theta over time, in its unit for each unit of time, and its p value."""

    slope: float
    interval: tuple[float, float]
    p_value: float


def batch_test(theta: ArrayLike, errors: ArrayLike, names: Sequence[str]) -> BatchTest:
    """Test whether the batches `names` (n,) differ; theta and errors (n,) have one unit.

    Raises:
        InputError: there are fewer than two batches, or no more devices than batches.
    """
    y, s = np.asarray(theta, dtype=float), np.asarray(errors, dtype=float)
    kinds = list(dict.fromkeys(names))
    if len(kinds) < 2:
        raise InputError("There is one batch only, so none can differ; give another.")
    x = np.array([[float(name == kind) for kind in kinds] for name in names])
    fit = mixed_regression(y, s, x)
    weights = 1.0 / (s**2 + fit.tau**2)
    inside = float(np.sum(weights * (y - x @ fit.b) ** 2))
    mean = float(np.sum(weights * y) / np.sum(weights))
    between = float(np.sum(weights * (y - mean) ** 2)) - inside
    f = between / (len(kinds) - 1) / max(1.0, inside / fit.dof)
    contrasts = [_against_others(fit, k) for k in range(len(kinds))]
    corrected = adjusted([p for _, p in contrasts], "bonferroni")
    batches = tuple(
        Batch(
            kind, int(x[:, k].sum()), float(fit.b[k]), fit.interval(k), contrasts[k][0],
            float(corrected[k]),
        )
        for k, kind in enumerate(kinds)
    )  # fmt: skip
    p_value = float(scipy.stats.f.sf(f, len(kinds) - 1, fit.dof))
    return BatchTest(f, p_value, fit.tau, batches)


def _against_others(fit: MixedFit, k: int) -> tuple[float, float]:
    """Return a batch's mean less the plain mean of the others', and its p value."""
    count = fit.b.size
    contrast: FloatArray = np.full(count, -1.0 / (count - 1))
    contrast[k] = 1.0
    differs = float(contrast @ fit.b)
    error = float(np.sqrt(contrast @ fit.covariance @ contrast))
    return differs, float(2.0 * scipy.stats.t.sf(abs(differs) / error, fit.dof))


def drift(theta: ArrayLike, errors: ArrayLike, time: ArrayLike) -> Drift:
    """Return how theta changes over `time` (n,).

    Raises:
        InputError: there are fewer than three devices, or all have one date.
    """
    t = np.asarray(time, dtype=float)
    if np.ptp(t) == 0.0:
        raise InputError("All devices have one date, so no drift can be told; give other dates.")
    span = float(np.ptp(t))
    x = np.column_stack([np.ones(t.size), (t - t.mean()) / span])
    fit = mixed_regression(theta, errors, x)
    low, high = fit.interval(1)
    return Drift(float(fit.b[1]) / span, (low / span, high / span), fit.significance(1))
