"""The search for a fit: several starts, the best ones to the end, then what can be told besides."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from psa_casadi.errors import PsaError
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.determinacy import covariance_of
from psa_casadi.identification.exchanges import exchanges
from psa_casadi.identification.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.linear_start import LinearCandidate
from psa_casadi.identification.noise import high_frequency_noise
from psa_casadi.identification.prediction import measured, predict
from psa_casadi.identification.starting import loop_starts
from psa_casadi.identification.unknowns import static_compliance, unknowns_of
from psa_casadi.model.compose import Model

#: Parameters that voltage and displacement determine in every record with loops.
CORE = ("k_L", "A", "beta", "gamma", "delta", "n", "tau", "R_s", "c_P", "c_B", "c")
#: Parameters that only fast records determine: each is freed when the data can tell it.
FAST = ("m_P", "m_B", "m", "k_P")
#: Without this relative standard error k_P stays where it is: it would only blur every force.
_SHARP = 0.1
#: Parameters of effects that only set a scale and are never searched.
FIXED = frozenset({"drift_span"})

_QUICK, _POLISH, _EXCHANGE = 12, 100, 30
#: Rounds of exchanges, and how far above the best cost a quick fit may be to be followed.
_EXCHANGES, _HOPEFUL = 3, 2.0
_QUICK_RTOL = 1e-4
#: Where there are more starts than finalists, all get the first evaluations, those the rest.
_FINALISTS, _FIRST = 3, 5
#: The second best is followed to the end where its cost is at most this much larger.
_NEAR = 1.5
#: A start whose quick fit comes this close to the best one's cost is followed to the end.
_CLOSE = 1.02
#: Candidate dynamics that miss the fast records this much more than the best are not tried.
_WORSE, _DYNAMICS = 1.2, 3
#: Fits whose costs differ by less, in units of the log-likelihood's double, are equally good.
_EQUAL = 3.84
#: ... and they differ where a parameter is this many standard errors apart.
_APART = 4.0

Progress = Callable[[str], None]


@dataclass(frozen=True)
class StartOutcome:
    """One start of the search: its name, the cost and rms [m] it led to, and what became of it.

    `agrees` is True where it led to the same minimum as the best, False where it led elsewhere,
    None where the quick fit was so much worse that it was not followed to the end.
    """

    name: str
    cost: float
    rms: float
    agrees: bool | None


@dataclass(frozen=True, eq=False)
class Search:
    """The best fit, what became of every start, and parameters that equally good fits differ in."""

    best: Fit
    starts: tuple[StartOutcome, ...]
    not_unique: tuple[str, ...]


def free_parameters(model: Model) -> list[str]:
    """Return the core parameters and those of the model's effects (units of time excepted)."""
    effects = [p.name for c in model.effects for p in c.parameters if p.name not in FIXED]
    return [n for n in CORE if n in model.values] + effects


def noise_levels(experiments: Sequence[Experiment]) -> list[float]:
    """Return the white noise of every record's displacement [m], from its fast differences."""
    levels = []
    for e in experiments:
        y = measured(e.record)[e.used]
        levels.append(max(high_frequency_noise(y), 1e-6 * float(np.ptp(y)), 1e-15))
    return levels


def fit_base(
    model: Model, experiments: Sequence[Experiment], *, progress: Progress = lambda _: None
) -> Fit:
    """Return the best fit of `search`, without the account of its starts."""
    return search(model, experiments, progress=progress).best


def search(
    model: Model,
    experiments: Sequence[Experiment],
    *,
    linear: Sequence[LinearCandidate] = (),
    thorough: bool = False,
    progress: Progress = lambda _: None,
) -> Search:
    """Fit the core parameters from several starts, then whatever else the data can tell.

    The starts are the shapes of loop with the first of the `linear` candidates (lags and
    resonances), and the other candidates with the first shape. Each gets a quick fit; the best and
    the second best are followed to the end, if that one is close or, with `thorough`, not far, to
    tell whether starts agree. A keyboard interrupt ends the search at the best fit so far. Raises
    PsaError when no start can be simulated.
    """
    core = free_parameters(model)
    told = [n for n in FAST if linear and n in model.values]
    told = [n for n in told if n != "k_P" or n in linear[0].told]
    found = _quick_fits(model, experiments, [*core, *told], _starts(model, linear), progress)
    free = found[0][1].unknowns.names
    sigma = _residual_noise(found[0][1], experiments)
    polished: list[Fit | None] = [None] * len(found)
    for k, (name, quick) in enumerate(found):
        limit = (_NEAR if thorough else _CLOSE) * found[0][1].cost
        followed = k == 0 or quick.cost < limit
        if not followed or k > 1 or any(p is not None and p.interrupted for p in polished):
            break
        progress(f"base fit, {name} to the end")
        polished[k] = quick if quick.interrupted else refit(quick, experiments, free, sigma=sigma)
    ended = [p for p in polished if p is not None]
    best = min(ended, key=lambda f: f.cost)
    not_unique: set[str] = set()
    outcomes = []
    for (name, quick), final in zip(found, polished, strict=True):
        shown = final or quick
        agrees = None
        if final is not None:
            names = _differing(best, final, experiments)
            agrees = final is best or (names == () and _equal(best, final))
            not_unique |= set(names)
        outcomes.append(StartOutcome(name, shown.cost, shown.rms, agrees))
    if not best.interrupted:
        best = _with_fast(best, experiments, progress)
        best = _without_blur(best, experiments)
    if thorough and not best.interrupted:
        best, differing = _exchanged(best, experiments, progress)
        not_unique |= set(differing)
    names = best.unknowns.names
    return Search(best, tuple(outcomes), tuple(n for n in names if n in not_unique))


