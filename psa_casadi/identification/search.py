"""A measured load as an input without its noise: the load as a curve over the displacement.

The noise of an input moves the model, so that a fit prefers whatever explains the displacement
without that input. A load that is a function of the displacement is known better by its curve over
the displacement that a model without it predicts from the voltage: an instrument whose error has
nothing to do with the load cell's (instrumental variables; Fuller, Measurement Error Models 1987).
A straight line is what a stiffer stack does: it does not determine the stiffness that it meets.
Where the displacement's sensor bends, that model is bent with it, and the load may be a straighter
curve over what the same model predicts that is fitted to the load itself.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.notes import Note, note
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.mechanics import exchanged, retuned, with_fast, without_blur
from psa_casadi.identification.multistart import fits_from
from psa_casadi.identification.refitting import (
    differing,
    equal,
    noise_levels,
    quick_rtol,
    record_rms,
    refit,
    refit_or_keep,
    residual_noise,
    same_place,
)
from psa_casadi.identification.result import StartOutcome
from psa_casadi.identification.start.ordinary import FORMS
from psa_casadi.identification.start.starting_points import (
    LinearCandidate,
    resolved,
    starting_points,
)
from psa_casadi.model.components.stack import memory_spectrum
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, fitted
from psa_casadi.simulation.timings import stage

#: Parameters that voltage and displacement determine in every record with loops.
CORE = (
    *("k_L", "A", "beta", "gamma", "delta", "n", *memory_spectrum.fitted),
    *("tau", "R_s", "c_P", "c_B", "c"),
)

#: Where there are more starts than finalists, all get the first evaluations, those the rest.
_QUICK, _FINALISTS, _FIRST = 12, 3, 5
#: The second best is followed to the end where its cost is at most this much larger.
_NEAR = 1.5
#: A fit lacks something if its mean weighted square exceeds this; this many starts are then
#: followed to the end.
_MISSED, _FOLLOWED = 2.0, 4
#: A start whose quick fit comes this close to the best one's cost is followed to the end.
_CLOSE = 1.02


@dataclass(frozen=True, eq=False)
class Search:
    """The best fit, the outcome of every start, and parameters in which equal fits differ."""

    best: Fit
    starts: tuple[StartOutcome, ...]
    not_unique: tuple[str, ...]


def free_parameters(model: Model, records: Sequence[Record] = ()) -> list[str]:
    """Return the core parameters and those of the model's effects that records determine.

    A measured load that changes determines the stiffness that it meets.
    """
    effects = [n for c in model.effects for n in c.fitted]
    loaded = "load_force" in model.input_names and any(
        r.load_force is not None and np.ptp(r.load_force) > 0.0 for r in records
    )
    met = [n for n in ("k_B", "k") if loaded and n in model.values]
    return [n for n in CORE if n in model.values] + met + effects


@stage("base fit")
def fit_base(
    model: Model, experiments: Sequence[Experiment], *, progress: Progress = silent
) -> Fit:
    """Return the best fit of `search`, without the account of its starts."""
    return search(model, experiments, progress=progress).best


def search(
    model: Model,
    experiments: Sequence[Experiment],
    *,
    linear: Sequence[LinearCandidate] = (),
    thorough: bool = False,
    progress: Progress = silent,
) -> Search:
    """Fit the core parameters from several starts, then whatever else the data determine.

    The starts are the records' loops and ordinary shapes with the first of the `linear` candidates
    (lags and resonances), and the other candidates with the first loop. Each gets a quick fit; the
    best and the second best are followed to the end, if that one is close or, with `thorough`, not
    far, to see whether starts agree; with `thorough` more of them while all leave more than the
    noise. A keyboard interrupt ends the search at the best fit so far, if there is one. Raises
    PsaError when no start can be simulated.
    """
    off = (c for c in model.effects if c.linear and model.values[c.gain or ""] == 0.0)
    model = model.with_values({n: v for c in off for n, v in c.at_gain(0.0, {}).items()})
    so_far: list[Fit] = []
    records = [e.record for e in fitted(experiments)]
    mechanics = resolved(model, linear, min(r.sample_time for r in records))
    free = [*free_parameters(model, records), *mechanics]
    starts = starting_points(model, linear, records)
    try:
        ranked = _quick_fits(model, experiments, free, starts, progress, so_far)
        return _ended(ranked, progress, so_far, thorough=thorough, retune=bool(mechanics))
    except KeyboardInterrupt:
        if not so_far:
            raise
        return Search(replace(so_far[-1], interrupted=True, converged=False), (), ())


def _ended(
    ranked: Sequence[tuple[str, Fit]], progress: Progress, so_far: list[Fit],
    *, thorough: bool, retune: bool,
) -> Search:  # fmt: skip
    """Follow the best quick fits to their end; `so_far` gets every fit that is the best then."""
    first = ranked[0][1]
    so_far.append(first)
    sigma = residual_noise(first)
    polished: dict[str, Fit] = {}
    for name, quick in ranked:
        near = quick.data_cost < (_NEAR if thorough else _CLOSE) * first.data_cost
        lost = all(f.data_cost > _MISSED * len(f.residuals) for f in polished.values())
        misfit = thorough and len(polished) < _FOLLOWED and lost
        stopped = any(f.interrupted for f in polished.values())
        if polished and (stopped or not (misfit or (near and len(polished) < 2))):
            break
        if polished and not thorough and same_place(first, quick):
            continue
        progress(f"base fit, {name} to the end")
        ended = quick if quick.interrupted else refit_or_keep(quick, sigma=sigma)
        polished[name] = ended
        so_far.append(min(polished.values(), key=lambda f: f.data_cost))
    top = best = min(polished.values(), key=lambda f: f.data_cost)
    if not best.interrupted:
        best = with_fast(best, progress)
        tuned = retuned(best, progress) if retune else best
        if tuned is not best:
            top = best = tuned
        so_far.append(best)
        best = without_blur(best)
        so_far.append(best)
    outcomes, not_unique = _outcomes(ranked, polished, top)
    if thorough and not best.interrupted:
        best, open_ones = exchanged(best, progress)
        not_unique |= set(open_ones)
    names = best.unknowns.names
    return Search(best, outcomes, tuple(n for n in names if n in not_unique))


def _outcomes(
    ranked: Sequence[tuple[str, Fit]], polished: Mapping[str, Fit], best: Fit
) -> tuple[tuple[StartOutcome, ...], set[str]]:
    """Return the outcome of every start, and the parameters in which equally good fits differ."""
    outcomes, not_unique = [], set[str]()
    for name, quick in ranked:
        final = polished.get(name)
        if final is None:
            outcomes.append(StartOutcome(name, quick.data_cost, quick.rms, None))
            continue
        names = differing(best, final)
        agrees = final is best or (names == () and equal(best, final))
        not_unique |= set(names)
        outcomes.append(StartOutcome(name, final.data_cost, final.rms, agrees))
    return tuple(outcomes), not_unique


def _quick_fits(
    model: Model, experiments: Sequence[Experiment], free: Sequence[str],
    starts: Sequence[tuple[str, dict[str, float]]], progress: Progress, so_far: list[Fit],
) -> list[tuple[str, Fit]]:  # fmt: skip
    """Fit from every start with few evaluations; return those that could be simulated."""
    sigma = noise_levels(experiments)
    quickly: dict[str, Any] = {"sigma": sigma, "rtol": quick_rtol(sigma, experiments)}
    rounds: tuple[int, ...] = (_QUICK,) if len(starts) <= _FINALISTS else (_FIRST, _QUICK - _FIRST)

    def quick_fit(name: str, start: Mapping[str, float]) -> Fit:
        progress(f"base fit from {name}")
        return fit(model, experiments, free, start=start, evaluations=rounds[0], **quickly)

    fits = sorted(fits_from(starts, quick_fit), key=lambda pair: pair[1].data_cost)
    so_far.append(fits[0][1])
    widest = max(e.record.range_m for e in fitted(experiments))
    # a loop that diverges is left there, unless all do
    fits = [pair for pair in fits if pair[1].rms < widest] or fits
    for k, (name, quick) in enumerate(fits[: _FINALISTS if len(rounds) > 1 else 0]):
        if any(f.interrupted for _, f in fits):
            break
        progress(f"base fit from {name}, continued")
        with suppress(PsaError):  # where it leads to what cannot be simulated, the first one stays
            fits[k] = (name, refit(quick, evaluations=rounds[1], **quickly))
    return sorted(fits, key=lambda pair: pair[1].data_cost)


_LABELS = {FORMS["bouc-wen"].name: "Bouc-Wen", FORMS["spectrum"].name: "a spectrum of elements"}


def search_forms(
    models: Sequence[Model],
    experiments: Sequence[Experiment],
    *,
    linear: Sequence[LinearCandidate] = (),
    thorough: bool = False,
    progress: Progress = silent,
) -> tuple[Search, Note | None]:
    """Search from each model, and return the search that the records prefer, and why.

    That of the smaller Schwarz criterion, sum_r n_r ln S_r + k ln n: S_r the mean square of record
    r's residual, k the parameters, n the samples (Schwarz, Annals of Statistics 6 (1978) 461). None
    for one model. Raises PsaError where no model can be fitted.
    """
    searches: list[Search] = []
    failed: list[PsaError] = []
    for model in models:
        try:
            one = search(model, experiments, linear=linear, thorough=thorough, progress=progress)
        except PsaError as error:
            failed.append(error)
            continue
        searches.append(one)
        if one.best.interrupted:
            break
    if not searches:
        raise failed[0]
    samples = [int(e.used.sum()) for e in experiments]

    def criterion(s: Search) -> float:
        levels = record_rms(s.best)
        likely = sum(n * np.log(level**2) for n, level in zip(samples, levels, strict=True))
        return float(likely + len(s.best.unknowns.names) * np.log(sum(samples)))

    ranked = sorted(searches, key=criterion)
    if len(ranked) < 2:
        return ranked[0], None
    forms = [
        next(_LABELS[c.name] for c in s.best.model.components if c.name in _LABELS) for s in ranked
    ]
    left, other_left = (1e9 * s.best.rms for s in ranked)
    why = note("form", better=forms[0], left=left, other=forms[1], other_left=other_left)
    return ranked[0], why


#: The column, and the highest order of the curve.
LOAD, _ORDER = "load_force", 8
#: The curve replaces the load if the rms difference is no more than the noise, with this margin,
#: and this share of the range.
_NOISE, _SHARE = 1.1, 1e-3


def is_measured(experiments: Sequence[Experiment]) -> bool:
    """Whether the load on the stack is measured in every record."""
    return all(e.record.load_force is not None for e in experiments)


def without_column(experiments: Sequence[Experiment], column: str) -> tuple[Experiment, ...]:
    """Return the experiments as if a column had not been measured."""
    result, gone = [], dict[str, Any]({column: None})
    for e in experiments:
        channels = tuple(c for c in e.channels if c.column != column)
        result.append(replace(e, record=replace(e.record, **gone), channels=channels))
    return tuple(result)


def loads_as_curves(
    start: Model, experiments: Sequence[Experiment], progress: Callable[[str], None]
) -> tuple[Experiment, ...]:
    """Return the experiments with loads that are curves over the displacement as these curves.

    Of a fit without the load, from `start`. Where all of them are straight lines they are 0: the
    model's stiffness replaces them. Other loads stay as they were measured. Without a load that
    changes nothing is fitted.
    """
    loads = [np.asarray(e.record.load_force, dtype=float) for e in experiments]
    if not is_measured(experiments) or all(np.ptp(load) == 0.0 for load in loads):
        return tuple(experiments)
    progress("base fit without the measured load")
    unloaded = without_column(experiments, LOAD)
    as_displacement = []  # the load, to the size and sign of the displacement
    for e, load in zip(experiments, loads, strict=True):
        y = np.asarray(e.record.displacement)
        valid, span = np.isfinite(y), max(float(np.ptp(load)), 1e-300)
        sign = np.sign(np.cov(load[valid], y[valid])[0, 1]) or 1.0
        scaled = np.where(valid, load * sign * e.record.range_m / span, np.nan)
        record = replace(e.record, displacement=scaled, load_force=None)
        as_displacement.append(replace(e, record=record).with_further(()))
    predictions = [
        fit_base(start, others, progress=progress).predicted()
        for others in (unloaded, tuple(as_displacement))
    ]
    curves = [_curve(load, x) for load, *x in zip(loads, *predictions, strict=True)]
    straight = all(c is not None and c[1] == 1 for c in curves)
    result = []
    for e, load, c in zip(experiments, loads, curves, strict=True):
        curve = np.zeros(e.record.n) if straight else load if c is None else c[0]
        result.append(replace(e, record=replace(e.record, load_force=curve)))
    return tuple(result)


def _curve(load: FloatArray, ways: Sequence[FloatArray]) -> tuple[FloatArray, int] | None:
    """Return the polynomial that replaces a load (n,) [N], and its order; None if all are far.

    Over one of the displacements x (n,) [m]; of the smallest n ln S + order ln n (Schwarz 1978).
    """
    fits = []
    for x in ways:
        middle, half = 0.5 * (float(x.max()) + float(x.min())), 0.5 * float(np.ptp(x))
        powers = np.polynomial.chebyshev.chebvander((x - middle) / max(half, 1e-300), _ORDER)
        for order in range(1, _ORDER + 1):
            columns = powers[:, : order + 1]
            curve = columns @ np.linalg.lstsq(columns, load, rcond=None)[0]
            left = max(float(np.sum((load - curve) ** 2)), 1e-300)
            fits.append((load.size * np.log(left) + order * np.log(load.size), order, curve))
    _, order, curve = min(fits, key=lambda f: f[0])
    misfit = float(np.std(load - curve))
    allowed = np.hypot(_NOISE * high_frequency_noise(load), _SHARE * float(np.ptp(load)))
    return (curve, order) if misfit <= allowed else None
