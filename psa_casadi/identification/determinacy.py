"""What the records determine: covariance, intervals, correlations, information of a record."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit
from psa_casadi.identification.fitting.prediction import predict_record
from psa_casadi.identification.fitting.unknowns import (
    LINEAR_PRIOR,
    LOG_PRIOR,
    memory_prior,
    memory_starts,
)
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import Interval
from psa_casadi.records.noise import autocovariance, convolved
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment

#: A parameter with a standard error above this, in ordinary changes or ln units, is undetermined.
DETERMINED_WIDTH = 0.5
#: Standard deviation of ln(k_P / k_B) where it is assumed: within a factor of two.
ASSUMED_RATIO_SPREAD = 0.7
#: Smallest eigenvalue over the largest, negative, that is still rounding.
_ROUNDING = 1e-9
NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Determinacy:
    """Intervals (95 %), covariance and correlations (k, k) in the order of `names`, what is open.

    `covariance` is that of the values in SI units.
    """

    names: tuple[str, ...]
    intervals: Mapping[str, Interval]
    standard_errors: Mapping[str, float]
    covariance: FloatArray
    correlations: FloatArray
    undetermined: tuple[str, ...]
    on_bound: tuple[str, ...]


def determinacy(
    fit: Fit,
    experiments: Sequence[Experiment],
    *,
    not_unique: Sequence[str] = (),
    assumed: FloatArray | None = None,
) -> Determinacy:
    """Return what a fit determines.

    `not_unique` names parameters that equally good fits differ in; `assumed` (size,) is the change
    of theta by one standard deviation of something assumed, which widens the intervals.

    Undetermined are these, parameters whose standard error exceeds half an ordinary change, or half
    a unit of the natural logarithm, and those that span decades and sit at the bottom of their
    range (a lag too short to show); `on_bound` lists those at any other end of their range. For the
    covariance see `covariance_of`.
    """
    unknowns = fit.unknowns
    count = len(unknowns.names)
    slopes = unknowns.slopes(fit.theta)
    covariance = covariance_of(fit, experiments)
    if assumed is not None:
        covariance = covariance + np.outer(assumed, assumed)
    of_values = slopes @ covariance[:count, :count] @ slopes.T
    errors: FloatArray = np.sqrt(np.maximum(np.diag(of_values), 0.0))
    intervals, undetermined, on_bound = {}, [], []
    for k, name in enumerate(unknowns.names):
        value, parameter = fit.model.values[name], fit.model.parameter(name)
        intervals[name] = interval_around(fit.model, name, float(errors[k]))
        log = parameter.log and value > 0.0
        size = value if log else parameter.typical(fit.model.values)
        edge = 1e-6 * abs(unknowns.scale[k])
        vanished = log and value - unknowns.low[k] <= edge
        if name in not_unique or vanished or errors[k] > DETERMINED_WIDTH * abs(size):
            undetermined.append(name)
        elif min(value - unknowns.low[k], unknowns.high[k] - value) <= edge:
            on_bound.append(name)
    scale: FloatArray = np.outer(errors, errors)
    return Determinacy(
        names=unknowns.names,
        intervals=intervals,
        standard_errors=dict(zip(unknowns.names, errors.tolist(), strict=True)),
        covariance=of_values,
        correlations=of_values / np.where(scale > 0, scale, 1.0),
        undetermined=tuple(undetermined),
        on_bound=tuple(on_bound),
    )


def interval_around(model: Model, name: str, error: float) -> Interval:
    """Return the 95 % interval of a parameter with a standard error in its unit.

    That of a parameter that spans decades is one of factors.
    """
    value, half = model.values[name], NORMAL_95 * error
    if model.parameter(name).log and value > 0.0:
        factor = float(np.exp(min(half / value, 50.0)))
        return Interval(value / factor, value * factor)
    return Interval(value - half, value + half)


def weighted_rows(
    fit: Fit, experiments: Sequence[Experiment]
) -> list[tuple[FloatArray, FloatArray]]:
    """Return Jacobian and residuals over their level, of every record and further column."""
    parts = [fit.of_record(experiments, r) for r in range(len(fit.sigma))]
    rows = [
        (fit.jacobian[p] / s, fit.residuals[p] / s) for p, s in zip(parts, fit.sigma, strict=True)
    ]
    rows += [(f.jacobian / f.level, f.residuals / f.level) for f in fit.further]
    return [row for row in rows if len(row[1])]


def covariance_of(
    fit: Fit, experiments: Sequence[Experiment], *, white: bool = False
) -> FloatArray:
    """Return the covariance (size, size) of theta, for residuals that may be coloured.

    The sandwich H^-1 (sum_r J_r^T C_r J_r / w_r^4 + P) H^-1 with H = sum_r J_r^T J_r / w_r^2 + P:
    w_r is the level that weighted record r or a further column, P the precision of the priors, C_r
    the Toeplitz matrix of the residual's autocovariance there, which `autocovariance` estimates.
    White residuals at the level w_r give H^-1, which is that if `white`. Source: White, Maximum
    likelihood estimation of misspecified models, Econometrica 50 (1982), with the stationary colour
    of Newey and West (1987).
    """
    precision = np.diag(1.0 / fit.unknowns.prior**2)
    curvature, spread = precision.copy(), precision.copy()
    for scaled, residuals in weighted_rows(fit, experiments):
        curvature += scaled.T @ scaled
        if white:
            continue
        lags = autocovariance(residuals)
        if lags[0] > 2.0 * np.sum(lags) - lags[0]:
            lags = lags[:1]  # colour never makes intervals shorter than white residuals do
        spread += scaled.T @ convolved(scaled, np.concatenate([lags[:0:-1], lags]))
    inverse = np.linalg.pinv(curvature, hermitian=True)
    if white:
        return np.asarray(inverse)
    sandwich: FloatArray = inverse @ spread @ inverse
    sandwich = 0.5 * (sandwich + sandwich.T)
    sizes = np.linalg.eigvalsh(sandwich)
    if sizes[0] >= -_ROUNDING * sizes[-1]:
        return sandwich
    # correlations cut off at their last lag are no covariance: what they add to white ones, then
    sizes, directions = np.linalg.eigh(spread - curvature)
    longer = (directions * np.maximum(sizes, 0.0)) @ directions.T
    more: FloatArray = inverse + inverse @ longer @ inverse
    return 0.5 * (more + more.T)


def assumed_ratio(fit: Fit, experiments: Sequence[Experiment]) -> FloatArray | None:
    """Return the change of theta (size,) by one standard deviation of the assumed ln(k_P / k_B).

    k_P / k_B sets the zero -(k_P + k_B)/(c_P + c_B) and the static gain, eqs. (11), (14). Where
    it is assumed and not searched, lags and masses carry its error: with c_P/k_P, m_P/k_P and all
    displacements held, d theta = -H^-1 J^T W dx/d ln(k_P / k_B). Forces keep their proportion to
    the assumed stiffness and carry none. None where k_P is searched or the model has none.
    """
    p, free = fit.model.values, fit.unknowns.names
    if "k_P" not in p or "k_P" in free:
        return None
    softer = 1.0 / (1.0 + p["k_P"] / p["k_B"])  # d ln force / d ln k_P at the same displacement
    forces = [n for n in ("k_L", "A", "beta", "gamma", "delta", "h_ref") if n in p]
    change = {n: softer * p[n] for n in forces} | {n: p[n] for n in ("k_P", "c_P", "m_P")}
    curvature = np.diag(1.0 / fit.unknowns.prior**2)
    pull = np.zeros(fit.unknowns.size)
    for r, (level, e) in enumerate(zip(fit.sigma, experiments, strict=True)):
        if not e.stop:
            continue
        scaled = fit.jacobian[fit.of_record(experiments, r)] / level
        start = fit.start(r)
        _, by_parameter, by_start = predict_record(
            fit.model, e.record, start, list(change), stop=e.stop, rtol=FIT_RTOL
        )
        moved = by_parameter @ np.array(list(change.values()))
        if "f_H" in start:
            moved += by_start[:, list(start).index("f_H")] * softer * start["f_H"]
        curvature += scaled.T @ scaled
        pull += scaled.T @ (moved[e.used[: e.stop]] / level)
    shift: FloatArray = -np.linalg.pinv(curvature, hermitian=True) @ pull * ASSUMED_RATIO_SPREAD
    return shift


def sizes_of(model: Model, names: Sequence[str]) -> FloatArray:
    """Return the unit of change of each parameter (k,): its value where searched in ln, else usual.

    In these units a standard error above 0.5 means undetermined.
    """
    parameters = [model.parameter(n) for n in names]
    return np.array(
        [model.values[p.name] if p.log else p.typical(model.values) for p in parameters]
    )


def prior_information(model: Model, names: Sequence[str]) -> FloatArray:
    """Return what is known before any record (k, k): a parameter's order of magnitude."""
    widths = [LOG_PRIOR if model.parameter(n).log else LINEAR_PRIOR for n in names]
    return np.diag(1.0 / np.array(widths) ** 2)


