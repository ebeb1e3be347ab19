"""Continuing a fit: refits, noise levels, shares of the noise, whether two fits are as good."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Unpack

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.identification.determinacy import covariance_of
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit, How, fit
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import first_order_noise, high_frequency_noise, uncertain
from psa_casadi.records.split import Experiment

#: Evaluations that a fit gets to its end.
POLISH = 100
#: The stepper's loosest tolerance, and its tolerance over the noise's share of the range, in quick
#: fits. Its error is some six times the tolerance, of the range.
_QUICK_RTOL, _OF_NOISE = 1e-4, 0.02
#: Rounds of fits with a further channel's residual as its noise level, and with every one's;
#: logarithms of levels that are the same differ by less.
_LEVEL_ROUNDS, _ALL_ROUNDS, _SAME_LEVEL = 2, 4, 0.02
#: Fits whose costs differ by less, in units of the log-likelihood's double, are equally good.
_EQUAL = 3.84
#: ... or by less than this share of what the model's error adds to the cost.
_OF_EXCESS = 0.05
#: ... and they differ where a parameter is this many standard errors apart.
_APART = 4.0


def noise_levels(experiments: Sequence[Experiment]) -> list[float]:
    """Return the white noise of every record's displacement [m], from its fast differences."""
    levels = []
    for e in experiments:
        y = e.record.measured[e.known]
        levels.append(max(high_frequency_noise(y), 1e-6 * float(np.ptp(y)), 1e-15))
    return levels


def quick_rtol(sigma: Sequence[float], experiments: Sequence[Experiment]) -> float:
    """Return the stepper's tolerance for quick fits: its error stays well below the noise [m].

    The error is a share of all that the voltage moves from 0, not only of the record's range.
    """
    shares = []
    for s, e in zip(sigma, experiments, strict=True):
        y, v = e.measured(0)[e.at(0)], e.record.column("voltage")
        if y.size:
            along = np.arange(2.0) if v is None else v
            stretch = float(np.max(np.abs(along))) / max(float(np.ptp(along)), 1e-300)
            shares.append(s / max(float(np.ptp(y * max(1.0, stretch))), 1e-300))
    return float(np.clip(_OF_NOISE * min(shares, default=1.0), FIT_RTOL, _QUICK_RTOL))


def record_rms(previous: Fit) -> list[float]:
    """Return the root mean square of every record's residual [m]."""
    parts = previous.record_residuals
    return [max(float(np.sqrt(np.mean(p**2))), 1e-15) if len(p) else 1e-15 for p in parts]


def residual_noise(previous: Fit) -> list[float]:
    """Return the white noise of every record's residual [m], from its fast differences.

    That of a record without a fitted sample stays as it was.
    """
    parts = zip(previous.record_residuals, previous.sigma, strict=True)
    return [max(high_frequency_noise(p), 1e-15) if p.size else sigma for p, sigma in parts]


def refit(
    previous: Fit,
    free: Sequence[str] | None = None,
    *,
    others: Sequence[Experiment] | None = None,
    sigma: Sequence[float] | None = None,
    least: float = np.inf,
    **how: Unpack[How],
) -> Fit:
    """Continue a fit from its end, of the same parameters unless others are `free`.

    `others` are as many experiments that take the place of those of the fit, which keep the levels
    of its further channels. Without `sigma` the noise levels are those that its residuals suggest.
    It may end early where the rms will stay above `least`, in the unit of the first output.
    """
    levels = sigma or residual_noise(previous)
    parts = zip(previous.record_residuals, levels, strict=True)
    now = sum(float(np.sum((part / level) ** 2)) for part, level in parts)
    how.setdefault("evaluations", POLISH)
    how.setdefault("goal", now * (least / max(previous.rms, 1e-300)) ** 2)
    return fit(
        previous.model,
        previous.experiments if others is None else weighted(previous, others),
        previous.unknowns.names if free is None else free,
        sigma=levels, start_states=previous.starts(), **how,
    )  # fmt: skip


def relevelled(best: Fit, *, every: bool = False) -> Fit:
    """Fit again with what the fit leaves of every further channel as its noise level.

    With `every`, of the first one too, until the levels stay the same. The fit itself if there is
    no such channel, or it was interrupted.
    """
    rounds = _ALL_ROUNDS if every else _LEVEL_ROUNDS
    for _ in range(rounds if best.further else int(every)):
        channels = best.channels if every else best.further
        levels = [f.relevelled() for f in channels]
        pairs = zip(channels, levels, strict=True)
        same = all(abs(float(np.log(f.level / q.level))) < _SAME_LEVEL for f, q in pairs)
        if best.interrupted or same:
            break
        sigma = [max(levels[0].level, 1e-300)] * len(best.sigma) if every else best.sigma
        best = replace(
            best, experiments=tuple(e.with_further(levels[every:]) for e in best.experiments)
        )
        best = refit_or_keep(best, sigma=sigma, tolerance=1e-6 if every else 1e-5)
    return best


