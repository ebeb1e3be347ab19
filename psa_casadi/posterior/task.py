"""What is sampled: the records as a fit has them, the priors, the fit, and the density there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.notes import Note
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.identification.fitting.fit import Fit, Objective, fit_from, unknowns_around
from psa_casadi.identification.fitting.levenberg_marquardt import Evaluate
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.identification.multistart import free_of
from psa_casadi.identification.own_model import identify_ode
from psa_casadi.identification.prepare import columns_of, prepared, with_levels
from psa_casadi.identification.refitting import noise_levels
from psa_casadi.identification.search import free_parameters
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import autocovariance
from psa_casadi.records.record import Record
from psa_casadi.records.split import Channel, Experiment, whole, without_gaps


@dataclass(frozen=True, eq=False)
class Within:
    """theta within `low` and `high` (size,) as a function of z on the whole line, one by one.

    Between two bounds theta = low + (high - low) / (1 + exp(-z)), beyond one alone theta = low +
    exp(z) or high - exp(z), elsewhere theta = z.
    """

    low: FloatArray
    high: FloatArray

    @property
    def _cases(self) -> list[BoolArray]:
        """Which coordinates have two bounds, a lower one (first of these cases), an upper one."""
        below, above = np.isfinite(self.low), np.isfinite(self.high)
        return [below & above, below, above]

    @property
    def bounded(self) -> BoolArray:
        """Which coordinates have a bound (size,)."""
        return np.isfinite(self.low) | np.isfinite(self.high)

    def z(self, theta: FloatArray) -> FloatArray:
        """Return z (size,) of a theta strictly within the bounds."""
        with np.errstate(all="ignore"):  # of the cases that do not hold
            from_low, to_high = np.log(theta - self.low), np.log(self.high - theta)
            return np.select(self._cases, [from_low - to_high, from_low, to_high], theta)

    def theta(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return theta, d theta / d z and d ln |d theta / d z| / d z, each (size,)."""
        share, one, low, high = 0.5 * (1.0 + np.tanh(0.5 * z)), np.ones_like(z), self.low, self.high
        with np.errstate(over="ignore", invalid="ignore"):
            size, grown = high - low, np.exp(z)
            inside = [low + size * share, low + grown, high - grown]
            slopes = [size * share * (1.0 - share), grown, -grown]
        bends = [1.0 - 2.0 * share, one, one]
        theta, slope = np.select(self._cases, inside, z), np.select(self._cases, slopes, 1.0)
        return theta, slope, np.select(self._cases, bends, 0.0)


@dataclass(frozen=True, eq=False)
class Block:
    """The weighted residuals `rows` of one channel in one record, whose noise level is unknown.

    `count` is their effective number of independent samples, less one where an offset was projected
    out of them: their number over the integrated `correlation_time`, in samples, which is 1 for
    white residuals. `level` is their rms, in the channel's unit.
    """

    rows: slice
    count: float
    record: int = 0
    channel: int = 0
    correlation_time: float = 1.0
    level: float = 1.0


@dataclass(frozen=True, eq=False)
class Density:
    """ln p(u | records), up to a constant, with its gradient, in whitened coordinates u.

    ln p = -sum_b (m_b / 2) ln |r_b|^2 - |r_p|^2 / 2 + ln |d theta / d z|, with the weighted
    residuals r_b of every block and m_b their effective number of samples: each block's noise level
    has Jeffreys' prior 1 / sigma and is integrated out. r_p are the rows outside the blocks: weak
    priors and a stack's further columns, whose levels are known. theta lies within its bounds
    (`Within`), and z = z_0 + L u, with the factor L of the covariance at the fit, so that u has
    nearly the covariance 1; coordinates that no record moves stay at z_0. The gradient is that of
    J^T r, with the sensitivities' exact Jacobian.
    """

    evaluate: Evaluate
    blocks: tuple[Block, ...]
    within: Within
    centre: FloatArray
    factor: FloatArray

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return int(self.factor.shape[1])

    def theta(self, u: FloatArray) -> FloatArray:
        """Return the fit's coordinates (size,) at u."""
        return self.within.theta(self.centre + self.factor @ u)[0]

    def __call__(self, u: FloatArray) -> tuple[float, FloatArray]:
        """Return ln p and its gradient (size,) at u; -inf where the model cannot be simulated."""
        z = self.centre + self.factor @ u
        theta, slope, bend = self.within.theta(z)
        with np.errstate(all="ignore"):
            result = self.evaluate(theta) if np.isfinite(theta).all() else None
            if result is None:
                return -np.inf, np.zeros_like(u)
            residual, jacobian = result
            value, pull, rest = 0.0, residual.copy(), residual.copy()
            for block in self.blocks:
                rows = residual[block.rows]
                power = float(rows @ rows)
                value -= 0.5 * block.count * float(np.log(power))
                pull[block.rows] *= block.count / power
                rest[block.rows] = 0.0
            value += float(np.sum(np.log(np.abs(slope)))) - 0.5 * float(rest @ rest)
            gradient = self.factor.T @ (bend - (jacobian.T @ pull) * slope)
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            return -np.inf, np.zeros_like(u)
        return value, gradient


