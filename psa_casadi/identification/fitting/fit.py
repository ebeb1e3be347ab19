"""Prediction-error fit: maximum likelihood of all records at once, with analytic derivatives.

Initial states of records that are held out whole, of which the fit uses no sample.

The stack starts as in the fitted records of the device with the same first voltage: memories that
are estimated from the first tenth of a record mostly contain the model's error there. A loop that
is simulated from these drifts by a tenth of the range; one that starts as the device's other
records do stays within a hundredth. Without a fitted record of that first voltage, all of the start
is estimated from the first tenth. States of drive, sensor and environment belong to the record and
are estimated from its first tenth, too. That hardly separates a charge that leaks slowly from the
sensor's offset, and the error grows along the record. So the prior of such a state has the root
mean square that it has at the start of these fitted records.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TypedDict, Unpack

import numpy as np

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.interruption import current_work
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.levenberg_marquardt import (
    FIRST_RADIUS,
    LEAST_RADIUS,
    Minimum,
    minimise,
)
from psa_casadi.identification.fitting.prediction import (
    Further,
    Prediction,
    Simulated,
    further_of,
    motions_of,
    predict,
    predicted_further,
    scaled,
    simulated,
    span_of,
    trace_record,
)
from psa_casadi.identification.fitting.unknowns import (
    LINEAR_PRIOR,
    Unknowns,
    coordinates_of,
    memory_prior,
    unknowns_of,
)
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import nominal_value
from psa_casadi.records.split import Channel, Experiment, fitted
from psa_casadi.simulation.simulate import Way
from psa_casadi.simulation.start import is_stack, resting_states
from psa_casadi.simulation.stepper import SimulationError

#: Relative tolerance of a step in fits.
FIT_RTOL = 1e-6
#: First voltages that differ by less than this share of the records' range are the same.
_SAME = 0.01
#: Coordinates of a start are of order 1: smaller than this none is known.
_LEAST = 1e-6
#: How far the start is sought in the first tenth.
_EVALUATIONS, _TOLERANCE = 30, 1e-5


#: The simulation may err by this share of the noise, or of the range where that is more (rms); 4 %
#: of the noise shows in the tests of a diagnosis. Where it errs more, steps get finer by tens, and
#: then the stepper is taken.
_OF_NOISE, _OF_RANGE, _TENTHS = 0.03, 1e-6, 3
#: Rms residual over the range at which a loop has diverged. It would come down by
#: decades a step, each of which takes a hundred times as long as one of a loop that is stable.
_DIVERGED = 1e6


class How(TypedDict, total=False):
    """How far a minimum is sought (`minimise`), and the tolerance `rtol` of a step."""

    tolerance: float
    evaluations: int
    rtol: float
    goal: float
    radius: float
    patient: bool


def _accurate_minimum(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    theta: FloatArray,
    sigma: Sequence[float],
    *,
    tolerance: float = 1e-5,
    evaluations: int = 40,
    rtol: float = FIT_RTOL,
    goal: float = np.inf,
    radius: float = FIRST_RADIUS,
    patient: bool = False,
) -> tuple[Minimum, Way, list[Simulated]]:
    """Return the minimum, by a simulation that is accurate there, its `Way`, and each record's."""
    pairs = [(_readings(e, 0), s) for e, s in zip(experiments, sigma, strict=True)]
    allowed = [
        [
            max(_OF_NOISE * level * e.share(j), _OF_RANGE * float(np.ptp(y)) if y.size else 0.0)
            for j, c in enumerate(e.channels)
            if not c.factors
            for y, level in [(_readings(e, j), c.level if j else s)]
        ]
        for e, s in zip(experiments, sigma, strict=True)
    ]
    if not any(e.further for e in experiments):  # a loop that diverges misses more than all
        goal = min(goal, sum(y.size * float(np.ptp(y) / s) ** 2 for y, s in pairs if y.size))
    ways = [Way(rtol * 0.1**k, rtol * 0.1**k, halved=k) for k in range(_TENTHS)]
    ways.append(Way(rtol, 0.1 * rtol, stepped=True))
    spent, before = 0, None
    for way in ways:
        evaluate = Objective(model, experiments, unknowns, sigma, way)
        try:
            result = minimise(
                evaluate,
                theta,
                unknowns.bounds(),
                tolerance=tolerance,
                evaluations=max(evaluations - spent, 2),
                goal=goal,
                linear=unknowns.offsets,
                patient=patient,
                radius=radius if before is None else max(before[0].radius, LEAST_RADIUS),
            )
        except KeyboardInterrupt:
            if before is None:  # nothing was evaluated yet
                raise
            current_work().stop()
            minimum, rougher = before
            return replace(minimum, interrupted=True, converged=False), rougher, []
        if result is None:
            raise SimulationError(
                "The model cannot be simulated at the start of the fit; start from other values."
                f" {evaluate.refused}".rstrip()
            )
        spent += result.evaluations
        minimum, theta = replace(result, evaluations=spent), result.theta
        before = minimum, way
        if minimum.interrupted:  # whoever interrupts waits neither for the error nor for more
            current_work().stop()
        if minimum.interrupted or minimum.cost > goal:  # of no use, however accurate
            return minimum, way, []
        runs = simulated(model, experiments, unknowns, theta, way=way)
        pairs_of = zip(runs, allowed, strict=True)
        if not any(e > a for r, most in pairs_of for e, a in zip(r.errors, most, strict=False)):
            break
    return minimum, way, runs


