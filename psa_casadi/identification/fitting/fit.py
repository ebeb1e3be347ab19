"""Prediction-error fit: maximum likelihood of all records at once, with analytic derivatives."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.beginnings import beginnings
from psa_casadi.identification.fitting.further import Further, further_of, scaled
from psa_casadi.identification.fitting.levenberg_marquardt import FIRST_RADIUS
from psa_casadi.identification.fitting.minimum import Effort, accurate_minimum
from psa_casadi.identification.fitting.prediction import (
    Prediction,
    Simulated,
    measured,
    motions_of,
    predict,
)
from psa_casadi.identification.fitting.unknowns import Unknowns, static_compliance, unknowns_of
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment, fitted
from psa_casadi.simulation.simulate import Way
from psa_casadi.simulation.stepper import SimulationError

FloatArray = npt.NDArray[np.float64]

#: Correlation of neighbouring residuals that counts at most: a hundred samples are then one.
_MOST_ALIKE = 0.98
#: Relative tolerance of a step in fits.
FIT_RTOL = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """The result of a prediction-error fit.

    `model` carries the estimates; `residuals` (used samples of every record, stacked) [m] are
    measured minus predicted; `jacobian` (samples, size) [m] is d prediction / d theta there;
    `sigma` the noise level that weighted each record [m]; `cost` the weighted sum of squares with
    the priors. `converged` is False when the iteration was cut off, `interrupted` True when a
    keyboard interrupt did that. `way` is the tolerance of the simulation, `simulated` tells how
    each record was run and how accurately; it is empty after an interrupt, and above the goal.
    `radius` is that of the next step, `further` are the fits of the columns beside the
    displacement.
    """

    model: Model
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

    def of_record(self, experiments: Sequence[Experiment], record: int) -> slice:
        """Where the used samples of one record stand in `residuals` and `jacobian`."""
        counts = [int(e.used.sum()) for e in experiments[: record + 1]]
        return slice(sum(counts[:-1]), sum(counts))

    def residuals_of(self, experiments: Sequence[Experiment]) -> list[FloatArray]:
        """Residuals [m] record by record."""
        return [self.residuals[self.of_record(experiments, r)] for r in range(len(experiments))]

    @property
    def data_cost(self) -> float:
        """The `cost` without its weak priors: the weighted sum of squares of the records alone.

        Priors count from the model that a fit was given, so they add (ln ratio / spread)^2 to a
        lag's fit that began elsewhere, 49 for a factor e^7, and nothing where it is begun again.
        Fits of one search, which begin in different places, are compared by this.
        """
        return self.cost - float(np.sum((self.theta / self.unknowns.prior) ** 2))

    @property
    def rms(self) -> float:
        """Root mean square of the residuals [m]."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    def start(self, record: int) -> dict[str, float]:
        """Deviations of one record's initial state from where its voltage and rate put it."""
        return self.unknowns.start(self.theta, record)

    def starts(self) -> list[dict[str, float]]:
        """The same for every record: where a further fit continues from."""
        return [self.start(r) for r in range(self.unknowns.records)]

    def offset(self, record: int) -> float:
        """Sensor offset of one record [m]."""
        return self.unknowns.offset(self.theta, record)

    def predicted(self, experiments: Sequence[Experiment]) -> list[FloatArray]:
        """Predict whole records [m], held-out samples included."""
        return [p.displacement for p in self.predictions(experiments, differentiated=False)]

    def predictions(
        self, experiments: Sequence[Experiment], *, differentiated: bool = True
    ) -> list[Prediction]:
        """Predict whole records with their derivatives by theta, if `differentiated`."""
        return predict(
            self.model, experiments, self.unknowns, self.placed(experiments),
            way=self.way, everything=True, differentiated=differentiated,
        )  # fmt: skip

    def placed(self, experiments: Sequence[Experiment]) -> FloatArray:
        """Return theta with where held-out records begin (`beginnings`), which no fit has seen."""
        return beginnings(
            self.model, self.unknowns, self.theta, experiments, self._doubt(), self.way
        )

    def _doubt(self) -> float:
        """Return the level [m] of white noise that tells as little as what the model misses.

        Samples that are alike count as one: rms sqrt((1 + r)/(1 - r)), r the correlation of
        neighbours.
        """
        left = self.residuals
        power = float(left @ left)
        r = float(left[1:] @ left[:-1]) / power if power > 0.0 else 0.0
        r = min(max(r, 0.0), _MOST_ALIKE)
        return max(self.rms * float(np.sqrt((1.0 + r) / (1.0 - r))), 1e-15)


