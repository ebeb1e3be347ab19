"""Starting points of a search: dynamics and loops that the records show, ordinary shapes.

Starting values of the linear part, from the records alone.

1. Excerpts in which a static loop misses something (`excerpts`): steps, broadband, fast loops.
2. Their poles by vector fitting, for one to five poles (`vector_fitting`).
3. Poles on drive, lag, wafers and bonding layers in the few ways that make sense; poles that no
   record shows lie below those that it shows.
4. Every such start refined by least squares with the exact response (`linear_fit`), the best ones
   to the end, and k_P/k_B as well where that explains more.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np

from psa_casadi.components import BASE
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.start.linear_fit import (
    COORDINATES,
    Excerpt,
    LinearFit,
    cost_of,
    excerpts,
    fit_linear,
)
from psa_casadi.identification.start.linear_response import (
    ComplexArray,
    Response,
    contributions,
    vector_fit,
)
from psa_casadi.identification.start.ordinary import has_loop, loop_starts
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray

#: Number of candidates at most, and of poles that vector fitting looks for.
CANDIDATES, ORDERS = 4, (1, 2, 3, 4, 5)
#: Excerpts whose poles are sought.
_SOURCES = 3
#: Rounds of the search: how many of the best starts go on, for how many evaluations; the last one.
_ROUNDS, _FULL = ((16, 3), (8, 6)), 20
#: Largest difference, in natural logarithms, of starts that are the same.
_ALIKE = 0.1
#: Dynamics show when the variance that they leave is less than this of what a static loop leaves,
#: and that is more than this of the noise.
_GAIN, _VISIBLE = 0.5, 0.1
#: Least residual, over the range, by which an excerpt is weighted.
_FLOOR = 5e-4
#: How much more a residual that is not white counts than a white one.
_MISSED = 10.0


@dataclass(frozen=True)
class LinearCandidate:
    """Starting values by parameter name, how far they miss, and what is told.

    `misfit` is the root mean square of what the fast records leave over, as a share of their
    range; `told` names the parameters that they determine within a factor of e^(1/2).
    """

    values: Mapping[str, float]
    misfit: float
    told: tuple[str, ...]


@dataclass(frozen=True)
class LinearStart:
    """Candidates, the best first; the records they come from; the misfit without any dynamics."""

    candidates: tuple[LinearCandidate, ...]
    records: tuple[str, ...]
    static_misfit: float


def linear_start(records: Sequence[Record], values: Mapping[str, float]) -> LinearStart | None:
    """Return starting values of tau, R_s, c_P, m_P, c_B, m_B, and of k_P where its share is told.

    `values` gives C_p [F], k_P and k_B [N/m], which voltage and displacement do not determine.
    None where the records show no dynamics: loops that a static loop explains.
    """
    parts = excerpts(records)
    if not parts:
        return None
    starts = _starts(parts, log(values["k_P"] / values["k_B"]))
    starts = sorted(starts, key=lambda theta: cost_of(parts, theta))
    best: Sequence[LinearFit] = ()
    for count, evaluations in _ROUNDS:
        fits = [
            fit_linear(parts, s, ratio_free=False, evaluations=evaluations) for s in starts[:count]
        ]
        best = different(sorted(fits, key=lambda f: f.cost))
        starts = [f.theta for f in best]
        parts = _reweighted(parts, best[0])
    best = best[:CANDIDATES]
    fits = [_refined(parts, f) for f in best]
    fits = different(sorted(fits, key=lambda f: f.cost))
    kept = [f for f in fits if _explains(parts, f)]
    if not kept:
        return None
    return LinearStart(
        candidates=tuple(_candidate(f, values, _share(parts, f.left)) for f in kept),
        records=tuple(e.name for e in parts),
        static_misfit=_share(parts, [e.static for e in parts]),
    )


def _reweighted(parts: Sequence[Excerpt], fit: LinearFit) -> list[Excerpt]:
    """Return the excerpts with the noise that a fit leaves.

    The rest of the residual, which the model misses and which is not white, counts many times.
    """
    found = []
    for e, left, white in zip(parts, fit.left, fit.white, strict=True):
        missed = _MISSED * np.sqrt(max(left**2 - white**2, 0.0))
        found.append(replace(e, sigma=float(max(np.hypot(white, missed), _FLOOR * e.range))))
    return found


def _explains(parts: Sequence[Excerpt], fit: LinearFit) -> bool:
    """Whether dynamics leave clearly less than a static loop does, white noise aside."""
    noise = _share(parts, fit.white) ** 2
    left = _share(parts, fit.left) ** 2 - noise
    static = _share(parts, [e.static for e in parts]) ** 2 - noise
    return left < _GAIN * static and static > _VISIBLE * noise


def _share(parts: Sequence[Excerpt], left: Sequence[float]) -> float:
    """Return the root mean square of what is left over the ranges."""
    return float(np.sqrt(np.mean([(r / e.range) ** 2 for e, r in zip(parts, left, strict=True)])))


def _refined(parts: Sequence[Excerpt], fit: LinearFit) -> LinearFit:
    """Return the fit continued, with k_P/k_B free where that lowers the cost clearly."""
    fixed = fit_linear(parts, fit.theta, ratio_free=False, evaluations=_FULL)
    free = fit_linear(parts, fixed.theta, ratio_free=True, evaluations=_FULL)
    samples = sum(int(e.valid.sum()) for e in parts)
    level = max(1.0, free.cost / samples)
    told = free.errors[-1] < 0.5 and fixed.cost - free.cost > level * log(samples)
    return free if told else fixed


def different(fits: Sequence[LinearFit]) -> list[LinearFit]:
    """Return the fits, best first, without those that repeat a better one within 10 %."""
    kept: list[LinearFit] = []
    for f in fits:
        if all(np.max(np.abs(f.theta - k.theta)) > _ALIKE for k in kept):
            kept.append(f)
    return kept


def _candidate(fit: LinearFit, values: Mapping[str, float], misfit: float) -> LinearCandidate:
    size = dict(zip(COORDINATES, np.exp(fit.theta).tolist(), strict=True))
    k_B = values["k_B"]
    k_P = values["k_P"] if np.isnan(fit.errors[-1]) else size["r"] * k_B
    found = {
        "tau": size["tau"],
        "R_s": size["T"] / values["C_p"],
        "c_P": size["a_P"] * k_P,
        "m_P": size["q_P"] * k_P,
        "c_B": size["a_B"] * k_B,
        "m_B": size["q_B"] * k_B,
        "k_P": k_P,
    }
    names = dict(zip(COORDINATES, ("R_s", "tau", "c_P", "m_P", "c_B", "m_B", "k_P"), strict=True))
    if np.isnan(fit.errors[-1]):
        del found["k_P"]
    bounds = {p.name: p.bounds for c in BASE for p in c.parameters}
    return LinearCandidate(
        values={n: float(np.clip(v, *bounds[n])) for n, v in found.items()},
        misfit=misfit,
        told=tuple(names[c] for c, e in zip(COORDINATES, fit.errors, strict=True) if e < 0.5),
    )


def _starts(parts: Sequence[Excerpt], ratio: float) -> list[FloatArray]:
    """Return theta (7,) for every way to place the poles of every order, of every excerpt."""
    found: list[FloatArray] = []
    for e in parts[:_SOURCES]:
        for source in (_scaled(e), e.loop):
            response = [Response(e.h, source, e.y, e.valid, e.sigma)]
            for order in ORDERS:
                poles = vector_fit(response, order)
                share = contributions(response, poles)
                for least in {min(1.0, share.max()), share.max()}:
                    for placed in arrangements(poles[share >= 0.2 * least], e.h):
                        theta = np.append(placed, ratio)
                        if all(np.max(np.abs(theta - f)) > _ALIKE for f in found):
                            found.append(theta)
    return found


def _scaled(e: Excerpt) -> FloatArray:
    """Return the voltage in metres: times the slope of displacement on voltage."""
    v = e.v[e.valid] - np.mean(e.v[e.valid])
    return e.v * float(v @ (e.y[e.valid] - np.mean(e.y[e.valid])) / (v @ v))


def arrangements(poles: ComplexArray, interval: float) -> list[FloatArray]:
    """Return ln (T, tau, a_P, q_P, a_B, q_B) for the ways to place poles [rad/s]; see module.

    Oscillations belong to wafers and bonding layers, the slowest real pole to the creep lag or
    the drive, others to the drive or an overdamped pair. What is left open lies at 0.3 of the
    shortest time found, not below a quarter of the sampling interval.
    """
    times = sorted((1.0 / abs(p) for p in poles if not p.imag), reverse=True)
    tones = sorted((p for p in poles if p.imag > 0), key=abs)
    fast = max(0.3 * min([1.0 / abs(p) for p in poles]), 0.25 * interval)
    pairs = [(-2.0 * p.real / abs(p) ** 2, 1.0 / abs(p) ** 2) for p in tones[:2]]
    found = []
    for lags in (2, 1) if len(times) > 1 else (2,):
        own = [*times, fast, fast][:lags] + [0.5 * fast] * (2 - lags)
        left = times[lags:]
        both = list(pairs)
        while len(both) < 2:
            one, two = [*left, fast, 0.7 * fast][:2]
            left = left[2:]
            both.append((one + two, one * two))
        for tau, drive in {(own[0], own[1]), (own[1], own[0])}:
            for b, p in {(both[0], both[1]), (both[1], both[0])}:
                found.append(np.log([drive, tau, *p, *b]))
    return found


#: Candidate dynamics that miss the fast records this much more than the best are not tried.
_WORSE, _DYNAMICS = 1.2, 3
#: An oscillator shows where sqrt(m/k) is at least this share of the sampling interval.
_RESOLVED = 0.3
_MASSES = ("m_P", "m_B")


def starting_points(
    model: Model, linear: Sequence[LinearCandidate], records: Sequence[Record]
) -> list[tuple[str, dict[str, float]]]:
    """Return the starts by name: shapes that loops usually have, then dynamics that records show.

    The model's own loop where its hysteresis is none of Bouc-Wen's. Static gain and loop keep their
    size where k_P moves.
    """
    shapes = [("the model's own loop", {})] if not has_loop(model) else loop_starts(model)
    if not linear:
        return shapes
    bounds = {p.name: p.bounds for p in model.structure.parameters}
    dynamics = [
        {n: float(np.clip(v, *bounds[n])) for n, v in values.items()}
        for values in _dynamics(model, linear, min(r.sample_time for r in records))
    ]
    named = [(name, _moved(model, shape, dynamics[0])) for name, shape in shapes]
    return named + [
        (f"dynamics {k}", _moved(model, shapes[0][1], other))
        for k, other in enumerate(dynamics[1:], 2)
    ]


def resolved(
    model: Model, linear: Sequence[LinearCandidate], sample_time: float
) -> tuple[str, ...]:
    """Return the masses, and k_P, that are searched because the best candidate shows them.

    Two masses that the sampling resolves are searched even where they are told badly: lags told
    beside masses that are only assumed would look surer than they are.
    """
    if not linear:
        return ()
    values = {**model.values, **linear[0].values}
    times = {m: (values[m] / values[m.replace("m", "k")]) ** 0.5 for m in _MASSES}
    masses = tuple(m for m, t in times.items() if t >= _RESOLVED * sample_time)
    return (*masses, *(n for n in ("k_P",) if masses and n in linear[0].told))


def _dynamics(
    model: Model, linear: Sequence[LinearCandidate], sample_time: float
) -> list[dict[str, float]]:
    """Return the dynamics to start from: the creep lag the slower one, then the drive's lag.

    A linear response cannot tell the two apart; amplifiers are usually the faster. Where the
    sampling resolves no mass, masses stay as they are and the slowest lag is the creep lag.
    """
    near = [dict(c.values) for c in linear if c.misfit < _WORSE * linear[0].misfit]
    if not set(_MASSES) & set(resolved(model, linear, sample_time)):
        near = [_creep_slowest(model, values) for values in near]
    slow_first, turned = [], []
    for values in near:
        drive = values["R_s"] * model.values["C_p"]
        there = {**values, "tau": drive, "R_s": values["tau"] / model.values["C_p"]}
        pair = (values, there) if values["tau"] >= drive else (there, values)
        slow_first.append(pair[0])
        turned.append(pair[1])
    return [*slow_first[:_DYNAMICS], turned[0]]


def _creep_slowest(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Return dynamics of lags alone: ordinary masses, the creep lag exchanged with a slower c/k."""
    ordinary = {k: v for k, v in values.items() if k not in (*_MASSES, "k_P")}
    stiffness = {c: model.values[c.replace("c", "k")] for c in ("c_P", "c_B")}
    shown = {c: values[c] / {**model.values, **values}[c.replace("c", "k")] for c in stiffness}
    ordinary |= {c: lag * stiffness[c] for c, lag in shown.items()}
    slow = max(shown, key=lambda c: shown[c])
    if shown[slow] > values["tau"]:
        ordinary |= {"tau": shown[slow], slow: values["tau"] * stiffness[slow]}
    return ordinary


def _moved(
    model: Model, shape: Mapping[str, float], candidate: Mapping[str, float]
) -> dict[str, float]:
    """Return a loop with a candidate's dynamics, forces scaled to keep the displacement."""
    before = static_compliance(model.values)
    ratio = before / static_compliance({**model.values, **candidate})
    forces = {"k_L": model.values["k_L"], **shape}
    scaled = {n: v if n == "n" else v * ratio for n, v in forces.items()}
    return {**scaled, **candidate}
