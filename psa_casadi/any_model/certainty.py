"""How sure the parameters of a fit are: standard errors under noise of its own colour."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.fit import FittedOutput, OdeFit
from psa_casadi.records.noise import filtered
from psa_casadi.variables import Interval

FloatArray = npt.NDArray[np.float64]

#: A parameter with a larger standard error than this, over its ordinary change, is not determined.
_UNDETERMINED = 0.5
#: Half a 95 % interval over the standard error.
_NORMAL = 1.96
#: Correlations of neighbours below this count as none.
_WHITE = 0.05


@dataclass(frozen=True)
class Certainty:
    """Standard errors and 95 % intervals of the parameters by name, and what is wrong with some.

    The interval of a parameter that spans decades is that of its logarithm; none goes beyond the
    parameter's bounds. `undetermined` are not
    told by the records, `on_bound` sit on a bound of their range.
    """

    errors: dict[str, float]
    intervals: dict[str, Interval]
    undetermined: tuple[str, ...]
    on_bound: tuple[str, ...]


def certainty(fit: OdeFit) -> Certainty:
    """Return how sure a fit's parameters are.

    Cov = (sum_j J_j^T J_j / s_j^2 + prior)^-1 over outputs j, residuals and derivatives whitened by
    the correlation of the residual's neighbours, s_j the rms that is left.
    """
    information = np.diag(1.0 / fit.unknowns.prior**2)
    for output in fit.outputs:
        white = _whitened(output, np.column_stack([output.residuals, output.jacobian]))
        level = max(float(np.sqrt(np.mean(white[:, 0] ** 2))), 1e-300)
        information = information + white[:, 1:].T @ white[:, 1:] / level**2
    names = fit.unknowns.names
    spread = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))[: len(names)]
    slopes = np.diag(fit.unknowns.slopes(fit.theta))
    errors, intervals, on_bound = {}, {}, []
    for k, name in enumerate(names):
        value, error = fit.model.values[name], float(spread[k] * abs(slopes[k]))
        errors[name] = error
        factor = float(np.exp(min(_NORMAL * spread[k], 300.0)))
        half = _NORMAL * error
        low, high = float(fit.unknowns.low[k]), float(fit.unknowns.high[k])
        least, most = value - half, value + half
        if fit.unknowns.log[k]:
            least, most = value / factor, value * factor
        intervals[name] = Interval(max(least, low), min(most, high))
        edge = 1e-6 * (high - low) if np.isfinite(high - low) else 0.0
        if value <= low + edge or value >= high - edge:
            on_bound.append(name)
    undetermined = [n for n, s in zip(names, spread, strict=True) if s > _UNDETERMINED]
    return Certainty(errors, intervals, tuple(undetermined), tuple(on_bound))


def _whitened(output: FittedOutput, columns: FloatArray) -> FloatArray:
    r = _correlation(output)
    if r < _WHITE:
        return columns
    parts = np.split(columns, np.cumsum(output.lengths)[:-1])
    return np.vstack([filtered([1.0, -r], [1.0], part)[1:] for part in parts])


def _correlation(output: FittedOutput) -> float:
    """Return the correlation of neighbours within the experiments, 0.98 at most."""
    top = sum(float(p[1:] @ p[:-1]) for p in output.parts)
    return min(top / max(float(output.residuals @ output.residuals), 1e-300), 0.98)