@contextmanager
def _overflow_is_told() -> Iterator[None]:
    try:
        yield
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise SimulationError(
            f"The numbers of the fit overflow ({error}); start from other values."
        ) from error


@_overflow_is_told()
def fit(
    model: Model,
    experiments: Sequence[Experiment],
    free: Sequence[str],
    *,
    sigma: Sequence[float],
    start: Mapping[str, float] | None = None,
    start_states: Sequence[Mapping[str, float]] | None = None,
    evaluations: int = 40,
    tolerance: float = 1e-5,
    rtol: float = FIT_RTOL,
    goal: float = np.inf,
    radius: float = FIRST_RADIUS,
    patient: bool = False,
) -> Fit:
    """Fit the free parameters, every record's initial state and offset to the used samples.

    Of the displacement and of the experiments' `further` columns, each by its own level.
    Minimises sum(((measured - predicted)/sigma)^2) + sum((theta/prior)^2) by Levenberg and
    Marquardt's method within the parameters' bounds; the coordinates and their weak priors are
    those of `unknowns_of(model, ...)`, the search begins at `start`, and may end early where the
    cost will stay above the `goal`; its first step is of the `radius`, and where it is `patient` it
    does not stop in a curved valley (`minimise`). Raises InputError when no sample can be used,
    SimulationError when the start cannot be simulated or its numbers overflow.
    """
    if not any(e.used.any() for e in experiments):
        raise InputError(["No sample with a displacement is left to fit; give more data."])
    scale = max(float(np.nanstd(measured(e.record)[e.used])) for e in fitted(experiments))
    placed = model.with_values(start or {})
    motions = [motions_of(placed, e.record, s) for e, s in zip(experiments, sigma, strict=True)]
    first = [float(e.record.voltage[0]) for e in experiments]
    unknowns = unknowns_of(model, free, motions, first, 30.0 * max(scale, 1e-12))
    unknowns = unknowns.without([k for k, e in enumerate(experiments) if not e.used.any()])
    theta = _starting_point(model, experiments, unknowns, start or {}, start_states)
    weights = np.concatenate(
        [np.full(int(e.used.sum()), s) for e, s in zip(experiments, sigma, strict=True)]
    )
    linear = tuple(unknowns.first(r + 1) - 1 for r in range(unknowns.records))
    effort = Effort(tolerance, evaluations, goal, linear, radius, patient)
    minimum, way, told = accurate_minimum(
        model, experiments, unknowns, weights, theta, sigma, rtol, effort
    )
    further = further_of(model, experiments, unknowns, minimum.theta, way=way)
    found, further = scaled(model.with_values(unknowns.values(minimum.theta)), further)
    return Fit(
        model=found,
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
        simulated=tuple(told),
        radius=minimum.radius,
        further=further,
    )


def _starting_point(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    start: Mapping[str, float],
    start_states: Sequence[Mapping[str, float]] | None,
) -> FloatArray:
    values = {**model.values, **start}
    theta = np.zeros(unknowns.size)
    theta[: len(unknowns.names)] = unknowns.coordinates(values)
    for r, experiment in enumerate(experiments):
        if not experiment.used.any():
            continue
        given = start_states[r] if start_states else {}
        y, v = measured(experiment.record)[experiment.used], experiment.record.voltage
        slope = values["G"] * values["k_L"] * static_compliance(values)
        unknowns.place(theta, r, given, float(np.mean(y) - slope * np.mean(v[experiment.used])))
    return theta
