"""Identify any model from its records: several starts, and the noise that every output leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.runs import given_to, noise_share, runs_of, told_of_columns
from psa_casadi.any_model.sizes import sized
from psa_casadi.diagnosis.colour import Colour, noise_rms, uncertain
from psa_casadi.errors import InputError, PsaError
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import relevelled_all, weighted
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note, texts
from psa_casadi.records.noise import filtered, first_order_noise
from psa_casadi.records.signals import Hold
from psa_casadi.records.split import Experiment
from psa_casadi.shown import Reported, frame
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.variables import Interval, Parameter, Provenance
from psa_casadi.version import __version__

FloatArray = npt.NDArray[np.float64]

#: Noise is estimated from so many samples or more, and differs from so many standard errors on.
_TELLING, _SURE = 32, 3.0


def refitted(
    before: Fit,
    experiments: Sequence[Experiment],
    *,
    model: Model | None = None,
    evaluations: int = 60,
    tolerance: float = 1e-6,
) -> Fit:
    """Go on with a fit from where it stopped, or with another model from its values.

    What another model has of the parameters is free, and its effects' fitted parameters too.
    """
    other = model or before.model
    own = [n for n in before.unknowns.names if n in other.values]
    own += [n for c in other.effects for n in c.fitted if n not in own]
    return fit(
        other, weighted(before, experiments), own, sigma=before.sigma,
        start_states=before.starts(), evaluations=evaluations, tolerance=tolerance,
    )  # fmt: skip


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


def reweighted(fit: Fit, experiments: Sequence[Experiment]) -> Fit:
    """Fit again with other shares of the noise."""
    return relevelled_all(refitted(fit, experiments, evaluations=100), experiments)


def noise_left(fit: Fit, colour: Colour) -> list[float]:
    """Return the noise in every output's residual, over the shares that weighted it."""
    rows = zip(fit.channels, colour.each, strict=True)
    return [noise_rms(o.residuals, own) for o, own in rows]


def noise_told(
    fit: Fit, colour: Colour, experiments: Sequence[Experiment]
) -> tuple[tuple[Experiment, ...], tuple[float, ...]]:
    """Return the experiments and every output's noise over them, in its unit, as a fit leaves it.

    What a search has weighted by is from the base's residual, which holds more than noise.
    """
    told, levels = with_noise(fit, experiments), []
    for o, own in zip(fit.channels, colour.each, strict=True):
        j = o.number
        rows = zip(o.records, o.parts, strict=True)
        left = np.concatenate([p * (experiments[k].share(j) / told[k].share(j)) for k, p in rows])
        levels.append(noise_rms(left, own) * noise_share(told, j))
    return told, tuple(levels)


#: Evaluations of a start's first fit, and how many of the best go on to the end.
_QUICK, _FOLLOWED = 15, 2
#: Starts whose costs differ by less than this share have found the same minimum.
_SAME = 0.01
#: Starts lie within so many natural logarithms, or ordinary changes, of the declared value.
_DECADES, _CHANGES = 2.3, 2.0
_SEED = 29
#: A residual above so many times its own fast noise shows that the model misses something.
MISSED = 1.5
#: A fit that leaves this share of an output's standard deviation explains nothing of it.
_ALL = 0.8


@dataclass(frozen=True, eq=False, repr=False)
class OdeIdentification(Reported):
    """A model with fitted values, how sure they are, and remarks, which `warnings` tells.

    `errors` are the parameters' standard errors, `intervals` their 95 % intervals in
    `model.provenance`; `rms` is what is left of every measured output and `noise` the fast part of
    that over all records, in the outputs' units. `costs` are those of the starts, nan for one that
    failed; `agreed` of them led to the same minimum.
    """

    model: Model
    fit: Fit
    experiments: tuple[Experiment, ...]
    errors: Mapping[str, float]
    undetermined: tuple[str, ...]
    rms: Mapping[str, float]
    noise: Mapping[str, float]
    costs: tuple[float, ...]
    agreed: int
    remarks: tuple[Note, ...]

    def __repr__(self) -> str:
        """Return the parameters with their standard errors, and what is left of the outputs."""
        return str(note("own_identification", found=self))

    @property
    def warnings(self) -> tuple[str, ...]:
        """The remarks in sentences."""
        return texts(self.remarks)

    def to_frame(self) -> Any:
        """Return the parameters as a pandas DataFrame: value, standard error, interval, unit."""
        told = self.model.provenance.intervals
        names = list(self.errors)
        return frame(
            {
                "parameter": names,
                "value": [self.model.values[n] for n in names],
                "error": [self.errors[n] for n in names],
                "low": [told[n].low for n in names],
                "high": [told[n].high for n in names],
                "unit": [self.model.parameter(n).unit for n in names],
                "meaning": [self.model.parameter(n).description for n in names],
            }
        )