def _readings(e: Experiment, channel: int) -> FloatArray:
    """Return the fitted readings of a channel (n,)."""
    return e.measured(channel)[e.at(channel)]


class Objective:
    """The weighted residuals (predicted - measured, then priors) with their Jacobian, at a theta.

    Those of the first channel, then those of the further ones. None where the model diverges. It
    can be pickled with the posterior that it is part of.
    """

    def __init__(
        self, model: Model, experiments: Sequence[Experiment], unknowns: Unknowns,
        sigma: Sequence[float], way: Way,
    ) -> None:  # fmt: skip
        self._of, self._way = (model, tuple(experiments), unknowns), way
        self._target = np.concatenate([_readings(e, 0) for e in experiments])
        shares = weights_of(experiments, [e.share(0) for e in experiments])
        weights, span = weights_of(experiments, sigma) * shares, float(np.ptp(self._target))
        self._reach = float(np.max(span / weights)) if span > 0.0 else np.inf
        self._used = [e.at(0)[: e.stop] for e in experiments]
        self._prior, self._share = 1.0 / unknowns.prior, 1.0 / weights
        #: Why the last point that cannot be simulated cannot be.
        self.refused = ""

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return residuals (m,) and Jacobian (m, size)."""
        try:
            parts = predict(*self._of, theta, way=self._way, further=True)
        except PsaError as error:
            self.refused = str(error)
            return None
        furthers = further_of(self._of[1], parts)
        used, samples = self._used, len(self._target)
        y = np.concatenate([p.displacement[u] for p, u in zip(parts, used, strict=True)])
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is left
            more = [b.jacobian / b.level for b in furthers]
            inputs = (-b.residuals / b.level for b in furthers)
            residual = np.concatenate(
                [(y - self._target) * self._share, *inputs, theta * self._prior]
            )
            jacobian = np.empty((len(residual), len(theta)))
            first = 0
            for part, u in zip(parts, used, strict=True):  # no copy but this one
                last = first + int(np.count_nonzero(u))
                np.compress(u, part.jacobian, axis=0, out=jacobian[first:last])
                first = last
            jacobian[:samples] *= self._share[:, None]
            jacobian[samples:] = np.vstack([*more, np.diag(self._prior)])
            finite = np.isfinite(residual @ residual + np.vdot(jacobian, jacobian))
            far = _DIVERGED * self._reach * np.sqrt(samples)
            near = np.linalg.norm(residual[:samples]) < far
        return (residual, jacobian) if finite and near else None


def weights_of(experiments: Sequence[Experiment], sigma: Sequence[float]) -> FloatArray:
    """Return a figure of every record, such as its level, at each used sample of the first channel.

    Shape (n,), all records stacked.
    """
    return np.repeat(np.asarray(sigma, dtype=np.float64), _counts(experiments))


def _counts(experiments: Sequence[Experiment]) -> list[int]:
    return [int(e.at(0).sum()) for e in experiments]


#: Correlation of neighbouring residuals that counts at most: a hundred samples are then one.
_MOST_ALIKE = 0.98


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """The result of a prediction-error fit of `experiments`.

    `model` carries the estimates; `residuals` (used samples of every record, stacked) [m] are
    measured minus predicted; `jacobian` (samples, size) [m] is d prediction / d theta there;
    `sigma` the noise level that weighted each record [m]; `cost` the weighted sum of squares with
    the priors. `converged` is False when the iteration was cut off, `interrupted` True when a
    keyboard interrupt did that. `way` is the tolerance of the simulation, `simulated` holds how
    each record was run and how accurately; it is empty after an interrupt, and above the goal.
    `radius` is that of the next step. The residuals are those of the first channel; `further` are
    the fits of the other channels. Of any model read displacement as its first channel, m as that
    one's unit.
    """

    model: Model
    experiments: tuple[Experiment, ...]
    unknowns: Unknowns
    theta: FloatArray
    residuals: FloatArray
    jacobian: FloatArray
    sigma: tuple[float, ...]
    cost: float
    converged: bool
    interrupted: bool
    evaluations: int
    way: Way
    simulated: tuple[Simulated, ...]
    radius: float = FIRST_RADIUS
    further: tuple[Further, ...] = ()

    def __repr__(self) -> str:
        """Return what was fitted and what it leaves, in one line."""
        names = ", ".join(self.unknowns.names)
        return f"<Fit of {names}: residual {self.rms:.3g} m rms, {self.evaluations} evaluations>"

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """Where the used samples of every record stand in `residuals` and `jacobian`."""
        ends = np.cumsum([0, *_counts(self.experiments)]).tolist()
        return tuple(slice(*pair) for pair in pairwise(ends))

    @property
    def record_residuals(self) -> list[FloatArray]:
        """Residuals [m] record by record."""
        return [self.residuals[part] for part in self.parts]

    @property
    def data_cost(self) -> float:
        """The `cost` without its weak priors: the weighted sum of squares of the records alone.

        Priors are centred at the model that a fit starts from, so they add (ln ratio / spread)^2
        for a lag that started elsewhere, 49 for a factor e^7, and nothing after a restart there.
        Fits of one search, which start from different values, are compared by this.
        """
        return self.cost - float(np.sum((self.theta / self.unknowns.prior) ** 2))

    @property
    def rms(self) -> float:
        """Root mean square of the residuals [m]."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    def at(self, values: Mapping[str, float]) -> "Fit":
        """Return the fit with other values of some parameters, which it predicts with."""
        model, theta = self.model.with_values(values), self.theta.copy()
        theta[: len(self.unknowns.names)] = self.unknowns.coordinates(model.values)
        return replace(self, model=model, theta=theta)

    def start(self, record: int) -> dict[str, float]:
        """Deviations of one record's initial state from where its voltage and rate put it."""
        return self.unknowns.start(self.theta, record)

    def starts(self) -> list[dict[str, float]]:
        """The same for every record: where a further fit continues from."""
        return [self.start(r) for r in range(self.unknowns.records)]

    def offset(self, record: int) -> float:
        """Sensor offset of one record [m]."""
        return self.unknowns.offset(self.theta, record)

    def predicted(self) -> list[FloatArray]:
        """Predict whole records [m], held-out samples included."""
        return [p.displacement for p in self.predictions(differentiated=False)]

    def predictions(
        self, *, differentiated: bool = True, further: bool = False
    ) -> list[Prediction]:
        """Predict whole records with their derivatives by theta, if `differentiated`.

        With `further`, the outputs of the further channels as well.
        """
        return predict(
            self.model, self.experiments, self.unknowns, self.placed(),
            way=self.way, everything=True, differentiated=differentiated, further=further,
        )  # fmt: skip

    def predicted_channels(self) -> list[FloatArray]:
        """Predict all channels over whole records (n, channels); nan where a record has none."""
        parts = self.predictions(differentiated=False, further=True)
        further = [predicted_further(self.experiments, parts, f) for f in self.further]
        return [
            np.column_stack(
                [p.displacement, *(f.get(k, np.full(e.record.n, np.nan)) for f in further)]
            )
            for k, (e, p) in enumerate(zip(self.experiments, parts, strict=True))
        ]

    def outputs(self) -> list[FloatArray]:
        """Predict all outputs of the model over whole records (n, ny), with sensors' offsets."""
        names = self.model.output_names
        every = tuple(Channel(n, "", (n,), offset=False, factors=False) for n in names)
        whole = [replace(e, channels=(*e.channels, *every)) for e in self.experiments]
        parts = predict(
            self.model, whole, self.unknowns, self.placed(),
            way=self.way, everything=True, differentiated=False, further=True,
        )  # fmt: skip
        outputs = [np.column_stack([p.further[n][0] for n in names]) for p in parts]
        for channel in self.channels:
            k = names.index(channel.channel.outputs[0])
            if channel.number == 0:
                for y, p in zip(outputs, parts, strict=True):
                    y[:, k] = p.displacement
            elif not channel.channel.factors:
                for r, y in predicted_further(self.experiments, parts, channel).items():
                    outputs[r][:, k] = y
        return outputs

    def placed(self) -> FloatArray:
        """Return theta with start and offset of the records that are held out whole.

        Raises PsaError if a record cannot be simulated.
        """
        u, result = self.unknowns, self.theta.copy()
        outside = {
            s.name for c in self.model.components if c.belongs_to != "plant" for s in c.states
        }
        for k, experiment in enumerate(self.experiments):
            if not experiment.held_out_whole or not experiment.known.any():
                continue
            first, last = u.first(k), u.first(k + 1)
            result[first:last] = 0.0
            others = self._like_starts(k) if u.first_voltage else {}
            shared = {c: v for c, v in others.items() if u.started[k][c - first] not in outside}
            result[list(shared)] = [float(np.mean(v)) for v in shared.values()]
            sizes = {c: float(u.prior[c]) for c in range(first, last) if c not in shared}
            for c in sizes.keys() & others.keys():
                size = float(np.sqrt(np.mean(np.square(others[c]))))
                sizes[c] = min(sizes[c], max(size, _LEAST))
            result[list(sizes)] = self._fit_start(result, k, sizes)
        return result

    def _like_starts(self, k: int) -> dict[int, list[float]]:
        """Return the start's coordinates of the fitted records with the first voltage of record k.

        One value for each of these records, by the index of record k's coordinate.
        """
        u, starts = self.unknowns, self.unknowns.first_voltage
        size = max(float(np.ptp(e.record.voltage)) for e in self.experiments)
        like = [
            j
            for j, other in enumerate(self.experiments)
            if not other.held_out_whole and abs(starts[j] - starts[k]) <= _SAME * size
        ]
        table = {
            u.first(k) + place: [
                float(self.theta[u.first(j) + u.started[j].index(name)])
                for j in like
                if name in u.started[j]
            ]
            for place, name in enumerate(u.started[k])
        }
        return {c: values for c, values in table.items() if values}

    def _fit_start(self, theta: FloatArray, k: int, sizes: Mapping[int, float]) -> FloatArray:
        """Return the coordinates of record k with which its first tenth fits best, of such sizes.

        Residuals weigh by the equivalent white-noise standard deviations of the channels without
        factors.
        """
        e, u = self.experiments[k], self.unknowns
        columns, prior = list(sizes), 1.0 / np.array(list(sizes.values()))
        stop = int(np.flatnonzero(e.known)[-1]) + 1
        plain = [c for c in self.channels if not c.channel.factors]
        outputs = [c.channel.outputs[0] for c in plain]
        at = [e.at(c.number, e.known) for c in plain]
        weights = [_equivalent_noise(c.residuals, c.rms) * e.share(c.number) for c in plain]

        def evaluate(values: FloatArray) -> tuple[FloatArray, FloatArray] | None:
            there = theta.copy()
            there[columns] = values
            try:
                run = trace_record(
                    self.model, e.record, u.start(there, k), (),
                    stop=stop, way=self.way, outputs=outputs,
                )  # fmt: skip
            except PsaError:
                return None
            by_start, by_offset = u.place_slopes(there, k)
            misfit, slopes = [], []
            for i, (c, known, weight) in enumerate(zip(plain, at, weights, strict=True)):
                offset, moves = (0.0, 0.0) if c.number else (u.offset(there, k), by_offset)
                predicted = run.y[known[:stop], i] + offset
                misfit.append((predicted - e.measured(c.number)[known]) / weight)
                slopes.append(
                    (run.sensitivity[known[:stop], i] @ by_start + moves)[:, columns] / weight
                )
            return np.concatenate([*misfit, values * prior]), np.vstack([*slopes, np.diag(prior)])

        free = np.full(len(columns), np.inf)
        minimum = minimise(  # the last coordinate is the offset, exactly linear
            evaluate, np.zeros(len(columns)), (-free, free), tolerance=_TOLERANCE,
            evaluations=_EVALUATIONS, linear=(len(columns) - 1,),
        )  # fmt: skip
        if minimum is None:
            raise PsaError("A held-out record cannot be simulated from where the others begin.")
        return minimum.theta

    @cached_property
    def channels(self) -> tuple[Further, ...]:
        """The fits of all channels, the first one foremost."""
        lengths = _counts(self.experiments)
        records = tuple(k for k, n in enumerate(lengths) if n)
        first = Further(
            channel=self.experiments[0].channels[0], number=0,
            level=self.sigma[records[0] if records else 0], spread=span_of(self.experiments, 0),
            residuals=self.residuals, jacobian=self.jacobian,
            basis=np.zeros((len(self.residuals), 0)), factors=np.ones(1),
            lengths=tuple(lengths[k] for k in records), records=records,
        )  # fmt: skip
        return (first, *self.further)