_EVALUATIONS, _TOLERANCE, _ROUNDS = 60, 1e-6, 2
#: A start nearer to a bound than this share of a standard deviation is moved inwards.
_INSIDE = 0.3
#: Curvature that a coordinate at its bound has in z at least: a tail as exp(z) has none.
_TAIL = 0.1


@dataclass(frozen=True, eq=False)
class Task:
    """A posterior to sample: `density` in u, and the fit that it is centred on.

    `model` has the values that the priors are centred at; the experiments of the fit and its sigma
    have the levels that its residuals suggest. `covariance` (size, size) is that of the fit's
    coordinates, white residuals assumed. `sentences` are what was done to the records.
    """

    model: Model
    fit: Fit
    density: Density
    covariance: FloatArray
    sentences: tuple[Note | str, ...]

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """The records as they were fitted."""
        return self.fit.experiments

    @property
    def unknowns(self) -> Unknowns:
        """The coordinates of the fit."""
        return self.fit.unknowns

    def of_record(self, record: int) -> tuple[Block, ...]:
        """Return the blocks of one record, that of the first channel foremost."""
        return tuple(b for b in self.density.blocks if b.record == record)

    def channel(self, block: Block) -> Channel:
        """Return the channel of a block."""
        return self.experiments[block.record].channels[block.channel]


def task_of(
    model: Model,
    records: Sequence[Record],
    *,
    free: Sequence[str] | None = None,
    prior: Mapping[str, float] | None = None,
    widths: Mapping[str, float] | None = None,
) -> Task:
    """Fit the model from its values and set up the density around that fit.

    `free` are the parameters that are sampled (by default those that the model was fitted in, else
    those that records of a stack determine); `prior` are the values that the priors are centred at
    and `widths` their standard deviations, in ln units for parameters that span decades, else in
    ordinary changes. Raises InputError, SimulationError.
    """
    parts, notes = without_gaps(list(records))
    ready = [prepared(r) for r in parts]
    fitted = [r for r, _ in ready]
    columns = columns_of(model.with_declared_starts(), fitted)
    experiments = with_levels([whole(r) for r in fitted], columns.fitted)
    names = tuple(free or model.provenance.free or free_parameters(columns.model, fitted))
    _refuse(columns.model, names, {**(prior or {}), **(widths or {})})
    centre = columns.model.with_values(_centres(columns.model, fitted, names, prior or {}))
    return _around(
        centre, experiments, {n: columns.model.values[n] for n in names}, widths or {},
        noise_levels(experiments), None,
        (*notes, *(s for _, done in ready for s in done), *columns.left_out),
    )  # fmt: skip


def own_task_of(
    model: Model,
    records: Any,
    *,
    free: Sequence[str] | None = None,
    prior: Mapping[str, float] | None = None,
    widths: Mapping[str, float] | None = None,
    **words: Any,
) -> Task:
    """Identify any model but a stack's and set up the density around that fit.

    The priors are centred at the declared values. `words` are those of `identify_ode`, the rest as
    in `task_of`.
    """
    names = free_of(model, free or model.provenance.free or None)
    _refuse(model, names, {**(prior or {}), **(widths or {})})
    identification = identify_ode(model, records, free=names, **words)
    if identification.fit.interrupted:
        raise KeyboardInterrupt
    fitted = identification.fit.model
    declared = {n: fitted.parameter(n).value for n in names}
    return _around(
        fitted.with_values({**declared, **(prior or {})}),
        identification.experiments,
        {n: fitted.values[n] for n in names},
        widths or {},
        identification.fit.sigma,
        identification.fit,
        identification.doubts,
    )


def _around(
    centre: Model,
    experiments: tuple[Experiment, ...],
    values: Mapping[str, float],
    widths: Mapping[str, float],
    sigma: Sequence[float],
    fit: Fit | None,
    sentences: tuple[Note | str, ...],
) -> Task:
    """Fit from the values, with priors about those of `centre`, and set up the density there.

    Every record starts as in the fit `fit`, if there is one.
    """
    names = tuple(values)
    unknowns = unknowns_around(centre, names, experiments, sigma, placed=centre)
    for name, width in widths.items():
        if not width > 0.0:
            raise InputError(f"The prior of '{name}' has the width {width:g}; give one above 0.")
        unknowns.prior[names.index(name)] = width
    theta = np.zeros(unknowns.size)
    theta[: len(names)] = unknowns.coordinates(values)
    for r in range(unknowns.records):
        start, offset = (fit.start(r), fit.offset(r)) if fit else ({}, 0.0)
        unknowns.place(theta, r, start, offset)
    for _ in range(_ROUNDS):  # levels of records and of columns that the residuals suggest
        result = fit_from(
            centre, experiments, unknowns, theta, sigma,
            tolerance=_TOLERANCE, evaluations=_EVALUATIONS,
        )  # fmt: skip
        if result.interrupted:
            raise KeyboardInterrupt
        theta, levels = result.theta, [f.relevelled() for f in result.further]
        sigma = [
            max(float(np.sqrt(np.mean(r**2))), 1e-15) if r.size else s
            for r, s in zip(result.record_residuals, sigma, strict=True)
        ]
        experiments = tuple(e.with_further(levels) for e in experiments)
    return _task(centre, replace(result, experiments=experiments, sigma=tuple(sigma)), sentences)


