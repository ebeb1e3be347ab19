"""The statistics of a population: random effects, outliers, batches, drift, many tests.

Regression over devices that differ by more than the noise of each: random effects.

    theta_i = X_i b + u_i + e_i,    u_i ~ N(0, tau^2),    e_i ~ N(0, s_i^2)

The estimates theta_i come with known standard errors s_i; tau is the spread of the devices
themselves. At a tau, b is the weighted least squares with w_i = 1/(s_i^2 + tau^2), and

    Q(tau^2) = sum_i w_i (theta_i - X_i b)^2  ~  chi^2(n - p).

tau^2 is where Q equals n - p (Paule and Mandel 1982), 0 where Q(0) is less; its interval is where Q
equals the quantiles of chi^2 (Q profile). Intervals of b have Student's t with n - p degrees of
freedom and a variance that is scaled by max(1, Q/(n - p)), so that they are honest about few
devices.

Sources: R. C. Paule and J. Mandel, J. Res. NBS 87 (1982) 377; R. DerSimonian and R. Kacker,
Contemp. Clin. Trials 28 (2007) 105; W. Viechtbauer, Statist. Med. 26 (2007) 37 (Q profile); G.
Knapp and J. Hartung, Statist. Med. 22 (2003) 2693; C. Roever, G. Knapp and T. Friede, BMC Med. Res.
Methodol. 15 (2015) 99 (the scale of 1 or more).

Devices that do not belong to the others: leave one out, predict it, compare.

Without device i the others have mean mu, its standard error s_mu and spread tau. If i is one of
them, its estimate is

    theta_i ~ N(mu, s_i^2 + tau^2 + s_mu^2),    z_i = (theta_i - mu) / sqrt(s_i^2 + tau^2 + s_mu^2)

with Student's t of n - 2 degrees of freedom as the distribution of z, since tau is estimated
(W. Viechtbauer and M. W.-L. Cheung, Res. Synth. Methods 1 (2010) 112: studentized deleted
residuals). A device far out widens tau and hides others, so outliers are left out of the others'
mean and spread, and all are tested again, until there are no more (forward search).

Batches that differ, and drift over the date, beyond the spread of devices and their noise.

Batches: theta_ij = mu_j + u_ij + e_ij with one spread tau within all batches (`mixed_regression`
with a column for each). That all mu_j are equal is tested by

    F = [Q_0 - Q_J] / (J - 1) / max(1, Q_J / (n - J)),    F ~ F(J - 1, n - J)

with the weights of the model with batches in both sums; one batch against the others by a contrast
of the means with Student's t, adjusted over the batches (Holm).

Drift: theta_i = a + c t_i + u_i + e_i; c with Student's t (Knapp and Hartung 2003).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import BoolArray, FloatArray

Adjustment = Literal["benjamini-hochberg", "bonferroni"]
#: Adjusted p values below this are significant.
LIMIT = 0.05


def adjusted(p: ArrayLike, how: Adjustment = "benjamini-hochberg") -> FloatArray:
    """Return adjusted p values, shape (n,) as `p`.

    `bonferroni` (Holm's step-down form) bounds the chance of one false alarm or more.
    `benjamini-hochberg` bounds the expected share of false ones among the significant; where
    nothing is true both bounds are the same.

    Sources: S. Holm, Scand. J. Statist. 6 (1979) 65; Y. Benjamini and Y. Hochberg, J. R. Statist.
    Soc. B 57 (1995) 289.
    """
    values = np.asarray(p, dtype=float)
    if values.size == 0:
        return values
    if how == "benjamini-hochberg":
        return np.asarray(scipy.stats.false_discovery_control(values), dtype=float)
    order = np.argsort(values)
    steps = np.maximum.accumulate(values[order] * np.arange(values.size, 0, -1))
    result = np.empty_like(values)
    result[order] = np.minimum(1.0, steps)
    return result


#: What intervals are meant to hold.
LEVEL = 0.95
#: Newton's steps for tau^2 end when one is below this share of it, and their largest number.
PRECISION, MOST_STEPS = 1e-10, 200


@dataclass(frozen=True, eq=False)
class MixedFit:
    """Coefficients b (p,) with covariance (p, p), tau with its interval, and the Q test of tau = 0.

    All in the unit of theta. `p_value` is the chance of a Q(0) as large as this without a spread of
    the devices. `dof` is n - p.
    """

    b: FloatArray
    covariance: FloatArray
    tau: float
    tau_interval: tuple[float, float]
    q: float
    p_value: float
    dof: int

    @property
    def standard_errors(self) -> FloatArray:
        """Standard errors of b, shape (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def interval(self, k: int = 0) -> tuple[float, float]:
        """Return the 95 % interval of a coefficient."""
        wide = float(scipy.stats.t.ppf(0.5 + 0.5 * LEVEL, self.dof))
        half = wide * float(self.standard_errors[k])
        return float(self.b[k]) - half, float(self.b[k]) + half


def _two_sided(t: FloatArray | float, dof: FloatArray | int) -> FloatArray:
    """Return the two-sided p values of Student's t."""
    return np.asarray(2.0 * scipy.stats.t.sf(np.abs(t), dof))


def mixed_regression(
    theta: ArrayLike, errors: ArrayLike, columns: ArrayLike | None = None
) -> MixedFit:
    """Fit b and tau; `columns` X has shape (n, p), by default one of ones (the mean).

    `theta` (n,) are estimates, `errors` (n,) their standard errors in the same unit.

    Raises:
        InputError: there are no more devices than coefficients, an error is not positive, or the
            columns depend on one another.
    """
    y, s = np.asarray(theta, dtype=float), np.asarray(errors, dtype=float)
    x = np.ones((y.size, 1)) if columns is None else np.asarray(columns, dtype=float)
    if y.size <= x.shape[1]:
        raise InputError(
            f"{y.size} devices cannot determine {x.shape[1]} figures and their spread; give more."
        )
    if not (np.all(np.isfinite(s)) and np.all(s > 0.0) and np.all(np.isfinite(y))):
        raise InputError("A standard error is not positive; leave that device out.")
    if np.linalg.matrix_rank(x) < x.shape[1]:
        raise InputError("The groups or dates are not distinct enough to separate their effects.")
    unit = float(np.median(s))  # so that tau^2 is a number of ordinary size
    y, s = y / unit, s / unit
    dof = y.size - x.shape[1]
    tau2 = solve_tau2(y, s, x, float(dof))
    ends = [
        solve_tau2(y, s, x, float(scipy.stats.chi2.ppf(0.5 + h * LEVEL / 2, dof))) for h in (1, -1)
    ]
    tau, low, high = (float(np.sqrt(t)) * unit for t in (tau2, *ends))
    b, covariance, q = _weighted(y, s, x, tau2)
    covariance = covariance * max(1.0, q / dof) * unit**2
    q0 = _weighted(y, s, x, 0.0)[2]
    p_value = float(scipy.stats.chi2.sf(q0, dof))
    return MixedFit(b * unit, covariance, tau, (low, high), q0, p_value, dof)


def solve_tau2(y: FloatArray, s: FloatArray, x: FloatArray, wanted: float) -> float:
    """Return tau^2 at which Q is `wanted`, 0 where it is less at once.

    Newton's steps from 0 never pass it, since Q falls with tau^2 and is convex; dQ/dtau^2 is
    - sum w_i^2 (theta_i - X_i b)^2 (DerSimonian and Kacker 2007).
    """
    tau2 = 0.0
    for _ in range(MOST_STEPS):
        b, _, q = _weighted(y, s, x, tau2)
        steepness = float(np.sum(((y - x @ b) / (s**2 + tau2)) ** 2))
        step = (q - wanted) / steepness if q > wanted else 0.0
        tau2 += step
        if step <= PRECISION * tau2:
            break
    return tau2


def _weighted(
    y: FloatArray, s: FloatArray, x: FloatArray, tau2: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return b, its covariance and Q at a tau^2."""
    root = 1.0 / np.sqrt(s**2 + tau2)
    q, r = np.linalg.qr(x * root[:, None])
    inverse = np.linalg.inv(r)
    b = inverse @ (q.T @ (y * root))
    rest = (y - x @ b) * root
    return b, inverse @ inverse.T, float(rest @ rest)


#: Fewest others; rounds after which the search ends.
FEWEST, _ROUNDS = 3, 20
#: At most this share of the devices may be outliers: else they are a second kind.
_MOST = 0.3
#: Numbers in one matrix while devices are left out in turn.
_AT_ONCE = 2_000_000


@dataclass(frozen=True, eq=False)
class Outliers:
    """z (n,), its two-sided p value, the adjusted one, and which devices are outlying."""

    z: FloatArray
    p: FloatArray
    p_adjusted: FloatArray
    outlying: BoolArray


def outliers(theta: ArrayLike, errors: ArrayLike) -> Outliers:
    """Return how far every device lies from what the others predict.

    `theta` (n,) are estimates, `errors` (n,) their standard errors, in one unit.

    Raises:
        InputError: there are fewer than four devices.
    """
    y, s = np.asarray(theta, dtype=float), np.asarray(errors, dtype=float)
    if y.size <= FEWEST:
        raise InputError(f"{y.size} devices are too few to detect outliers; give more.")
    apart = np.zeros(y.size, dtype=np.bool_)
    z, p, corrected = _tested(y, s, apart)
    for _ in range(_ROUNDS):
        more = apart | (corrected < LIMIT)
        if (more == apart).all() or more.sum() > _MOST * y.size or (~more).sum() <= FEWEST:
            break
        apart = more
        z, p, corrected = _tested(y, s, apart)
    return Outliers(z, p, corrected, corrected < LIMIT)


def _tested(
    y: FloatArray, s: FloatArray, apart: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return z, p and adjusted p of every device against the others that are not `apart`."""
    kept = ~apart
    z, dof = np.empty(y.size), np.full(y.size, kept.sum() - 2)
    z[kept] = _left_out(y[kept], s[kept])
    if apart.any():
        whole = mixed_regression(y[kept], s[kept])
        spread = s[apart] ** 2 + whole.tau**2 + whole.covariance[0, 0]
        z[apart], dof[apart] = (y[apart] - whole.b[0]) / np.sqrt(spread), whole.dof
    p = _two_sided(z, dof)
    return z, p, adjusted(p)


def _left_out(y: FloatArray, s: FloatArray) -> FloatArray:
    """Return z of every device against all others, (n,); blocks of devices at once.

    The mean and tau of `mixed_regression` without columns, in closed form.
    """
    n, dof = y.size, y.size - 2
    unit = float(np.median(s))
    y, variance = (y - np.median(y)) / unit, (s / unit) ** 2
    block, result = max(1, _AT_ONCE // n), []
    for first in range(0, n, block):
        left_out = np.arange(first, min(first + block, n))
        others = np.ones((left_out.size, n))
        others[np.arange(left_out.size), left_out] = 0.0
        tau2 = np.zeros(left_out.size)
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
        spread = variance[left_out] + tau2 + np.maximum(1.0, q / dof) / total
        result.append((y[left_out] - mean) / np.sqrt(spread))
    return np.concatenate(result)


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
    count = len(kinds)  # each batch less the plain mean of the others
    contrast = (count * np.eye(count) - 1.0) / (count - 1)
    differs = contrast @ fit.b
    errors_of = np.sqrt(np.diag(contrast @ fit.covariance @ contrast.T))
    corrected = adjusted(_two_sided(differs / errors_of, fit.dof), "bonferroni")
    batches = tuple(
        Batch(
            kind, int(x[:, k].sum()), float(fit.b[k]), fit.interval(k), float(differs[k]),
            float(corrected[k]),
        )
        for k, kind in enumerate(kinds)
    )  # fmt: skip
    p_value = float(scipy.stats.f.sf(f, len(kinds) - 1, fit.dof))
    return BatchTest(f, p_value, fit.tau, batches)


def drift(theta: ArrayLike, errors: ArrayLike, time: ArrayLike) -> Drift:
    """Return how theta changes over `time` (n,).

    Raises:
        InputError: there are fewer than three devices, or all have one date.
    """
    t = np.asarray(time, dtype=float)
    if np.ptp(t) == 0.0:
        raise InputError(
            "All devices have one date, so no drift can be determined; give other dates."
        )
    span = float(np.ptp(t))
    x = np.column_stack([np.ones(t.size), (t - t.mean()) / span])
    fit = mixed_regression(theta, errors, x)
    low, high = fit.interval(1)
    p = float(_two_sided(fit.b[1] / fit.standard_errors[1], fit.dof))
    return Drift(float(fit.b[1]) / span, (low / span, high / span), p)
