"""Continuing a fit: refits, noise levels, exchanged factors, whether two fits are as good.

Lags and oscillators that may stand in each other's place: the model's exchanges.

The linear part is a product, eqs. (13), (15), so that two of its factors can change places with
little effect: the two oscillators differ in the zero alone; the drive's lag stands before the
hysteresis and the creep lag after it, which shows only where the voltage turns; an overdamped
oscillator has a slow pole that looks like a lag. A search from one start may end on the wrong side.

Beside a fast oscillator, that slow pole of lag c/k brings a zero of lag c/k k_P/(k_P + k_B), or
c/k k_B/(k_P + k_B). Where the creep lag cancels the zero, the pole alone is left: it may be the
creep lag, and the oscillator as fast as the other one.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from psa_casadi.errors import PsaError
from psa_casadi.identification.determinacy import covariance_of
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.fitting.prediction import measured, predict
from psa_casadi.identification.fitting.unknowns import unknowns_of
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import first_order_noise, high_frequency_noise, uncertain
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import record_inputs, simulate_record
from psa_casadi.units import FloatArray

Values = Mapping[str, float]

#: A lag cancels a zero where it differs from the zero's lag by less than this share.
_CANCELS = 0.05


def exchanges(p: Values) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield (what changes places, the parameters that do so with their new values)."""
    drive = p["R_s"] * p["C_p"]
    yield "drive lag and creep lag", {"tau": drive, "R_s": p["tau"] / p["C_p"]}
    if "k_P" not in p:
        return
    ratio = p["k_P"] / p["k_B"]
    swapped = {f"{q}_P": p[f"{q}_B"] * ratio for q in "mc"}
    yield "wafers and bonding layers", swapped | {f"{q}_B": p[f"{q}_P"] / ratio for q in "mc"}
    for part, other, what in (("P", "B", "wafers"), ("B", "P", "bonding layers")):
        lag = p[f"c_{part}"] / p[f"k_{part}"]
        if lag**2 > 4.0 * p[f"m_{part}"] / p[f"k_{part}"]:
            slowed = {f"c_{part}": p["tau"] * p[f"k_{part}"]}
            yield f"creep lag and {what}", slowed | {"tau": lag}
            zero = lag * p[f"k_{part}"] / (p["k_P"] + p["k_B"])
            if abs(zero / p["tau"] - 1.0) < _CANCELS:
                share = p[f"k_{part}"] / p[f"k_{other}"]
                like = {f"{q}_{part}": p[f"{q}_{other}"] * share for q in "mc"}
                yield f"creep lag for the slow pole of the {what}", like | {"tau": lag}
            slowed = {f"c_{part}": drive * p[f"k_{part}"]}
            yield f"drive lag and {what}", slowed | {"R_s": lag / p["C_p"]}


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
    shares = []
    for s, e in zip(sigma, experiments, strict=True):
        y, v = e.measured(0)[e.at(0)], e.record.column("voltage")
        if y.size:
            along = np.arange(2.0) if v is None else v
            stretch = float(np.max(np.abs(along))) / max(float(np.ptp(along)), 1e-300)
            shares.append(s / max(float(np.ptp(y * max(1.0, stretch))), 1e-300))
    return float(np.clip(_OF_NOISE * min(shares, default=1.0), FIT_RTOL, _QUICK_RTOL))


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
    free: Sequence[str] | None = None,
    *,
    sigma: Sequence[float] | None = None,
    least: float = np.inf,
    evaluations: int = POLISH,
    tolerance: float = 1e-5,
) -> Fit:
    """Continue a fit from where it stands, of the same parameters unless others are `free`.

    Without `sigma` the noise levels are those that its residuals suggest. It may end early where
    the rms will stay above `least`, in the unit of the first output.
    """
    levels = sigma or residual_noise(previous, experiments)
    parts = zip(previous.residuals_of(experiments), levels, strict=True)
    now = sum(float(np.sum((part / level) ** 2)) for part, level in parts)
    return fit(
        previous.model,
        experiments,
        previous.unknowns.names if free is None else free,
        sigma=levels,
        start_states=previous.starts(),
        evaluations=evaluations,
        tolerance=tolerance,
        goal=now * (least / max(previous.rms, 1e-300)) ** 2,
    )