def identify_ode(
    model: Model,
    records: Any,
    *,
    free: Sequence[str] | None = None,
    starts: int = 8,
    zeros: Sequence[str] = (),
    known_start: bool = False,
    hold: Hold | None = None,
) -> OdeIdentification:
    """Fit the parameters of a model to all samples of all its records.

    `records` are `Signals`, tables with a column `time`, or CSV files, whose columns bear the names
    of the model's inputs and outputs. Between samples inputs are straight lines, or constant with
    `hold="zero"`. Maximum likelihood over all outputs, each with the noise level that it leaves,
    and where the noise of records differs, each with its own; the parameters stay within their
    bounds. `free` names the parameters to fit, all that are `fitted` by default. The initial state
    of every record is estimated too, unless it is known to be the declared one (`known_start`).
    `zeros` names outputs whose zero is unknown in each record. The search begins at the declared
    values and at `starts` - 1 random ones within the bounds, and follows the best two to their end.

    Raises InputError for records or names that do not fit, SimulationError where the model cannot
    be simulated at its values.
    """
    refuse_unfit(model)
    runs = runs_of(
        model, given_to(model, records, hold), judged=False, zeros=known_zeros(model, zeros),
        known_start=known_start,
    )  # fmt: skip
    fit, runs, costs = search_starts(sized(model, runs), runs, free_of(model, free), starts=starts)
    return _told(fit, runs, costs)


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
                f" {model.output_names}."
            )
    return tuple(zeros)


def search_starts(
    model: Model, experiments: Sequence[Experiment], free: Sequence[str], *, starts: int
) -> tuple[Fit, tuple[Experiment, ...], tuple[float, ...]]:
    """Return the best fit from several starts, the experiments with their noise, and all costs.

    The costs are those of the starts with the same noise in all experiments. Raises SimulationError
    where none can be simulated.
    """
    sigma = [experiments[0].channels[0].level] * len(experiments)
    seen = None if experiments[0].known_start else seen_starts(model, experiments)
    found: list[Fit] = []
    costs: list[float] = []
    rng = np.random.default_rng(_SEED)
    for number in range(max(1, starts)):
        declared = model.values  # the first start; random ones about them, within the bounds
        values = {n: _drawn(model.parameter(n), declared, rng) for n in free} if number else {}
        try:
            own = fit(
                model.with_values(values), experiments, free, sigma=sigma, start_states=seen,
                evaluations=_QUICK if starts > 1 else 3 * _QUICK, tolerance=1e-4,
            )  # fmt: skip
        except PsaError:
            costs.append(float("nan"))
            continue
        costs.append(own.cost)
        found.append(own)
        if own.interrupted:
            break
    if not found:
        raise SimulationError(
            f"The model '{model.name}' cannot be simulated on these records from any start; check"
            " the units of its inputs, its values and their bounds."
        )
    found.sort(key=lambda f: f.cost)
    if found[-1].interrupted or found[0].interrupted:
        return replace(found[0], interrupted=True, converged=False), (*experiments,), tuple(costs)
    ended = [refitted(f, experiments, evaluations=100) for f in found[:_FOLLOWED]]
    for quick, end in zip(found, ended, strict=False):
        costs[costs.index(quick.cost)] = end.cost
    best = relevelled_all(min(ended, key=lambda f: f.cost), experiments)
    again = with_noise(best, experiments)
    if unlike(again, experiments):
        best = reweighted(best, again)
    return best, again, tuple(costs)


def seen_starts(model: Model, experiments: Sequence[Experiment]) -> list[dict[str, float]]:
    """Return deviations of initial states that an output shows at its first sample."""
    y, x = model.structure.y, model.structure.x
    names = [x[k].name() for k in range(x.numel())]
    shown = [
        (model.output_names[j], names.index(y[j].name()))
        for j in range(y.numel())
        if y[j].is_symbolic() and y[j].name() in names
    ]
    found = []
    for e in experiments:
        own, known = {}, e.known if e.held_out_whole else e.used
        for output, k in shown:
            readings = e.record.column(output)
            if readings is None:
                continue
            valid = readings[known & np.isfinite(readings)]
            if valid.size:
                own[names[k]] = float(valid[0]) - model.structure.states[k].start
        found.append(own)
    return found


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


def with_told(
    model: Model, experiments: Sequence[Experiment], found: "Certainty", interrupted: bool = False
) -> Model:
    """Return a fitted model that says from which records it comes and how sure its values are."""
    provenance = Provenance(
        identified_from=tuple((e.record.name, e.record.sha256) for e in experiments),
        package_version=__version__,
        free=tuple(found.errors),
        intervals=found.intervals,
        force_scale="given",
        interrupted=interrupted,
    )
    return replace(model, provenance=provenance, evidence=None)