def refit(
    previous: Fit,
    experiments: Sequence[Experiment],
    free: Sequence[str],
    *,
    sigma: Sequence[float] | None = None,
) -> Fit:
    """Continue a fit from where it stands, with the noise level its residuals suggest."""
    return fit(
        previous.model,
        experiments,
        free,
        sigma=sigma or _residual_noise(previous, experiments),
        start_states=[previous.start(r) for r in range(len(experiments))],
        evaluations=_POLISH,
    )


def record_rms(previous: Fit, experiments: Sequence[Experiment]) -> list[float]:
    """Return the root mean square of every record's residual [m]."""
    parts = [
        previous.residuals[previous.of_record(experiments, r)] for r in range(len(experiments))
    ]
    return [max(float(np.sqrt(np.mean(p**2))), 1e-15) if len(p) else 1e-15 for p in parts]


def _starts(model: Model, linear: Sequence[LinearCandidate]) -> list[tuple[str, dict[str, float]]]:
    """Return the starts by name; static gain and loop keep their size where k_P moves."""
    shapes = [("loop shape {}", shape) for shape in loop_starts(model)]
    named = [(name.format(k + 1), dict(shape)) for k, (name, shape) in enumerate(shapes)]
    if linear:
        dynamics = _dynamics(model, linear)
        named = [(name, _moved(model, shape, dynamics[0])) for name, shape in named]
        named += [
            (f"dynamics {k}", _moved(model, shapes[0][1], other))
            for k, other in enumerate(dynamics[1:], 2)
        ]
    return named


def _dynamics(model: Model, linear: Sequence[LinearCandidate]) -> list[dict[str, float]]:
    """Return the dynamics to start from: the creep lag the slower one, then the drive's lag.

    A linear response cannot tell the two apart; amplifiers are usually the faster.
    """
    near = [c.values for c in linear if c.misfit < _WORSE * linear[0].misfit]
    slow_first, turned = [], []
    for values in near:
        drive = values["R_s"] * model.values["C_p"]
        there = {**values, "tau": drive, "R_s": values["tau"] / model.values["C_p"]}
        pair = (dict(values), there) if values["tau"] >= drive else (there, dict(values))
        slow_first.append(pair[0])
        turned.append(pair[1])
    return [*slow_first[:_DYNAMICS], turned[0]]


def _moved(
    model: Model, shape: Mapping[str, float], candidate: Mapping[str, float]
) -> dict[str, float]:
    """Return a loop with a candidate's dynamics, forces scaled to keep the displacement."""
    before = static_compliance(model.values)
    ratio = before / static_compliance({**model.values, **candidate})
    forces = {"k_L": model.values["k_L"], **shape}
    scaled = {n: v if n == "n" else v * ratio for n, v in forces.items()}
    return {**scaled, **candidate}


def _quick_fits(
    model: Model,
    experiments: Sequence[Experiment],
    free: Sequence[str],
    starts: Sequence[tuple[str, dict[str, float]]],
    progress: Progress,
) -> list[tuple[str, Fit]]:
    """Fit from every start with few evaluations; return those that could be simulated."""
    sigma = noise_levels(experiments)
    quickly: dict[str, Any] = {"sigma": sigma, "rtol": _QUICK_RTOL}
    found: list[tuple[str, Fit]] = []
    rounds = (_QUICK,) if len(starts) <= _FINALISTS else (_FIRST, _QUICK - _FIRST)
    for name, start in starts:
        progress(f"base fit from {name}")
        try:
            quick = fit(model, experiments, free, start=start, evaluations=rounds[0], **quickly)
        except PsaError:
            continue
        found.append((name, quick))
        if quick.interrupted:
            break
    found.sort(key=lambda pair: pair[1].cost)
    for k, (name, quick) in enumerate(found[:_FINALISTS] if len(rounds) > 1 else ()):
        if any(f.interrupted for _, f in found):
            break
        progress(f"base fit from {name}, continued")
        states = [quick.start(r) for r in range(len(experiments))]
        further = fit(
            quick.model, experiments, free, start_states=states, evaluations=rounds[1], **quickly
        )
        found[k] = (name, further)
    if not found:
        raise PsaError(
            "The base model could not be simulated from any start; the voltage's unit or the"
            " displacement's sign is the likely cause: check the record."
        )
    return sorted(found, key=lambda pair: pair[1].cost)


