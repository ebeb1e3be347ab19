"""The minimum of a fit, by a simulation that is accurate there, and the objective that it is of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.further import further_of
from psa_casadi.identification.fitting.levenberg_marquardt import (
    LEAST_RADIUS,
    Evaluate,
    Minimum,
    minimise,
)
from psa_casadi.identification.fitting.prediction import Simulated, measured, predict, simulated
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.interruption import current_work
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import Way
from psa_casadi.simulation.stepper import SimulationError

FloatArray = npt.NDArray[np.float64]

#: The simulation may err by this share of the noise, or of the range where that is more (rms); 4 %
#: of the noise shows in the tests of a diagnosis. Where it errs more, steps get finer by tens, and
#: then the stepper is taken.
_OF_NOISE, _OF_RANGE, _TENTHS = 0.03, 1e-6, 3
#: Multiple of the whole range that is missed (rms) where a loop has diverged. It would come down by
#: decades a step, each of which takes a hundred times as long as one of a loop that is stable.
_DIVERGED = 1e6


@dataclass(frozen=True)
class Effort:
    """How far a minimum is sought: see `minimise`."""

    tolerance: float
    evaluations: int
    goal: float
    linear: tuple[int, ...]
    radius: float
    patient: bool = False


def accurate_minimum(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    weights: FloatArray,
    theta: FloatArray,
    sigma: Sequence[float],
    rtol: float,
    effort: Effort,
) -> tuple[Minimum, Way, list[Simulated]]:
    """Return the minimum, found by a simulation that is accurate there, and how that was done."""
    allowed = [_allowed(e, s) for e, s in zip(experiments, sigma, strict=True)]
    goal = min(effort.goal, _missing_all(experiments, sigma))
    ways = [Way(rtol * 0.1**k, rtol * 0.1**k, halved=k) for k in range(_TENTHS)]
    ways.append(Way(rtol, 0.1 * rtol, stepped=True))
    spent, before = 0, None
    for way in ways:
        evaluate = objective(model, experiments, unknowns, weights, way)
        try:
            found = minimise(
                evaluate,
                theta,
                unknowns.bounds(),
                tolerance=effort.tolerance,
                evaluations=max(effort.evaluations - spent, 2),
                goal=goal,
                linear=effort.linear,
                patient=effort.patient,
                radius=effort.radius if before is None else max(before[0].radius, LEAST_RADIUS),
            )
        except KeyboardInterrupt:
            if before is None:  # nothing was evaluated yet
                raise
            current_work().stop()
            minimum, rougher = before
            ended = replace(minimum, evaluations=spent, interrupted=True, converged=False)
            return ended, rougher, []
        if found is None:
            raise SimulationError(
                "The model cannot be simulated at the start of the fit; start from other values."
            )
        minimum, theta = found, found.theta
        before = minimum, way
        spent += found.evaluations
        if minimum.interrupted:  # whoever interrupts waits neither for the error nor for more
            current_work().stop()
            return replace(minimum, evaluations=spent), way, []
        if minimum.cost > goal:  # of no use, however accurate
            return replace(minimum, evaluations=spent), way, []
        told = simulated(model, experiments, unknowns, theta, way=way)
        if not any(t.error > a for t, a in zip(told, allowed, strict=True)):
            break
    return replace(minimum, evaluations=spent), way, told


def _missing_all(experiments: Sequence[Experiment], sigma: Sequence[float]) -> float:
    """Return the cost of missing every sample by the whole range: a loop that diverges misses more.

    Infinite where a further column counts as well.
    """
    if any(e.further for e in experiments):
        return np.inf
    parts = [(measured(e.record)[e.used], s) for e, s in zip(experiments, sigma, strict=True)]
    return sum(y.size * float(np.ptp(y) / s) ** 2 for y, s in parts if y.size)


def _allowed(experiment: Experiment, sigma: float) -> float:
    """Return the rms error [m] that a record's simulation may have."""
    y = measured(experiment.record)[experiment.used]
    return max(_OF_NOISE * sigma, _OF_RANGE * float(np.ptp(y)) if y.size else 0.0)


def objective(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    weights: FloatArray,
    way: Way,
) -> Evaluate:
    """Return the weighted residuals (predicted - measured, then priors) with their Jacobian.

    Those of the displacement, then those of the further columns. None where the model diverges.
    """
    return _Objective(model, tuple(experiments), unknowns, weights, way)


class _Objective:
    """What `objective` returns; it can be pickled with the posterior that it is part of."""

    def __init__(
        self, model: Model, experiments: tuple[Experiment, ...], unknowns: Unknowns,
        weights: FloatArray, way: Way,
    ) -> None:  # fmt: skip
        self._of, self._way = (model, experiments, unknowns), way
        self._target = np.concatenate([measured(e.record)[e.used] for e in experiments])
        span = float(np.ptp(self._target))
        self._reach = float(np.max(span / weights)) if span > 0.0 else np.inf
        self._used = [e.used[: e.stop] for e in experiments]
        self._prior, self._share = 1.0 / unknowns.prior, 1.0 / weights

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        try:
            parts = predict(*self._of, theta, way=self._way)
            beside = further_of(*self._of, theta, way=self._way)
        except PsaError:
            return None
        used, samples = self._used, len(self._target)
        y = np.concatenate([p.displacement[u] for p, u in zip(parts, used, strict=True)])
        more = [b.jacobian / b.level for b in beside]
        given = (-b.residuals / b.level for b in beside)
        residual = np.concatenate([(y - self._target) * self._share, *given, theta * self._prior])
        jacobian = np.empty((len(residual), len(theta)))
        first = 0
        for part, u in zip(parts, used, strict=True):  # no copy but this one
            last = first + int(np.count_nonzero(u))
            np.compress(u, part.jacobian, axis=0, out=jacobian[first:last])
            first = last
        jacobian[:samples] *= self._share[:, None]
        jacobian[samples:] = np.vstack([*more, np.diag(self._prior)])
        with np.errstate(over="ignore", invalid="ignore"):
            finite = np.isfinite(residual @ residual + np.vdot(jacobian, jacobian))
            far = _DIVERGED * self._reach * np.sqrt(samples)
            near = np.linalg.norm(residual[:samples]) < far
        return (residual, jacobian) if finite and near else None
