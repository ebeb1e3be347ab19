"""What the records determine: covariance, intervals, correlations, information of a record.

What the data know of parameters that they leave open: formulas in which their errors cancel.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from math import nan
from typing import Any, Literal

import numpy as np

from psa_casadi.common.display import Worded
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
from psa_casadi.model.variables import Interval, Values
from psa_casadi.records.noise import autocovariance, convolved
from psa_casadi.records.record import Record

#: A parameter with a standard error above this, in ordinary changes or ln units, is undetermined.
DETERMINED_WIDTH = 0.5
#: Standard deviation of ln(k_P / k_B) where it is assumed: within a factor of two.
ASSUMED_RATIO_SPREAD = 0.7
#: Smallest eigenvalue over the largest, negative, that is still rounding.
_ROUNDING = 1e-9


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
    fit: Fit, *, not_unique: Sequence[str] = (), assumed: FloatArray | None = None
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
    covariance = covariance_of(fit)
    if assumed is not None:
        covariance = covariance + np.outer(assumed, assumed)
    of_values = slopes @ covariance[:count, :count] @ slopes.T
    errors: FloatArray = np.sqrt(np.maximum(np.diag(of_values), 0.0))
    intervals, undetermined, on_bound = {}, [], []
    for k, name in enumerate(unknowns.names):
        value, parameter = fit.model.values[name], fit.model.parameter(name)
        log = parameter.log and value > 0.0
        intervals[name] = Interval.of(parameter, value, float(errors[k]))
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


def weighted_rows(fit: Fit) -> list[tuple[FloatArray, FloatArray]]:
    """Return Jacobian and residuals over their level, of every record and further column."""
    parts = zip(fit.parts, fit.sigma, strict=True)
    rows = [(fit.jacobian[p] / s, fit.residuals[p] / s) for p, s in parts]
    rows += [(f.jacobian / f.level, f.residuals / f.level) for f in fit.further]
    return [row for row in rows if len(row[1])]


def covariance_of(fit: Fit, *, white: bool = False) -> FloatArray:
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
    for scaled, residuals in weighted_rows(fit):
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


def assumed_ratio(fit: Fit) -> FloatArray | None:
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
    for r, (level, e) in enumerate(zip(fit.sigma, fit.experiments, strict=True)):
        if not e.stop:
            continue
        scaled = fit.jacobian[fit.parts[r]] / level
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


#: A combination is known if its relative standard error is below this ...
KNOWN = 0.1
#: ... and each parameter that trades off in it would alone give it an error this much larger.
SURER = 5.0
#: Parameters with a relative standard error above this may trade off with others.
WEAK = 0.05
#: Two parameters whose correlation is above this are tied.
TIED = 0.5
_STEP = 1e-5
_FORCES = ("N/V", "N/(V.s)", "N", "kg", "N.s/m", "N/m")


@dataclass(frozen=True)
class Formula:
    """A formula of parameter values, as it is written, and what it means.

    `physical` is False for products and ratios that were tried only because nothing else fits.
    """

    text: str
    meaning: str
    physical: bool = True

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters in it."""
        return tuple(dict.fromkeys(re.findall(r"[A-Za-z]\w*", self.text)))

    @cached_property
    def _code(self) -> Any:
        """The formula as code: a space between two factors is a product."""
        product = re.sub(r"(?<=[\w)]) (?=[\w(])", "*", self.text)
        return compile(product.replace("^", "**"), self.text, "eval")

    def value(self, p: Values) -> float:
        """Return the formula's value."""
        return float(eval(self._code, {"__builtins__": {}}, dict(p)))


