"""Mechanics fitted again: factors of the linear part exchanged, and from the fit's force.

The linear part is a product, eqs. (13), (15), so that two of its factors can change places with
little effect: the two oscillators differ in the zero alone; the drive's lag is before the
hysteresis and the creep lag after it, which shows only where the voltage turns; an overdamped
oscillator has a slow pole that looks like a lag. A search from one start may end on the wrong side.

With a fast oscillator, that slow pole of lag c/k brings a zero of lag c/k k_P/(k_P + k_B), or
c/k k_B/(k_P + k_B). Where the creep lag cancels the zero, the pole alone is left: it may be the
creep lag, and the oscillator as fast as the other one.

Two resonances within the band, a lag and the zero between them give a fit many local minima, most
of them far above the noise. There the force is nearly right: what it has of the voltage's history
is quasi-static and hardly depends on the mechanics. So the fit's force, simulated, takes the
voltage's place in `linear_start`: poles by vector fitting, placed, refined with the ratio k_P/k_B
free, and a full fit from each of the best. The play operators of `starting_points` then stand for
what is wrong with that force. A better fit has a better force.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import log

import casadi as ca
import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.progress import Progress
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.determinacy import covariance_of
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import predict
from psa_casadi.identification.fitting.unknowns import static_compliance, unknowns_of, within_bounds
from psa_casadi.identification.refitting import (
    differing,
    equal,
    quick_from,
    record_rms,
    refit,
    refit_or_keep,
    residual_noise,
)
from psa_casadi.identification.start.linear_response import oscillators
from psa_casadi.identification.start.starting_points import Excerpt, fastest_part, placed, sought
from psa_casadi.records.record import Record
from psa_casadi.records.split import fitted
from psa_casadi.simulation.simulate import record_inputs, simulate_record

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


#: Parameters that only fast records determine: each is freed if the data determine it.
FAST = ("m_P", "m_B", "m", "k_P")
#: A resonance beyond this many times the sampling rate adds (0.5/10)^2 = 1/400 to what moves at
#: half of it: a free mass would follow a misfit, to where its ringing is sampled as a slow motion.
_BEYOND = 10.0
#: Without this relative standard error k_P stays where it is: it would only blur every force.
_SHARP = 0.1
#: Evaluations of a fit with fast parameters, and from exchanged values, first and then to the end;
#: rounds of exchanges; how far above the best cost a first fit may be to be followed.
_WIDER, _FIRST, _LAST, _ROUNDS, _HOPEFUL = 40, 5, 30, 3, 2.0


def with_fast(best: Fit, progress: Progress) -> Fit:
    """Free the fast parameters that these records determine, if that lowers the cost clearly.

    Not a mass whose resonance is beyond what they show.
    """
    free = best.unknowns.names
    available = [n for n in FAST if n in best.model.values and n not in (*free, "k_P")]
    more = [n for n in available if _would_determine(best, n)]
    while more:
        progress(f"base fit with {', '.join(more)}")
        try:
            wider = refit(best, [*free, *more], sigma=best.sigma, evaluations=_WIDER)
        except PsaError:
            return best
        shown = [n for n in more if not _is_beyond(wider, n)]
        if shown == more or wider.interrupted:
            break
        more = shown
    else:
        return best
    needed = len(more) * np.log(len(best.residuals))
    return wider if wider.interrupted or wider.data_cost < best.data_cost - needed else best


def _is_beyond(fit: Fit, mass: str) -> bool:
    """Whether the resonance of a mass is too fast to show in the records."""
    p = fit.model.values
    tone = np.sqrt(p[mass.replace("m", "k")] / p[mass]) / (2.0 * np.pi)
    return bool(tone * shortest_interval(fit) > _BEYOND)


def shortest_interval(fit: Fit) -> float:
    """Return the shortest sampling interval of the fitted records [s]."""
    return min(e.record.sample_time for e in fitted(fit.experiments))


def without_blur(best: Fit) -> Fit:
    """Fix k_P where it is if its standard error is large: forces then keep their proportions."""
    names = best.unknowns.names
    if "k_P" not in names:
        return best
    k = names.index("k_P")
    if np.sqrt(covariance_of(best)[k, k]) < _SHARP:
        return best
    free = [n for n in names if n != "k_P"]
    return refit_or_keep(best, free, sigma=best.sigma)


def exchanged(best: Fit, progress: Progress) -> tuple[Fit, tuple[str, ...]]:
    """Fit again with factors of the linear part exchanged; return the best, and what stays open.

    See `exchanges`. The records do not determine parameters of an exchange that fits as well. After
    an exchange that fits better, the others are tried once more.
    """
    for _ in range(_ROUNDS):
        different: set[str] = set()
        before = best
        for what, values in exchanges(best.model.values):
            progress(f"exchanged: {what}")
            moved = within_bounds(best.model, values)
            other = quick_from(
                best, best.model.with_values(moved), best.unknowns.names,
                start_states=best.starts(), evaluations=_FIRST,
            )  # fmt: skip
            near = other and other.data_cost <= _HOPEFUL * best.data_cost
            if other is None or other.interrupted or not near:
                continue
            try:
                other = refit(other, sigma=best.sigma, evaluations=_LAST)
            except PsaError:
                continue
            different |= set(differing(best, other))
            if other.data_cost < best.data_cost and (other.interrupted or not equal(best, other)):
                best = other
                break
        if best is before or best.interrupted:
            return best, tuple(different)
    return best, ()


def _would_determine(best: Fit, name: str) -> bool:
    """Whether a further parameter would have a standard error below half a logarithmic unit."""
    experiments, known, count = best.experiments, best.unknowns, len(best.unknowns.names)
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
    trajectory = simulate_record(fit.model, record, memory=fit.start(number), rtol=_FORCE_RTOL)
    s = fit.model.structure
    states = np.array([trajectory.states[n] for n in fit.model.state_names])
    inputs = record_inputs(fit.model, record, record.n).T
    force = ca.Function("force", [s.time, s.x, s.u, s.p], [s.sums["free_force"]])
    values = force(record.time[None, :], states, inputs, fit.model.parameter_vector())
    return np.asarray(values, dtype=np.float64).reshape(-1)


#: Samples that one record and all together may have, and the fewest that count.
_MOST, _ALL, _FEWEST = 6_000, 12_000, 16
#: Share of them that is left out as the transient: from the record's start, and from amid it.
_LEAD, _AMID = 0.01, 0.2
#: Records sampled this much more slowly than the fastest add no dynamics.
_SLOWER = 30.0
#: Orders of vector fitting.
_ORDERS = (2, 3, 4, 5, 6)
#: How many starts get a few evaluations, how many of these a full refinement.
_REFINEMENTS = ((12, 6), (4, 25))
#: How many full fits are started, with how many evaluations, how many are ended, and rounds.
_BEGUN, _QUICK, _ENDED, _REPEATS = 3, 15, 2, 4
#: The fit misses something where its rms is this much above the noise; a better one lowers the
#: cost, twice the log-likelihood, by more than this.
_MISSED, _BETTER = 1.01, 20.0
#: Share of the rms that is taken for noise at least.
_FLOOR = 0.1
_FREE = ("m_P", "m_B", "k_P")
_FORCES = ("k_L", "A", "beta", "gamma", "delta", "h_ref")


def retuned(best: Fit, progress: Progress, *, reached: float = np.inf) -> Fit:
    """Return a fit whose mechanics was sought again while that explains more; `best` if nothing.

    It is sought while residuals of records exceed their fast part, which has some of a misfit's
    ringing, or than the rms [m] that another model has `reached`. Needs two resonators (k_P, k_B);
    records on instants that are not uniform do not contribute. A keyboard interrupt ends it at the
    best fit so far.
    """
    if "k_P" not in best.model.values:
        return best
    for _ in range(_REPEATS):
        levels = residual_noise(best)
        pairs = zip(record_rms(best), levels, strict=True)
        misfit = best.rms > reached or any(rms > _MISSED * level for rms, level in pairs)
        if best.interrupted or not misfit:
            return best
        progress("base fit, mechanics again behind the fitted force")
        try:
            better = _once(best)
        except KeyboardInterrupt:
            return replace(best, interrupted=True)
        except (PsaError, np.linalg.LinAlgError):
            return best
        if better is None or better.data_cost > best.data_cost - _BETTER:
            return best
        best = better
    return best


def _once(best: Fit) -> Fit | None:
    parts = list(_parts(best))
    if not parts:
        return None
    ratio = log(best.model.values["k_P"] / best.model.values["k_B"])
    starts = [s for e in parts for s in placed(e, e.v, _ORDERS, (ratio, -ratio), weak=False)]
    names = list(dict.fromkeys([*best.unknowns.names, *_FREE]))
    forces = {s.name for s in best.model.structure.states if s.unit == "N"}
    fits = []
    for linear in sought(parts, starts, _REFINEMENTS, ratio_free=True)[0][:_BEGUN]:
        values = _values(best, linear.theta)
        scale = values["k_L"] / best.model.values["k_L"]  # memories of forces change with them
        states = [
            {n: v * (scale if n in forces else 1.0) for n, v in s.items()} for s in best.starts()
        ]
        quick = quick_from(
            best, best.model.with_values(values), names,
            start_states=states, evaluations=_QUICK,
        )  # fmt: skip
        fits += [quick] if quick else []
    nearest = sorted(fits, key=lambda f: f.data_cost)[:_ENDED]
    ended = [refit(f, names, sigma=best.sigma, least=best.rms) for f in nearest]
    if any(f.interrupted for f in (*nearest, *ended)):
        raise KeyboardInterrupt
    return min(ended, key=lambda f: f.data_cost, default=None)


def _parts(best: Fit) -> Iterator[Excerpt]:
    """Yield the records with the fit's force, in metres of static displacement, for a voltage."""
    fastest = shortest_interval(best)
    values, levels, total = best.model.values, residual_noise(best), 0
    for k, e in enumerate(best.experiments):
        record, y = e.record, e.record.measured
        steps, there = np.diff(record.time), np.isfinite(y)
        uneven = np.ptp(steps) > 0.01 * record.sample_time
        if uneven or record.sample_time > _SLOWER * fastest or total >= _ALL:
            continue
        first = fastest_part(record.voltage, _MOST) if y.size > _MOST else 0
        cut = slice(first, first + _MOST)
        valid = (e.used & there)[cut]
        valid[: max(1, int((_AMID if first else _LEAD) * valid.size))] = False
        if valid.sum() < _FEWEST or not np.ptp(record.voltage[cut][valid]):
            continue
        force = force_of(best, k, record)
        source = (force[cut] - force[cut][0]) * static_compliance(values)
        filled = np.interp(np.arange(y.size), np.flatnonzero(there), y[there])
        level = max(levels[k], _FLOOR * best.rms)
        total += valid.size
        yield Excerpt(
            name=record.name,
            h=record.duration / steps.size,
            longest=record.duration,
            v=source,
            y=filled[cut] - filled[cut][0],
            valid=valid,
            sigma=level,
            loop=source,
            static=best.rms,
        )


def _values(best: Fit, theta: FloatArray) -> dict[str, float]:
    """Return the parameters of theta, forces scaled to keep the displacement.

    Of the two lags behind the force the slower is the creep lag; the other one is added to the
    drive's.
    """
    p = best.model.values
    one, two, *_, ratio = np.exp(theta).tolist()
    k_b, k_p = p["k_B"], ratio * p["k_B"]
    lags = {"tau": max(one, two), "R_s": p["R_s"] + min(one, two) / p["C_p"]}
    table = {**lags, "k_P": k_p, **oscillators(theta, k_p, k_b)}
    scale = static_compliance(p) / static_compliance({**p, **table})
    table |= {n: scale * p[n] for n in _FORCES if n in p}
    return within_bounds(best.model, table)