def weighted(before: Fit, experiments: Sequence[Experiment]) -> list[Experiment]:
    """Return the experiments with the levels of the further channels that weighted a fit."""
    return [e.with_further(f.channel for f in before.further) for e in experiments]


#: Fewest samples for an estimate of noise, and standard errors from which on noise differs.
_FEWEST, _SURE = 32, 3.0


def with_noise(fit: Fit) -> tuple[Experiment, ...]:
    """Return the experiments with their shares of the noise, from the fast parts of residuals.

    Of every output, over the usual one of all experiments (the geometric mean by samples). A share
    that does not differ from 1 is 1. Of an experiment that is held out whole, its first tenth
    counts.
    """
    experiments = fit.experiments
    shares = [[e.share(j) for j, _ in enumerate(e.channels)] for e in experiments]
    whole = [k for k, e in enumerate(experiments) if e.held_out_whole]
    predicted = fit.predicted_channels() if whole else []
    for o in fit.channels:
        j = o.number
        rows = ((k, experiments[k], predicted[k][:, j]) for k in whole)
        started = ((k, e.errors(j, y)[e.at(j, e.known)]) for k, e, y in rows)
        fitted = zip(o.records, o.parts, strict=True)
        parts = [(k, p) for k, p in (*fitted, *started) if len(p) >= _FEWEST]
        if len(parts) < 2:
            continue
        noise = [max(first_order_noise(p)[0], o.straight, 1e-300) for _, p in parts]
        over = np.log(noise) - np.average(np.log(noise), weights=[len(p) for _, p in parts])
        for (k, part), ratio in zip(parts, over, strict=True):
            if abs(ratio) > 0.5 * _SURE * uncertain(part):  # half of the power's error is the rms's
                shares[k][j] *= float(np.exp(ratio))
    return tuple(replace(e, noise=tuple(s)) for e, s in zip(experiments, shares, strict=True))


def unlike(experiments: Sequence[Experiment], others: Sequence[Experiment]) -> bool:
    """Whether the shares of the noise differ."""
    channels = range(len(experiments[0].channels))
    pairs = zip(experiments, others, strict=True)
    return any(a.share(j) != b.share(j) for a, b in pairs for j in channels)


def reweighted(best: Fit, experiments: Sequence[Experiment]) -> Fit:
    """Fit again with other shares of the noise."""
    again = refit(best, others=experiments, sigma=best.sigma, tolerance=1e-6)
    return relevelled(again, every=True)


def refit_or_keep(
    previous: Fit, free: Sequence[str] | None = None, *, sigma: Sequence[float], **how: Unpack[How]
) -> Fit:
    """Return the `refit`, or the previous fit where that leads to what cannot be simulated."""
    try:
        return refit(previous, free, sigma=sigma, **how)
    except PsaError:
        return previous


def quick_from(
    previous: Fit,
    model: Model,
    free: Sequence[str],
    *,
    start_states: Sequence[Mapping[str, float]],
    evaluations: int,
    start: Mapping[str, float] | None = None,
) -> Fit | None:
    """Fit a little from other values, weighted as before; None if these cannot be simulated."""
    try:
        return fit(
            model, previous.experiments, free, sigma=previous.sigma, start=start,
            start_states=start_states, evaluations=evaluations,
            rtol=quick_rtol(previous.sigma, previous.experiments),
        )  # fmt: skip
    except PsaError:
        return None


def equal(one: Fit, other: Fit) -> bool:
    """Whether two fits are equally likely.

    Beyond the noise, what the model lacks is in both costs; a gain of a small share of that is
    due to the lack rather than to the parameters.
    """
    count = max(len(one.residuals), 1)
    excess = max(min(one.data_cost, other.data_cost) - count, 0.0)
    limit = _EQUAL * max(one.data_cost / count, 1.0) + _OF_EXCESS * excess
    return abs(one.data_cost - other.data_cost) < limit


def differing(one: Fit, other: Fit) -> tuple[str, ...]:
    """Return the parameters in which two equally likely fits differ beyond their intervals."""
    if one is other or not equal(one, other):
        return ()
    count = len(one.unknowns.names)
    there = one.unknowns.coordinates(other.model.values)
    variances = np.diag(covariance_of(one))[:count]
    errors = np.sqrt(np.where(variances > 0.0, variances, np.inf))  # by rounding of what is open
    apart = np.abs(there - one.theta[:count]) > _APART * errors
    return tuple(n for n, far in zip(one.unknowns.names, apart, strict=True) if far)


def same_place(one: Fit, other: Fit) -> bool:
    """Whether two fits are equally likely and differ in no parameter beyond its interval."""
    return equal(one, other) and not differing(one, other)