def relevelled(
    best: Fit, experiments: Sequence[Experiment], *, every: bool = False
) -> tuple[Fit, tuple[Experiment, ...]]:
    """Fit again with what the fit leaves of every further channel as its noise level.

    And of the first one where it is asked of `every` channel, until the levels stay the same. As it
    is where there is no such channel, and where a fit was interrupted.
    """
    now, rounds = tuple(experiments), _ALL_ROUNDS if every else _LEVEL_ROUNDS
    for _ in range(rounds if best.further else int(every)):
        told = best.channels if every else best.further
        levels = [f.relevelled() for f in told]
        pairs = zip(told, levels, strict=True)
        same = all(abs(float(np.log(f.level / q.level))) < _SAME_LEVEL for f, q in pairs)
        if best.interrupted or same:
            break
        now = tuple(e.beside(levels[every:]) for e in now)
        sigma = [max(levels[0].level, 1e-300)] * len(now) if every else best.sigma
        best = refit_or_keep(best, now, sigma=sigma, tolerance=1e-6 if every else 1e-5)
    return best, now


def weighted(before: Fit, experiments: Sequence[Experiment]) -> list[Experiment]:
    """Return the experiments with the levels of the further channels that weighted a fit."""
    return [e.beside(f.channel for f in before.further) for e in experiments]


#: Noise is estimated from so many samples or more, and differs from so many standard errors on.
_TELLING, _SURE = 32, 3.0


def with_noise(fit: Fit, experiments: Sequence[Experiment]) -> tuple[Experiment, ...]:
    """Return the experiments with their shares of the noise, as the fast parts of residuals tell.

    Of every output, over the usual one of all experiments (the geometric mean by samples). A share
    that cannot be told from 1 is 1. Of an experiment that is held out whole, its beginning tells.
    """
    shares = [[e.share(j) for j, _ in enumerate(e.channels)] for e in experiments]
    whole = [k for k, e in enumerate(experiments) if e.held_out_whole]
    shown = fit.shown(experiments) if whole else []
    for o in fit.channels:
        j = o.number
        rows = ((k, experiments[k], shown[k][:, j]) for k in whole)
        begun = ((k, e.errors(j, y)[e.at(j, e.known)]) for k, e, y in rows)
        fitted = zip(o.records, o.parts, strict=True)
        found = [(k, p) for k, p in (*fitted, *begun) if len(p) >= _TELLING]
        if len(found) < 2:
            continue
        noise = [max(first_order_noise(p)[0], o.straight, 1e-300) for _, p in found]
        over = np.log(noise) - np.average(np.log(noise), weights=[len(p) for _, p in found])
        for (k, part), own in zip(found, over, strict=True):
            if abs(own) > 0.5 * _SURE * uncertain(part):  # half of the power's error is the rms's
                shares[k][j] *= float(np.exp(own))
    return tuple(replace(e, noise=tuple(own)) for e, own in zip(experiments, shares, strict=True))


def unlike(experiments: Sequence[Experiment], others: Sequence[Experiment]) -> bool:
    """Whether the shares of the noise differ."""
    channels = range(len(experiments[0].channels))
    pairs = zip(experiments, others, strict=True)
    return any(a.share(j) != b.share(j) for a, b in pairs for j in channels)


def reweighted(best: Fit, experiments: Sequence[Experiment]) -> Fit:
    """Fit again with other shares of the noise."""
    again = refit(best, weighted(best, experiments), sigma=best.sigma, tolerance=1e-6)
    return relevelled(again, experiments, every=True)[0]


def refit_or_keep(
    previous: Fit,
    experiments: Sequence[Experiment],
    free: Sequence[str] | None = None,
    *,
    sigma: Sequence[float],
    tolerance: float = 1e-5,
) -> Fit:
    """Return the `refit`, or the previous fit where that leads to what cannot be simulated."""
    try:
        return refit(previous, experiments, free, sigma=sigma, tolerance=tolerance)
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


#: Parameters that only fast records determine: each is freed when the data can tell it.
FAST = ("m_P", "m_B", "m", "k_P")
#: Without this relative standard error k_P stays where it is: it would only blur every force.
_SHARP = 0.1
#: Evaluations of a fit from exchanged values, first and then to the end; rounds of exchanges; how
#: far above the best cost a first fit may be to be followed.
_FIRST, _LAST, _ROUNDS, _HOPEFUL = 5, 30, 3, 2.0