def _told(
    fit: Fit, experiments: Sequence[Experiment], costs: tuple[float, ...]
) -> OdeIdentification:
    sure = certainty(fit)
    noise, rms, left_of = {}, {}, {}
    for o in fit.channels:
        j, readings = o.number, [e.measured(o.number)[e.at(o.number)] for e in experiments]
        noise[o.column] = first_order_noise(o.residuals)[0] * noise_share(experiments, j)
        rows = zip(o.records, o.parts, strict=True)
        left = np.concatenate([p * experiments[k].share(j) for k, p in rows])
        rms[o.column] = float(np.sqrt(np.mean(left**2)))
        left_of[o.column] = rms[o.column] / float(np.std(np.concatenate(readings)))
    good = [c for c in costs if np.isfinite(c)]
    agreed = sum(c <= (1.0 + _SAME) * min(good) for c in good)
    said = []
    if fit.interrupted or not fit.converged:
        said.append(note("own_interrupted" if fit.interrupted else "cut_off"))
    if len(costs) > 1 and agreed == 1:
        said.append(note("one_start", starts=len(costs)))
    said += [note("own_undetermined", name=n) for n in sure.undetermined]
    said += [note("on_bound", name=n) for n in sure.on_bound]
    missed = {n: rms[n] / noise[n] for n in rms if noise[n] > 0}
    said += [note("output_missed", output=n, ratio=r) for n, r in missed.items() if r > MISSED]
    said += [note("output_not_followed", output=n, share=s) for n, s in left_of.items() if s > _ALL]
    said += told_of_columns(fit.model, experiments)
    return OdeIdentification(
        model=with_told(fit.model, experiments, sure, fit.interrupted),
        fit=fit,
        experiments=tuple(experiments),
        errors=sure.errors,
        undetermined=sure.undetermined,
        rms=rms,
        noise=noise,
        costs=costs,
        agreed=agreed,
        remarks=tuple(said),
    )


def refuse_unfit(model: Model) -> None:
    """Refuse a model without an output, and one with sampled states. Raises InputError."""
    if not model.output_names:
        raise InputError(f"The model '{model.name}' has no output; a fit compares with one.")
    if model.structure.sampled:
        raise InputError(
            f"The model '{model.name}' has sampled states, whose sensitivities are not computed;"
            " leave the sampled component out."
        )


#: A parameter with a larger standard error than this, over its ordinary change, is not determined.
_UNDETERMINED = 0.5
#: Half a 95 % interval over the standard error.
_NORMAL = 1.96
#: Correlations of neighbours below this count as none.
_WHITE = 0.05


@dataclass(frozen=True)
class Certainty:
    """Standard errors and 95 % intervals of the parameters by name, and what is wrong with some.

    The interval of a parameter that spans decades is that of its logarithm; none goes beyond the
    parameter's bounds. `undetermined` are not
    told by the records, `on_bound` sit on a bound of their range.
    """

    errors: dict[str, float]
    intervals: dict[str, Interval]
    undetermined: tuple[str, ...]
    on_bound: tuple[str, ...]


def certainty(fit: Fit) -> Certainty:
    """Return how sure a fit's parameters are.

    Cov = (sum_j J_j^T J_j / s_j^2 + prior)^-1 over outputs j, residuals and derivatives whitened by
    the correlation of the residual's neighbours, s_j the rms that is left.
    """
    information = np.diag(1.0 / fit.unknowns.prior**2)
    for output in fit.channels:
        white = np.column_stack([output.residuals, output.jacobian])
        top = sum(float(p[1:] @ p[:-1]) for p in output.parts)
        r = min(top / max(float(output.residuals @ output.residuals), 1e-300), 0.98)
        if r >= _WHITE:  # the correlation of neighbours within the experiments
            parts = np.split(white, np.cumsum(output.lengths)[:-1])
            white = np.vstack([filtered([1.0, -r], [1.0], part)[1:] for part in parts])
        level = max(float(np.sqrt(np.mean(white[:, 0] ** 2))), 1e-300)
        information = information + white[:, 1:].T @ white[:, 1:] / level**2
    names = fit.unknowns.names
    spread = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))[: len(names)]
    slopes = np.diag(fit.unknowns.slopes(fit.theta))
    errors, intervals, on_bound = {}, {}, []
    for k, name in enumerate(names):
        value, error = fit.model.values[name], float(spread[k] * abs(slopes[k]))
        errors[name] = error
        factor = float(np.exp(min(_NORMAL * spread[k], 300.0)))
        half = _NORMAL * error
        low, high = float(fit.unknowns.low[k]), float(fit.unknowns.high[k])
        least, most = value - half, value + half
        if fit.unknowns.log[k]:
            least, most = value / factor, value * factor
        intervals[name] = Interval(max(least, low), min(most, high))
        edge = 1e-6 * (high - low) if np.isfinite(high - low) else 0.0
        if value <= low + edge or value >= high - edge:
            on_bound.append(name)
    undetermined = [n for n, s in zip(names, spread, strict=True) if s > _UNDETERMINED]
    return Certainty(errors, intervals, tuple(undetermined), tuple(on_bound))
