"""What the data determine: intervals, correlations, and parameters that the prior holds."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.fit import Fit
from psa_casadi.identification.noise import correlation_inflation
from psa_casadi.variables import Interval

FloatArray = npt.NDArray[np.float64]

#: A parameter with a standard error above this, in ordinary changes or ln units, is undetermined.
DETERMINED_WIDTH = 0.5
_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Determinacy:
    """Intervals (95 %), correlations (k, k) in the order of `names`, and what is left open."""

    names: tuple[str, ...]
    intervals: Mapping[str, Interval]
    standard_errors: Mapping[str, float]
    correlations: FloatArray
    undetermined: tuple[str, ...]
    on_bound: tuple[str, ...]


def determinacy(fit: Fit) -> Determinacy:
    """Return what a fit determines.

    Covariance is the inverse of J^T J / s^2 + priors, where s^2 is the larger of noise and residual
    variance, times an inflation for correlated residuals. `undetermined` lists parameters whose
    standard error exceeds half an ordinary change, or half a unit of the natural logarithm.
    """
    unknowns = fit.unknowns
    count = len(unknowns.names)
    covariance = covariance_of(fit)
    slopes = unknowns.slopes(fit.theta)
    of_values = slopes @ covariance[:count, :count] @ slopes.T
    errors: FloatArray = np.sqrt(np.diag(of_values))
    intervals, undetermined, on_bound = {}, [], []
    for k, name in enumerate(unknowns.names):
        value, half = fit.model.values[name], _NORMAL_95 * errors[k]
        if unknowns.log[k]:
            factor = float(np.exp(min(half / value, 50.0)))
            intervals[name] = Interval(value / factor, value * factor)
        else:
            intervals[name] = Interval(value - half, value + half)
        parameter = fit.model.parameter(name)
        size = value if parameter.log else parameter.typical(fit.model.values)
        if errors[k] > DETERMINED_WIDTH * abs(size):
            undetermined.append(name)
        if min(value - unknowns.low[k], unknowns.high[k] - value) <= 1e-6 * abs(unknowns.scale[k]):
            on_bound.append(name)
    scale: FloatArray = np.outer(errors, errors)
    return Determinacy(
        names=unknowns.names,
        intervals=intervals,
        standard_errors=dict(zip(unknowns.names, errors.tolist(), strict=True)),
        correlations=of_values / np.where(scale > 0, scale, 1.0),
        undetermined=tuple(undetermined),
        on_bound=tuple(on_bound),
    )


def covariance_of(fit: Fit) -> FloatArray:
    """Return the covariance (size, size) of theta."""
    weights = residual_weights(fit)
    scaled = fit.jacobian / weights[:, None]
    information = scaled.T @ scaled + np.diag(1.0 / fit.unknowns.prior**2)
    return np.linalg.pinv(information, hermitian=True).astype(np.float64)


def residual_weights(fit: Fit) -> FloatArray:
    """Standard deviation of every residual as the fit left it, inflated for correlation."""
    level = max(fit.rms, min(fit.sigma)) * sqrt(correlation_inflation(fit.residuals))
    return np.full(len(fit.residuals), level)
