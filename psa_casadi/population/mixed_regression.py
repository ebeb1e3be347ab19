r"""Regression over devices that differ by more than the noise of each: random effects.

    theta_i = X_i b + u_i + e_i,    u_i ~ N(0, tau^2),    e_i ~ N(0, s_i^2)

The estimates theta_i come with known standard errors s_i; tau is the spread of the devices
themselves. For a given tau, b is the weighted least squares with w_i = 1/(s_i^2 + tau^2), and

    Q(tau^2) = sum_i w_i (theta_i - X_i b)^2  ~  chi^2(n - p).

tau^2 is where Q equals n - p (Paule and Mandel 1982), 0 where Q(0) is less; its interval is where Q
equals the quantiles of chi^2 (Q profile). Intervals of b have Student's t with n - p degrees of
freedom and a variance that is scaled by max(1, Q/(n - p)), so that they are honest about few
devices.

Sources: R. C. Paule and J. Mandel, J. Res. NBS 87 (1982) 377; R. DerSimonian and R. Kacker,
Contemp. Clin. Trials 28 (2007) 105; W. Viechtbauer, Statist. Med. 26 (2007) 37 (Q profile); G.
Knapp and J. Hartung, Statist. Med. 22 (2003) 2693; C. Roever, G. Knapp and T. Friede, BMC Med. Res.
Methodol. 15 (2015) 99 (the scale of 1 or more).
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from psa_casadi.errors import InputError
from psa_casadi.units import FloatArray

#: What intervals are meant to hold.
LEVEL = 0.95
#: Newton's steps for tau^2 end when one is below this share of it, or after so many.
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

    def significance(self, k: int) -> float:
        """Return the two-sided p value of a coefficient that is 0 (Student's t)."""
        t = abs(float(self.b[k])) / float(self.standard_errors[k])
        return float(2.0 * scipy.stats.t.sf(t, self.dof))


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
            f"{y.size} devices cannot tell {x.shape[1]} figures and their spread; give more."
        )
    if not (np.all(np.isfinite(s)) and np.all(s > 0.0) and np.all(np.isfinite(y))):
        raise InputError("A standard error is not positive; leave that device out.")
    if np.linalg.matrix_rank(x) < x.shape[1]:
        raise InputError("The groups or dates are not distinct enough to tell their effects.")
    unit = float(np.median(s))  # so that tau^2 is a number of ordinary size
    y, s = y / unit, s / unit
    dof = y.size - x.shape[1]
    tau2 = solve_tau2(y, s, x, float(dof))
    ends = [
        solve_tau2(y, s, x, float(scipy.stats.chi2.ppf(0.5 + h * LEVEL / 2, dof))) for h in (1, -1)
    ]
    b, covariance, q = _weighted(y, s, x, tau2)
    scale = max(1.0, q / dof)
    q0 = _weighted(y, s, x, 0.0)[2]
    return MixedFit(
        b * unit,
        covariance * scale * unit**2,
        float(np.sqrt(tau2)) * unit,
        (float(np.sqrt(ends[0])) * unit, float(np.sqrt(ends[1])) * unit),
        q0,
        float(scipy.stats.chi2.sf(q0, dof)),
        dof,
    )


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
    """Return b, its covariance and Q for a given tau^2."""
    root = 1.0 / np.sqrt(s**2 + tau2)
    q, r = np.linalg.qr(x * root[:, None])
    inverse = np.linalg.inv(r)
    b = inverse @ (q.T @ (y * root))
    rest = (y - x @ b) * root
    return b, inverse @ inverse.T, float(rest @ rest)