def _residual_noise(previous: Fit, experiments: Sequence[Experiment]) -> list[float]:
    parts = [
        previous.residuals[previous.of_record(experiments, r)] for r in range(len(experiments))
    ]
    return [max(high_frequency_noise(p), 1e-15) for p in parts]


def _equal(one: Fit, other: Fit) -> bool:
    """Whether two fits are equally likely, residuals beyond the noise scaled to it."""
    inflation = max(one.cost / max(len(one.residuals), 1), 1.0)
    return abs(one.cost - other.cost) < _EQUAL * inflation


def _differing(one: Fit, other: Fit, experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Return the parameters in which two equally likely fits differ beyond their intervals."""
    if one is other or not _equal(one, other):
        return ()
    count = len(one.unknowns.names)
    there = one.unknowns.coordinates(other.model.values)
    errors = np.sqrt(np.diag(covariance_of(one, experiments)))[:count]
    apart = np.abs(there - one.theta[:count]) > _APART * errors
    return tuple(n for n, far in zip(one.unknowns.names, apart, strict=True) if far)


def _with_fast(best: Fit, experiments: Sequence[Experiment], progress: Progress) -> Fit:
    """Free the fast parameters that these records can tell, if that lowers the cost clearly."""
    free = best.unknowns.names
    available = [n for n in FAST if n in best.model.values and n not in (*free, "k_P")]
    told = [n for n in available if _can_tell(best, experiments, n)]
    if not told:
        return best
    progress(f"base fit with {', '.join(told)}")
    states = [best.start(r) for r in range(len(experiments))]
    try:
        wider = fit(best.model, experiments, [*free, *told], sigma=best.sigma, start_states=states)
    except PsaError:
        return best
    needed = len(told) * np.log(len(best.residuals))
    return wider if wider.interrupted or wider.cost < best.cost - needed else best


def _without_blur(best: Fit, experiments: Sequence[Experiment]) -> Fit:
    """Fix k_P where it is if the records tell it badly: forces then keep their proportions."""
    names = best.unknowns.names
    if "k_P" not in names:
        return best
    k = names.index("k_P")
    if np.sqrt(covariance_of(best, experiments)[k, k]) < _SHARP:
        return best
    return refit(best, experiments, [n for n in names if n != "k_P"], sigma=best.sigma)


def _exchanged(
    best: Fit, experiments: Sequence[Experiment], progress: Progress
) -> tuple[Fit, tuple[str, ...]]:
    """Fit again with factors of the linear part exchanged; return the best, and what stays open.

    See `exchanges`. Parameters of an exchange that fits as well are not told by the records. After
    an exchange that fits better, the others are tried once more.
    """
    for _ in range(_EXCHANGES):
        differing: set[str] = set()
        before = best
        for what, values in exchanges(best.model.values):
            other = _from(best, values, experiments, progress, what)
            if other is None:
                continue
            differing |= set(_differing(best, other, experiments))
            if other.cost < best.cost and (other.interrupted or not _equal(best, other)):
                best = other
                break
        if best is before or best.interrupted:
            return best, tuple(differing)
    return best, ()


def _from(
    best: Fit,
    values: Mapping[str, float],
    experiments: Sequence[Experiment],
    progress: Progress,
    what: str,
) -> Fit | None:
    """Fit from exchanged values, quickly, and to the end if that comes near; None if it does not."""
    progress(f"exchanged: {what}")
    free = best.unknowns.names
    states = [best.start(r) for r in range(len(experiments))]
    low_high = {n: best.model.parameter(n).bounds for n in values}
    moved = {n: min(max(v, low_high[n][0]), low_high[n][1]) for n, v in values.items()}
    try:
        quick = fit(
            best.model.with_values(moved),
            experiments,
            free,
            sigma=best.sigma,
            start_states=states,
            evaluations=_FIRST,
            rtol=_QUICK_RTOL,
        )
        if quick.interrupted or quick.cost > _HOPEFUL * best.cost:
            return None
        return fit(
            quick.model,
            experiments,
            free,
            sigma=best.sigma,
            start_states=[quick.start(r) for r in range(len(experiments))],
            evaluations=_EXCHANGE,
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
    parts = predict(best.model, experiments, unknowns, theta, rtol=FIT_RTOL)
    jacobian = np.vstack(
        [p.jacobian[e.used[: e.stop]] for p, e in zip(parts, experiments, strict=True)]
    )
    scaled = jacobian / max(best.rms, min(best.sigma))
    information = scaled.T @ scaled + np.diag(1.0 / unknowns.prior**2)
    return bool(np.sqrt(np.linalg.pinv(information, hermitian=True)[count, count]) < 0.5)
