"""Identify any model from its records: several starts, and the noise that every output leaves."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError, PsaError, quoted
from psa_casadi.common.progress import Progress, silent
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import refit, relevelled, reweighted, unlike, with_noise
from psa_casadi.identification.result import StartOutcome
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import Parameter
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.stepper import SimulationError

#: Evaluations of a start's first fit, and how many of the best go on to the end.
_QUICK, _FOLLOWED = 15, 2
#: Starts whose costs differ by less than this share have the same minimum.
_SAME = 0.01
#: Starts lie within this many natural logarithms, or ordinary changes, of the declared value.
_DECADES, _CHANGES = 2.3, 2.0
_SEED = 29
#: Fewest samples for a rate.
_SLOPE = 8


def free_of(model: Model, free: Sequence[str] | None) -> tuple[str, ...]:
    """Return the parameters to fit. Raises InputError for a name that is none."""
    if free is None:
        return tuple(p.name for p in model.structure.parameters if p.fitted)
    for name in free:
        model.parameter(name)
    return tuple(free)


def known_zeros(model: Model, zeros: Sequence[str]) -> tuple[str, ...]:
    """Return the outputs with an unknown zero. Raises InputError for a name that is none."""
    for name in zeros:
        if name not in model.output_names:
            raise InputError(
                f"`zeros` has '{name}', which is no output of '{model.name}'; there are"
                f" {quoted(model.output_names)}."
            )
    return tuple(zeros)


_Start = TypeVar("_Start")


def fits_from(
    starts: Iterable[tuple[str, _Start]], quick: Callable[[str, _Start], Fit]
) -> list[tuple[str, Fit]]:
    """Return the quick fits from named starts that can be simulated.

    A keyboard interrupt ends it with those that there are, if any. Raises what the first one raised
    where none can be simulated.
    """
    result, first = list[tuple[str, Fit]](), None
    for name, start in starts:
        try:
            one = quick(name, start)
        except PsaError as error:
            first = first or error
            continue
        except KeyboardInterrupt:
            if not result:
                raise
            return [(n, replace(f, interrupted=True, converged=False)) for n, f in result]
        result.append((name, one))
        if one.interrupted:
            break
    if first is not None and not result:
        raise first
    return result


def search_starts(
    model: Model,
    experiments: Sequence[Experiment],
    free: Sequence[str],
    *,
    starts: int,
    progress: Progress = silent,
) -> tuple[Fit, tuple[StartOutcome, ...]]:
    """Return the best fit from several starts, with the experiments' noise, and the starts.

    The costs are those with the same noise in all experiments. Raises SimulationError where none
    can be simulated.
    """
    sigma = [experiments[0].channels[0].level] * len(experiments)
    states = observed_starts(model, experiments)
    rng, declared = np.random.default_rng(_SEED), model.values
    points: list[tuple[str, dict[str, float]]] = [("declared values", {})]
    for k in range(1, starts):
        drawn = {n: _drawn(model.parameter(n), declared, rng) for n in free}
        points.append((f"random values {k}", drawn))

    def quick(name: str, values: Mapping[str, float]) -> Fit:
        progress(f"fit from {name}")
        return fit(
            model.with_values(values), experiments, free, sigma=sigma, start_states=states,
            evaluations=_QUICK if starts > 1 else 3 * _QUICK,
            tolerance=1e-4 if starts > 1 else 1e-6,
        )  # fmt: skip

    try:
        ranked = sorted(fits_from(points, quick), key=lambda pair: pair[1].cost)
    except PsaError as error:
        raise SimulationError(
            f"The model '{model.name}' cannot be simulated on these records from any start; check"
            f" the units of its inputs, its values and their bounds. At its current values: {error}"
        ) from error
    cut = any(f.interrupted for _, f in ranked)
    ended = [
        refit(f, sigma=f.sigma, tolerance=1e-6)
        for _, f in ranked[: 0 if cut or starts == 1 else _FOLLOWED]
    ]
    fits = dict(ranked) | {name: f for (name, _), f in zip(ranked, ended, strict=False)}
    best = min(fits.values(), key=lambda f: f.cost)
    outcomes = tuple(_outcome(name, fits.get(name), best) for name, _ in points)
    if cut:
        return replace(best, interrupted=True, converged=False), outcomes
    return levelled(best), outcomes


def levelled(best: Fit) -> Fit:
    """Fit again with the noise that every output leaves; and that of each experiment."""
    best = relevelled(best, every=True)
    again = with_noise(best)
    return reweighted(best, again) if unlike(again, best.experiments) else best


def _outcome(name: str, end: Fit | None, best: Fit) -> StartOutcome:
    if end is None:
        return StartOutcome(name, float("nan"), float("nan"), None)
    same = end.cost <= (1.0 + _SAME) * best.cost
    return StartOutcome(name, end.cost, end.rms, True if same else None)


def observed_starts(model: Model, experiments: Sequence[Experiment]) -> list[dict[str, float]]:
    """Return deviations of initial states that an output shows at its first samples.

    A state that an output is, and one that is the rate of such a state.
    """
    y, x, der = model.structure.y, model.structure.x, model.structure.der
    names = [x[k].name() for k in range(x.numel())]
    starts = {q.name: q.start for q in model.structure.states}
    pairs = [
        (output, y[j].name())
        for j, output in enumerate(model.output_names)
        if y[j].is_symbolic() and y[j].name() in names
    ]
    result = []
    for e in experiments:
        deviations, known = {}, e.known if e.held_out_whole else e.used
        for output, state in pairs:
            readings = e.record.column(output)
            if readings is None or e.known_start:
                continue
            valid = np.flatnonzero(known & np.isfinite(readings))
            if valid.size:
                deviations[state] = float(readings[valid[0]]) - starts[state]
            rate, first = ca.SX(der[state]), valid[: max(_SLOPE, valid.size // 16)]
            if rate.is_symbolic() and rate.name() in starts and first.size >= _SLOPE:
                slope = np.polyfit(e.record.time[first], readings[first], 1)[0]
                deviations[rate.name()] = float(slope) - starts[rate.name()]
        result.append(deviations)
    return result


def _drawn(p: Parameter, values: Mapping[str, float], rng: np.random.Generator) -> float:
    low, high = p.bounds
    value = values[p.name]
    if p.log and value > 0:
        drawn = value * float(np.exp(rng.uniform(-_DECADES, _DECADES)))
    elif np.isfinite(high - low):
        drawn = float(rng.uniform(low, high))
    else:
        drawn = value + p.typical(values) * float(rng.uniform(-_CHANGES, _CHANGES)) * 0.5
    return float(np.clip(drawn, low, high))


def refuse_unfit(model: Model) -> None:
    """Refuse a model without an output, and one with sampled states. Raises InputError."""
    if not model.output_names:
        raise InputError(f"The model '{model.name}' has no output; a fit compares with one.")
    if model.structure.sampled:
        raise InputError(
            f"The model '{model.name}' has sampled states, whose sensitivities are not computed;"
            " leave the sampled component out."
        )