def with_fast(best: Fit, experiments: Sequence[Experiment], progress: Progress) -> Fit:
    """Free the fast parameters that these records can tell, if that lowers the cost clearly."""
    free = best.unknowns.names
    available = [n for n in FAST if n in best.model.values and n not in (*free, "k_P")]
    told = [n for n in available if _can_tell(best, experiments, n)]
    if not told:
        return best
    progress(f"base fit with {', '.join(told)}")
    states = best.starts()
    try:
        wider = fit(best.model, experiments, [*free, *told], sigma=best.sigma, start_states=states)
    except PsaError:
        return best
    needed = len(told) * np.log(len(best.residuals))
    return wider if wider.interrupted or wider.data_cost < best.data_cost - needed else best


def without_blur(best: Fit, experiments: Sequence[Experiment]) -> Fit:
    """Fix k_P where it is if the records tell it badly: forces then keep their proportions."""
    names = best.unknowns.names
    if "k_P" not in names:
        return best
    k = names.index("k_P")
    if np.sqrt(covariance_of(best, experiments)[k, k]) < _SHARP:
        return best
    free = [n for n in names if n != "k_P"]
    return refit_or_keep(best, experiments, free, sigma=best.sigma)


def exchanged(
    best: Fit, experiments: Sequence[Experiment], progress: Progress
) -> tuple[Fit, tuple[str, ...]]:
    """Fit again with factors of the linear part exchanged; return the best, and what stays open.

    See `exchanges`. Parameters of an exchange that fits as well are not told by the records. After
    an exchange that fits better, the others are tried once more.
    """
    for _ in range(_ROUNDS):
        different: set[str] = set()
        before = best
        for what, values in exchanges(best.model.values):
            progress(f"exchanged: {what}")
            bounds = {n: best.model.parameter(n).bounds for n in values}
            moved = {n: float(np.clip(v, *bounds[n])) for n, v in values.items()}
            other = quick_from(
                best, best.model.with_values(moved), experiments, best.unknowns.names,
                start_states=best.starts(), evaluations=_FIRST,
            )  # fmt: skip
            near = other and other.data_cost <= _HOPEFUL * best.data_cost
            if other is None or other.interrupted or not near:
                continue
            try:
                other = fit(
                    other.model, experiments, best.unknowns.names, sigma=best.sigma,
                    start_states=other.starts(), evaluations=_LAST,
                )  # fmt: skip
            except PsaError:
                continue
            different |= set(differing(best, other, experiments))
            if other.data_cost < best.data_cost and (other.interrupted or not equal(best, other)):
                best = other
                break
        if best is before or best.interrupted:
            return best, tuple(different)
    return best, ()


def _can_tell(best: Fit, experiments: Sequence[Experiment], name: str) -> bool:
    """Whether a further parameter would have a standard error below half a logarithmic unit."""
    known, count = best.unknowns, len(best.unknowns.names)
    none: list[dict[str, float]] = [{} for _ in experiments]
    fresh = unknowns_of(
        best.model, [*known.names, name], none, known.first_voltage, known.offset_scale
    )
    prior = np.concatenate([fresh.prior[: count + 1], known.prior[count:]])
    unknowns = replace(fresh, started=known.started, start_scale=known.start_scale, prior=prior)
    theta = np.concatenate([np.zeros(count + 1), best.theta[count:]])
    try:
        parts = predict(best.model, experiments, unknowns, theta, way=best.way)
    except PsaError:
        return False
    jacobian = np.vstack(
        [p.jacobian[e.used[: e.stop]] for p, e in zip(parts, experiments, strict=True)]
    )
    scaled = jacobian / max(best.rms, min(best.sigma))
    information = scaled.T @ scaled + np.diag(1.0 / unknowns.prior**2)
    return bool(np.sqrt(np.linalg.pinv(information, hermitian=True)[count, count]) < 0.5)


#: Error of the simulated force over its range: far below the noise of what it is fitted to.
_FORCE_RTOL = 1e-5


def force_of(fit: Fit, number: int, record: Record) -> FloatArray:
    """Return a record's simulated force in front of the lag (samples,) [N].

    `number` is the record's place in the fit; the error is far below what sensors see. Raises
    PsaError where it cannot be simulated.
    """
    found = simulate_record(fit.model, record, memory=fit.start(number), rtol=_FORCE_RTOL)
    s = fit.model.structure
    states = np.array([found.states[n] for n in fit.model.state_names])
    inputs = record_inputs(fit.model, record, record.n).T
    force = ca.Function("force", [s.time, s.x, s.u, s.p], [s.sums["free_force"]])
    values = force(record.time[None, :], states, inputs, fit.model.parameter_vector())
    return np.asarray(values, dtype=np.float64).reshape(-1)