def _equivalent_noise(left: FloatArray, rms: float) -> float:
    """Return the equivalent white-noise standard deviation of a correlated residual.

    It is rms sqrt((1 + r)/(1 - r)), r the correlation of neighbours.
    """
    power = float(left @ left)
    r = float(left[1:] @ left[:-1]) / power if power > 0.0 else 0.0
    r = min(max(r, 0.0), _MOST_ALIKE)
    return max(rms * float(np.sqrt((1.0 + r) / (1.0 - r))), 1e-15)


@contextmanager
def _overflow_as_simulation_error() -> Iterator[None]:
    try:
        yield
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise SimulationError(
            f"The numbers of the fit overflow ({error}); start from other values."
        ) from error


@_overflow_as_simulation_error()
def fit(
    model: Model,
    experiments: Sequence[Experiment],
    free: Sequence[str],
    *,
    sigma: Sequence[float],
    start: Mapping[str, float] | None = None,
    start_states: Sequence[Mapping[str, float]] | None = None,
    **how: Unpack[How],
) -> Fit:
    """Fit the free parameters, every record's initial state and offset to the used samples.

    Of the displacement and of the experiments' `further` columns, each weighted by its level.
    Minimises sum(((measured - predicted)/sigma)^2) + sum((theta/prior)^2) by Levenberg and
    Marquardt's method within the parameters' bounds; the coordinates and their weak priors are
    those of `unknowns_of(model, ...)`, the search starts at `start`, and may end early where the
    cost will stay above the `goal`; its first step is of the `radius`, and where it is `patient` it
    does not stop in a curved valley (`minimise`). Raises InputError when no sample can be used,
    SimulationError when the start cannot be simulated or its numbers overflow.
    """
    if not any(e.at(k).any() for e in experiments for k, _ in enumerate(e.channels)):
        column = experiments[0].channels[0].column
        raise InputError([f"No sample with a {column} is left to fit; give more data."])
    placed = model.with_values(start or {})
    unknowns = unknowns_around(model, free, experiments, sigma, placed=placed)
    theta = np.zeros(unknowns.size)
    theta[: len(free)] = unknowns.coordinates(placed.values)
    for r, e in enumerate(experiments):
        if e.used.any():  # the offset's coordinate is linear: `minimise` puts it where it is best
            readings = _readings(e, 0) if e.channels[0].offset else np.zeros(0)
            offset = float(np.mean(readings)) if readings.size else 0.0
            unknowns.place(theta, r, start_states[r] if start_states else {}, offset)
    return fit_from(model, experiments, unknowns, theta, sigma, **how)