def _refuse(model: Model, names: Sequence[str], values: Mapping[str, float]) -> None:
    problems = Problems()
    for name in names:
        if name not in model.values:
            problems.add(
                f"'{name}' is no parameter of the model '{model.name}'; it has"
                f" {', '.join(model.parameter_names)}."
            )
    for name in values:
        if name not in names:
            problems.add(
                f"'{name}' has a prior but is not sampled; sampled are {', '.join(names)}."
            )
    problems.raise_if_any()


def _centres(
    model: Model, records: Sequence[Record], names: Sequence[str], values: Mapping[str, float]
) -> dict[str, float]:
    """Return where the priors are centred: at `values`, else a stack of the records' size.

    Never where a fit ended, which would count the records twice. What such a stack does not have
    (effects) is centred at the declared value; a loop of the other sign at the model's, as its
    coordinates do not pass 0.
    """
    stiffness = next((model.values[n] for n in ("k_B", "k") if n in model.values), None)
    ordinary = starting_model(records, stiffness).values
    declared = {n: model.parameter(n).value for n in names}
    centre = {n: ordinary.get(n, declared[n]) for n in names}
    if "A" in centre and centre["A"] * model.values["A"] <= 0.0:
        centre |= {n: model.values[n] for n in ("k_L", "A", "beta", "gamma") if n in centre}
    return {**centre, **values}


def _task(model: Model, fit: Fit, sentences: tuple[Note | str, ...]) -> Task:
    experiments, unknowns = fit.experiments, fit.unknowns
    evaluate = Objective(model, experiments, unknowns, fit.sigma, fit.way)
    again = evaluate(fit.theta)
    if again is None:
        raise InputError("The model cannot be simulated at its fit; start from another model.")
    residual, jacobian = again
    blocks, precision, last = [], np.zeros((unknowns.size, unknowns.size)), 0
    for j, channel in enumerate(experiments[0].channels):
        for r, e in enumerate(experiments):
            first, last = last, last + int(e.at(j).sum())
            rows, part = slice(first, last), residual[first:last]
            if first == last:
                continue
            time, projected = 1.0, float(j > 0 and channel.offset)
            if not channel.factors:
                lags = autocovariance(part)
                ratio = float(2.0 * np.sum(lags) / lags[0] - 1.0) if lags[0] > 0.0 else 1.0
                time = max(1.0, ratio)
                level = (channel.level if j else fit.sigma[r]) * e.share(j)
                level *= float(np.sqrt(np.mean(part**2)))
                blocks.append(Block(rows, (len(part) - projected) / time, r, j, time, level))
            precision += jacobian[rows].T @ jacobian[rows] / time
    rest = jacobian[last:]
    precision += rest.T @ rest
    within = Within(*unknowns.bounds())
    covariance: FloatArray = np.asarray(np.linalg.pinv(precision, hermitian=True))
    moving = np.ones(unknowns.size, dtype=bool)
    if not unknowns.offset_scale:  # without an unknown zero, offsets stay at 0
        moving[list(unknowns.offsets)] = False
    centre, factor = _whitening(within, fit.theta, precision, np.diag(covariance), moving)
    density = Density(evaluate, tuple(blocks), within, centre, factor)
    return Task(model, fit, density, covariance, sentences)


def _whitening(
    within: Within,
    theta: FloatArray,
    precision: FloatArray,
    variances: FloatArray,
    moving: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """Return z at the fit, a little inside the bounds, and a factor of the covariance of z.

    A column of the factor for each of the coordinates that are `moving`.
    """
    spread = np.sqrt(np.maximum(variances, 0.0))
    room = np.where(within.bounded, 0.25 * (within.high - within.low), np.inf)
    edge = np.where(within.bounded, np.minimum(_INSIDE * spread, room), 0.0)
    inside = np.clip(theta, within.low + edge, within.high - edge)
    z = within.z(inside)
    _, slope, bend = within.theta(z)
    curvature = precision * np.outer(slope, slope)
    both = np.isfinite(within.low) & np.isfinite(within.high)
    tail = np.where(inside != theta, _TAIL, 0.0)
    curvature += np.diag(np.where(both, 0.5 * (1.0 - bend**2), 0.0) + tail)
    sizes, directions = np.linalg.eigh(curvature[np.ix_(moving, moving)])
    sizes = np.maximum(sizes, 1e-12 * sizes[-1])
    factor = np.zeros((len(z), len(sizes)))
    factor[moving] = directions / np.sqrt(sizes)
    return z, factor
