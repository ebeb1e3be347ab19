"""What draws of the prior and of the posterior predict, noise included."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.prediction import measured, predict
from psa_casadi.posterior.task import Task
from psa_casadi.units import FloatArray


@dataclass(frozen=True, eq=False)
class Predictive:
    """Draws that were predicted: `theta` (draws, size), and per record displacement and noise.

    `displacement` (draws, samples) [m] holds noise of the level `noise` (draws,) [m]. `failed` of
    the draws could not be simulated and are left out.
    """

    theta: FloatArray
    displacement: tuple[FloatArray, ...]
    noise: tuple[FloatArray, ...]
    failed: int


def prior_draws(task: Task, count: int, rng: np.random.Generator) -> FloatArray:
    """Return draws of the priors (count, size): normal about their centre, cut at the bounds.

    Offsets have flat priors and stay 0.
    """
    known = np.isfinite(task.unknowns.prior)
    width, found = task.unknowns.prior[known], np.zeros((count, task.unknowns.size))
    low, high = (edge[known] / width for edge in task.unknowns.bounds())
    found[:, known] = width * scipy.stats.truncnorm.rvs(
        low, high, size=(count, int(known.sum())), random_state=rng
    )
    return found


def predictive(
    task: Task, draws: FloatArray, rng: np.random.Generator, *, fit_offset: bool
) -> Predictive:
    """Predict all records at draws of theta (n, size), with white noise at the records' level.

    The level is drawn from its conditional posterior, sigma^2 = S / (c chi^2) with the sum of
    squares S at the draw, c samples counting as one, and n / c degrees of freedom. With
    `fit_offset`, for draws of the prior, whose offsets are flat, the sensor's offset is the one
    that fits best, and the level is that of the fit.
    """
    kept, shown, noise = [], [], []
    for theta in draws:
        try:
            parts = predict(
                task.model, task.experiments, task.unknowns, theta,
                way=task.way, everything=True, differentiated=False,
            )  # fmt: skip
        except PsaError:
            continue
        clean = [p.displacement for p in parts]
        if fit_offset:
            clean = [y + np.mean(r) for y, r in zip(clean, _left(task, clean), strict=True)]
            levels = list(task.levels)
        else:
            levels = [
                _level(r, c, rng) for r, c in zip(_left(task, clean), task.inflation, strict=True)
            ]
        kept.append(theta)
        noise.append(levels)
        shown.append(
            [y + s * rng.standard_normal(len(y)) for y, s in zip(clean, levels, strict=True)]
        )
    count = len(task.experiments)
    return Predictive(
        theta=np.array(kept).reshape(len(kept), draws.shape[1]),
        displacement=tuple(
            np.array([own[k] for own in shown]).reshape(len(kept), e.record.n)
            for k, e in enumerate(task.experiments)
        ),
        noise=tuple(np.array([own[k] for own in noise]) for k in range(count)),
        failed=len(draws) - len(kept),
    )


def _left(task: Task, clean: Sequence[FloatArray]) -> list[FloatArray]:
    """Return what is left of the used samples of every record [m]."""
    pairs = zip(task.experiments, clean, strict=True)
    return [(measured(e.record) - y)[e.used] for e, y in pairs]


def _level(residual: FloatArray, inflation: float, rng: np.random.Generator) -> float:
    power = float(residual @ residual) / inflation
    return float(np.sqrt(power / rng.chisquare(len(residual) / inflation)))