def fit_from(
    model: Model, experiments: Sequence[Experiment], unknowns: Unknowns, theta: FloatArray,
    sigma: Sequence[float], **how: Unpack[How],
) -> Fit:  # fmt: skip
    """Return the fit in the coordinates of `unknowns`, from theta (size,); see `fit`."""
    minimum, way, runs = _accurate_minimum(model, experiments, unknowns, theta, sigma, **how)
    weights = weights_of(experiments, sigma)
    further: tuple[Further, ...] = ()
    if experiments[0].further:
        parts = predict(model, experiments, unknowns, minimum.theta, way=way, further=True)
        further = further_of(experiments, parts)
    fitted_model, further = scaled(model.with_values(unknowns.values(minimum.theta)), further)
    return Fit(
        model=fitted_model,
        experiments=tuple(experiments),
        unknowns=unknowns,
        theta=minimum.theta,
        residuals=-minimum.residual[: len(weights)] * weights,
        jacobian=minimum.jacobian[: len(weights)] * weights[:, None],
        sigma=tuple(sigma),
        cost=minimum.cost,
        converged=minimum.converged,
        interrupted=minimum.interrupted,
        evaluations=minimum.evaluations,
        way=way,
        simulated=tuple(runs),
        radius=minimum.radius,
        further=further,
    )