def record_information(
    model: Model,
    record: Record,
    names: Sequence[str],
    sigma: float,
    *,
    start: Mapping[str, float] | None = None,
    sizes: Mapping[str, float] | None = None,
    used: BoolArray | None = None,
) -> FloatArray:
    """Return J^T (1 - Q Q^T) J / sigma^2 (k, k) for parameter changes in units of `sizes_of`.

    J is the derivative of the predicted displacement at the `used` samples, Q spans what the
    unknown initial states of usual `sizes` (memories unless others are named; at rest without a
    `start`), which a fit would estimate with their weak priors, and the sensor's offset can
    imitate; sigma [m] is the white noise. The record needs no displacement. Raises SimulationError.
    """
    if sizes is None:
        sizes = {n: size for n, (size, _) in memory_starts(model).items()}
    start = dict.fromkeys(sizes, 0.0) if start is None else start
    # loose steps would make information: errors of a large derivative look like a direction
    _, by_parameter, by_start = predict_record(
        model, record, start, names, stop=record.n, rtol=FIT_RTOL
    )
    chosen = slice(None) if used is None else used
    wanted = by_parameter[chosen] * sizes_of(model, names) / sigma
    nuisance = by_start[chosen] * np.array([sizes[n] for n in start]) / sigma
    count = len(start)
    priors = {s.name: memory_prior(s) for s in model.structure.states}
    held = np.vstack([nuisance, np.diag([1.0 / priors[n] for n in start])])
    offset = np.append(np.ones(len(wanted)), np.zeros(count))
    basis, _ = np.linalg.qr(np.column_stack([offset, held]))
    padded = np.vstack([wanted, np.zeros((count, len(names)))])
    left = padded - basis @ (basis.T @ padded)
    information: FloatArray = left.T @ left
    return information


def standard_errors(information: FloatArray) -> FloatArray:
    """Return the standard errors (k,) of an information matrix."""
    return np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
