"""What a search does once a minimum is found: fast parameters, exchanged factors, assumed k_P."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from psa_casadi.errors import PsaError
from psa_casadi.identification.certainty.determinacy import covariance_of
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.fitting.prediction import predict
from psa_casadi.identification.fitting.unknowns import unknowns_of
from psa_casadi.identification.search.exchanges import exchanges
from psa_casadi.identification.search.refitting import (
    Progress,
    differing,
    equal,
    quick_from,
    refit_or_keep,
)
from psa_casadi.records.split import Experiment

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
    return refit_or_keep(best, experiments, [n for n in names if n != "k_P"], best.sigma)


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
            other = _from(best, values, experiments, progress, what)
            if other is None:
                continue
            different |= set(differing(best, other, experiments))
            if other.data_cost < best.data_cost and (other.interrupted or not equal(best, other)):
                best = other
                break
        if best is before or best.interrupted:
            return best, tuple(different)
    return best, ()


def _from(
    best: Fit,
    values: Mapping[str, float],
    experiments: Sequence[Experiment],
    progress: Progress,
    what: str,
) -> Fit | None:
    """Fit from exchanged values, quickly, and to the end if that is near; None if it is not."""
    progress(f"exchanged: {what}")
    free = best.unknowns.names
    states = best.starts()
    low_high = {n: best.model.parameter(n).bounds for n in values}
    moved = {n: min(max(v, low_high[n][0]), low_high[n][1]) for n, v in values.items()}
    model = best.model.with_values(moved)
    quick = quick_from(best, model, experiments, free, start_states=states, evaluations=_FIRST)
    if quick is None or quick.interrupted or quick.data_cost > _HOPEFUL * best.data_cost:
        return None
    try:
        return fit(
            quick.model,
            experiments,
            free,
            sigma=best.sigma,
            start_states=quick.starts(),
            evaluations=_LAST,
        )
    except PsaError:
        return None


def _can_tell(best: Fit, experiments: Sequence[Experiment], name: str) -> bool:
    """Whether a further parameter would have a standard error below half a logarithmic unit."""
    free = best.unknowns.names
    names = [*free, name]
    none: list[dict[str, float]] = [{} for _ in experiments]
    known = best.unknowns
    fresh = unknowns_of(best.model, names, none, known.first_voltage, known.offset_scale)
    count = len(free)
    unknowns = replace(
        fresh,
        started=best.unknowns.started,
        start_scale=best.unknowns.start_scale,
        prior=np.concatenate([fresh.prior[: count + 1], best.unknowns.prior[count:]]),
    )
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