def unknowns_around(
    model: Model, free: Sequence[str], experiments: Sequence[Experiment], sigma: Sequence[float],
    *, placed: Model,
) -> Unknowns:  # fmt: skip
    """Return the coordinates of a fit around a model's values; `placed` has the start's values.

    Of any model but a stack per experiment the initial states as deviations from the declared
    starts (unless these are known) over their usual sizes, with weak priors: `LINEAR_PRIOR` of
    these sizes, `memory_prior` for memories of effects. The filters of effects rest at the start of
    a record, not of a later part.
    """
    if not is_stack(model):
        memories = {q.name for c in model.effects for q in c.states if q.memory}
        resting, s = {*resting_states(model.structure)}, model.structure

        def starts(e: Experiment) -> dict[str, tuple[float, float]]:
            moving = set() if e.later_part else resting
            names = memories if e.known_start else {q.name for q in s.states} - moving
            return {
                q.name: (
                    nominal_value(q.nominal, model.values),
                    memory_prior(q) if q.name in memories else LINEAR_PRIOR,
                )
                for q in s.states
                if q.name in names
            }

        offset = experiments[0].channels[0].offset
        return coordinates_of(
            model, free, [starts(e) for e in experiments],
            (span_of(experiments, 0) or 1.0) if offset else 0.0, np.inf if offset else 1.0,
        ).without([k for k, e in enumerate(experiments) if not e.at(0).any()])  # fmt: skip
    scale = max(float(np.nanstd(e.record.measured[e.used])) for e in fitted(experiments))
    motions = [motions_of(placed, e.record, s) for e, s in zip(experiments, sigma, strict=True)]
    first = [float(e.record.voltage[0]) for e in experiments]
    unknowns = unknowns_of(model, free, motions, first, 30.0 * max(scale, 1e-12))
    return unknowns.without([k for k, e in enumerate(experiments) if not e.used.any()])