_LAGS = ("tau", "R_s C_p", "c/k", "c_P/k_P", "c_B/k_B")
_ZERO = "(c_P + c_B)/(k_P + k_B)"
#: Combinations with a meaning; Yang and Zhu 2015, eqs. (8), (10)-(15), (23), (33), (34).
FORMULAS = tuple(
    Formula(text, meaning)
    for text, meaning in {
        "c_P/k_P": "the wafers' lag",
        "c_B/k_B": "the bonding layers' lag",
        "m_P/k_P": "the wafers' resonance",
        "m_B/k_B": "the bonding layers' resonance",
        "m/k": "the resonance",
        "m_P/c_P": "the wafers' quick decay",
        "m_B/c_B": "the bonding layers' quick decay",
        "c_P + c_B": "the sum of the dampings",
        _ZERO: "the zero of the mechanics",
        "k_L + A": "the slope after a reversal",
        "k_L (1/k_P + 1/k_B)": "the static gain without hysteresis",
        "(k_L + A) (1/k_P + 1/k_B)": "the slope after a reversal",
        "beta A/(k_L + A)": "the bend of the loop",
        "gamma A/(k_L + A)": "the bend of the loop",
        "beta + gamma": "the bend of a growing f_H",
        "gamma - beta": "the bend of a shrinking f_H",
    }.items()
)


def physical_formulas(values: Values, free: Sequence[str]) -> list[Formula]:
    """Return the formulas with a meaning that hold two or more free parameters.

    `FORMULAS`, and sums of two and more lags, the mechanics' with and without its zero, eq. (15).
    A lag without a free parameter is a constant, which would only make the sum look sure.
    """
    known = [
        f for f in (Formula(lag, "") for lag in _LAGS)
        if set(f.names) <= set(values) and set(f.names) & set(free)
    ]  # fmt: skip
    sums = []
    for count in range(2, len(known) + 1):
        for chosen in combinations([f.text for f in known], count):
            sums.append(" + ".join(chosen))
            if {"c_P/k_P", "c_B/k_B"} <= set(chosen):
                sums.append(f"{sums[-1]} - {_ZERO}")
    every = (*FORMULAS, *(Formula(text, "the sum of the lags") for text in sums))
    return [f for f in every if set(f.names) <= set(values) and len(set(f.names) & set(free)) > 1]


def monomials(values: Values, free: Sequence[str]) -> Iterator[Formula]:
    """Yield products and ratios of two and of three free parameters that are not zero."""
    sized = [n for n in free if values[n] != 0.0]
    pairs = ((1, 1), (1, -1), (2, 1), (2, -1), (1, 2), (1, -2))
    triples = tuple((1, *signs) for signs in product((1, -1), repeat=2))
    for count, every in ((2, pairs), (3, triples)):
        for names, powers in product(combinations(sized, count), every):
            factors = [
                f"{n}^{abs(k)}" if abs(k) > 1 else n for n, k in zip(names, powers, strict=True)
            ]
            above, below = (
                " ".join(f for f, k in zip(factors, powers, strict=True) if sign * k > 0)
                for sign in (1, -1)
            )
            text = f"{above}/({below})" if " " in below else f"{above}/{below}"
            meaning = "the ratio" if below else "the product"
            yield Formula(text if below else above, meaning, physical=False)


@dataclass(frozen=True)
class Combination(Worded):
    """Parameters that trade off against each other, and what of them is known.

    `known` is the formula that the data determine with the relative standard error
    `relative_error` (nan where it follows from the model's form), `meaning` what it is; None and ""
    where none is known. `kind` is `only` where nothing but the formula is determined, `traded`
    where the parameters are determined worse than it (with the errors `alone`), `group` where no
    formula of them is known, `tied` where the first trades off with the others, `free` where the
    data hardly depend on any; `product` and `force` follow from the model's form.
    """

    kind: Literal["only", "traded", "group", "tied", "free", "product", "force"]
    parameters: tuple[str, ...]
    known: str | None = None
    relative_error: float = nan
    meaning: str = ""
    alone: tuple[float, ...] = ()


