"""Continuing a fit: refits, noise levels, and whether two fits are equally good."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import PsaError
from psa_casadi.identification.certainty.determinacy import covariance_of
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.split import Experiment, Level

FloatArray = npt.NDArray[np.float64]

#: Evaluations that a fit gets to its end.
POLISH = 100
#: The stepper's loosest tolerance, and its tolerance over the noise's share of the range, in quick
#: fits. Its error is some six times the tolerance, of the range.
_QUICK_RTOL, _OF_NOISE = 1e-4, 0.02
#: Rounds of fits with a further column's residual as its noise level; logarithms of levels that are
#: the same differ by less.
_LEVEL_ROUNDS, _SAME_LEVEL = 2, 0.02
#: Fits whose costs differ by less, in units of the log-likelihood's double, are equally good.
_EQUAL = 3.84
#: ... or by less than this share of what the model's own error adds to the cost.
_OF_EXCESS = 0.05
#: ... and they differ where a parameter is this many standard errors apart.
_APART = 4.0

Progress = Callable[[str], None]


def noise_levels(experiments: Sequence[Experiment]) -> list[float]:
    """Return the white noise of every record's displacement [m], from its fast differences."""
    levels = []
    for e in experiments:
        y = measured(e.record)[e.known]
        levels.append(max(high_frequency_noise(y), 1e-6 * float(np.ptp(y)), 1e-15))
    return levels


def quick_rtol(sigma: Sequence[float], experiments: Sequence[Experiment]) -> float:
    """Return the stepper's tolerance for quick fits: its error stays well below the noise [m].

    The error is a share of all that the voltage moves from 0, not only of the record's range.
    """
    parts = [_moved(e) for e in experiments]
    shares = [
        s / max(float(np.ptp(y)), 1e-300) for s, y in zip(sigma, parts, strict=True) if y.size
    ]
    return float(np.clip(_OF_NOISE * min(shares, default=1.0), FIT_RTOL, _QUICK_RTOL))


def _moved(e: Experiment) -> FloatArray:
    """Return the used displacement (n,) [m], as large as if the voltage's range began at 0."""
    v = e.record.voltage
    stretch = float(np.max(np.abs(v))) / max(float(np.ptp(v)), 1e-300)
    moved: FloatArray = measured(e.record)[e.used] * max(1.0, stretch)
    return moved


def record_rms(previous: Fit, experiments: Sequence[Experiment]) -> list[float]:
    """Return the root mean square of every record's residual [m]."""
    parts = previous.residuals_of(experiments)
    return [max(float(np.sqrt(np.mean(p**2))), 1e-15) if len(p) else 1e-15 for p in parts]


def residual_noise(previous: Fit, experiments: Sequence[Experiment]) -> list[float]:
    """Return the white noise of every record's residual [m], from its fast differences.

    That of a record without a fitted sample stays as it was.
    """
    parts = zip(previous.residuals_of(experiments), previous.sigma, strict=True)
    return [max(high_frequency_noise(p), 1e-15) if p.size else sigma for p, sigma in parts]


def refit(
    previous: Fit,
    experiments: Sequence[Experiment],
    free: Sequence[str],
    *,
    sigma: Sequence[float] | None = None,
    least: float = np.inf,
) -> Fit:
    """Continue a fit from where it stands, with the noise level its residuals suggest.

    It may end early where the rms will stay above `least` [m].
    """
    levels = sigma or residual_noise(previous, experiments)
    parts = zip(previous.residuals_of(experiments), levels, strict=True)
    now = sum(float(np.sum((part / level) ** 2)) for part, level in parts)
    return fit(
        previous.model,
        experiments,
        free,
        sigma=levels,
        start_states=previous.starts(),
        evaluations=POLISH,
        goal=now * (least / max(previous.rms, 1e-300)) ** 2,
    )


def relevelled(best: Fit, experiments: Sequence[Experiment]) -> tuple[Fit, tuple[Experiment, ...]]:
    """Fit again with what the fit leaves of every further column as that column's noise level.

    As it is without such columns, and where a fit was interrupted.
    """
    now = tuple(experiments)
    for _ in range(_LEVEL_ROUNDS if best.further else 0):
        if best.interrupted:
            break
        levels = tuple(Level(f.column, max(f.rms, f.straight)) for f in best.further)
        pairs = zip(best.further, levels, strict=True)
        if all(abs(float(np.log(f.level / q.value))) < _SAME_LEVEL for f, q in pairs):
            break
        now = tuple(replace(e, further=levels) for e in now)
        best = refit_or_keep(best, now, best.unknowns.names, best.sigma)
    return best, now


def refit_or_keep(
    previous: Fit, experiments: Sequence[Experiment], free: Sequence[str], sigma: Sequence[float]
) -> Fit:
    """Return the `refit`, or the previous fit where that leads to what cannot be simulated."""
    try:
        return refit(previous, experiments, free, sigma=sigma)
    except PsaError:
        return previous


def quick_from(
    previous: Fit,
    model: Model,
    experiments: Sequence[Experiment],
    free: Sequence[str],
    *,
    start_states: Sequence[Mapping[str, float]],
    evaluations: int,
    start: Mapping[str, float] | None = None,
) -> Fit | None:
    """Fit a little from other values, weighted as before; None if these cannot be simulated."""
    try:
        return fit(
            model,
            experiments,
            free,
            sigma=previous.sigma,
            start=start,
            start_states=start_states,
            evaluations=evaluations,
            rtol=quick_rtol(previous.sigma, experiments),
        )
    except PsaError:
        return None


def equal(one: Fit, other: Fit) -> bool:
    """Whether two fits are equally likely.

    Beyond the noise, what the model lacks is in both costs; a gain of a small share of that says
    more about the lack than about the parameters.
    """
    count = max(len(one.residuals), 1)
    excess = max(min(one.data_cost, other.data_cost) - count, 0.0)
    limit = _EQUAL * max(one.data_cost / count, 1.0) + _OF_EXCESS * excess
    return abs(one.data_cost - other.data_cost) < limit


def differing(one: Fit, other: Fit, experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Return the parameters in which two equally likely fits differ beyond their intervals."""
    if one is other or not equal(one, other):
        return ()
    count = len(one.unknowns.names)
    there = one.unknowns.coordinates(other.model.values)
    variances = np.diag(covariance_of(one, experiments))[:count]
    errors = np.sqrt(np.where(variances > 0.0, variances, np.inf))  # by rounding of what is open
    apart = np.abs(there - one.theta[:count]) > _APART * errors
    return tuple(n for n, far in zip(one.unknowns.names, apart, strict=True) if far)


def same_place(one: Fit, other: Fit, experiments: Sequence[Experiment]) -> bool:
    """Whether two fits are equally likely and differ in no parameter beyond its interval."""
    return equal(one, other) and not differing(one, other, experiments)
