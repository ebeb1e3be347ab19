"""Lags and oscillators that may stand in each other's place: the exchanges of a stack's model.

The linear part is a product, eqs. (13), (15), so that two of its factors can change places with
little effect: the two oscillators differ in the zero alone; the drive's lag stands before the
hysteresis and the creep lag after it, which shows only where the voltage turns; an overdamped
oscillator has a slow pole that looks like a lag. A search from one start may end on the wrong side.

Beside a fast oscillator, that slow pole of lag c/k brings a zero of lag c/k k_P/(k_P + k_B), or
c/k k_B/(k_P + k_B). Where the creep lag cancels the zero, the pole alone is left: it may be the
creep lag, and the oscillator as fast as the other one.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from psa_casadi.errors import PsaError
from psa_casadi.identification.determinacy import covariance_of
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.fitting.prediction import predict
from psa_casadi.identification.fitting.unknowns import unknowns_of
from psa_casadi.identification.refitting import (
    differing,
    equal,
    quick_from,
    refit_or_keep,
)
from psa_casadi.progress import Progress
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
    items = [n for n in available if _can_tell(best, experiments, n)]
    if not items:
        return best
    progress(f"base fit with {', '.join(items)}")
    states = best.starts()
    try:
        wider = fit(best.model, experiments, [*free, *items], sigma=best.sigma, start_states=states)
    except PsaError:
        return best
    needed = len(items) * np.log(len(best.residuals))
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
    trajectory = simulate_record(fit.model, record, memory=fit.start(number), rtol=_FORCE_RTOL)
    s = fit.model.structure
    states = np.array([trajectory.states[n] for n in fit.model.state_names])
    inputs = record_inputs(fit.model, record, record.n).T
    force = ca.Function("force", [s.time, s.x, s.u, s.p], [s.sums["free_force"]])
    values = force(record.time[None, :], states, inputs, fit.model.parameter_vector())
    return np.asarray(values, dtype=np.float64).reshape(-1)