def free_combinations(
    model: Model, determinacy: Determinacy, *, force_scale_given: bool = False
) -> tuple[Combination, ...]:
    """Return what is known of parameters that trade off, in as few and simple formulas as possible.

    For parameters with a standard error above 5 %. A formula explains those in it whose
    errors cancel: it is known to 10 %, and to a fifth of the error that each of them alone would
    give it (delta method with the covariance of the values). Formulas with a meaning are tried
    first (`FORMULAS`, sums of lags), those that explain much with few parameters and small errors
    before others; then products and ratios of two or three for what is undetermined. What remains
    is listed with the parameters it is correlated with. The scale of force and the product with an
    assumed capacitance follow from the model's form; they come last.
    """
    judge = _Judge(model, determinacy)
    results: list[Combination] = []
    candidates = [
        c for f in physical_formulas(model.values, determinacy.names) if (c := judge.known(f))
    ]
    open_ones = {n for n in determinacy.names if judge.relative(n) > WEAK}
    while news := [c for c in candidates if open_ones & set(c[0].parameters)]:
        best, _ = min(news, key=lambda c: c[1] / len(open_ones & set(c[0].parameters)))
        results.append(best)
        open_ones -= set(best.parameters)
    left = [n for n in determinacy.undetermined if n in open_ones]
    for formula in monomials(model.values, determinacy.names):
        simple = judge.known(formula) if set(left) & set(formula.names) else None
        if simple:
            results.append(simple[0])
            left = [n for n in left if n not in simple[0].parameters]
    results += judge.rest(left)
    if "R_s" in determinacy.names and "C_p" in model.values and "C_p" not in determinacy.names:
        results.append(Combination("product", ("R_s", "C_p"), "R_s C_p"))
    if not force_scale_given:
        scaled = tuple(p.name for p in model.structure.parameters if p.unit in _FORCES)
        results.append(Combination("force", scaled))
    return tuple(results)


class _Judge:
    """Standard errors of formulas, from the covariance of the values."""

    def __init__(self, model: Model, determinacy: Determinacy) -> None:
        self._model, self._determinacy = model, determinacy

    def known(self, formula: Formula) -> tuple[Combination, float] | None:
        """Return what is known far better than its parameters, else None.

        With it comes a rank, the smallest for a formula that is sure and short: its standard error
        over what one of the parameters would make it, doubled by each parameter that is free.
        """
        result, names = self._determinacy, self._determinacy.names
        order = formula.names if formula.physical else names
        free = [n for n in order if n in names and n in formula.names]
        values, gradient = self._model.values, np.zeros(len(names))
        for n in free:
            step = _STEP * self._size(n)
            up, down = (formula.value({**values, n: values[n] + h}) for h in (step, -step))
            gradient[names.index(n)] = (up - down) / (2.0 * step)
        value = abs(formula.value(values))
        error = float(np.sqrt(max(float(gradient @ result.covariance @ gradient), 0.0)))
        alone = {n: abs(gradient[names.index(n)]) * result.standard_errors[n] for n in free}
        parts = tuple(n for n in free if alone[n] >= SURER * error)
        if error > KNOWN * value or len(parts) < (2 if formula.physical else len(free)):
            return None
        only = any(n in result.undetermined for n in parts)
        combination = Combination(
            "only" if only else "traded", parts, formula.text, error / value, formula.meaning,
            () if only else tuple(self.relative(n) for n in parts),
        )  # fmt: skip
        return combination, error / max(alone.values()) * 2.0 ** len(free)

    def rest(self, names: Sequence[str]) -> Iterator[Combination]:
        """Yield undetermined parameters that no formula explains, with what they are tied to."""
        left, alone = list(names), []
        while left:
            group = [left.pop(0)]
            for member in group:  # grows while it is walked
                group += [n for n in left if self._tied(member, n)]
                left = [n for n in left if n not in group]
            other_names = [n for n in self._determinacy.names if n not in names]
            others = [n for n in other_names if self._tied(group[0], n)]
            if len(group) > 1:
                yield Combination("group", tuple(group))
            elif others:
                yield Combination("tied", (*group, *others))
            else:
                alone += group
        if alone:
            yield Combination("free", tuple(alone))

    def relative(self, name: str) -> float:
        """Return a parameter's standard error over its value."""
        return self._determinacy.standard_errors[name] / self._size(name)

    def _size(self, name: str) -> float:
        values = self._model.values
        return abs(values[name]) or self._model.parameter(name).typical(values)

    def _tied(self, one: str, other: str) -> bool:
        row, column = (self._determinacy.names.index(n) for n in (one, other))
        return bool(one != other and abs(self._determinacy.correlations[row, column]) > TIED)
