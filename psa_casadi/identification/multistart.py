"""Identify any model from its records: several starts, and the noise that every output leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError, PsaError
from psa_casadi.identification.determinacy import Certainty, certainty
from psa_casadi.identification.experiments import experiments_of, given_to, told_of_columns
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import (
    refitted,
    relevelled_all,
    reweighted,
    unlike,
    with_noise,
)
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note, texts
from psa_casadi.records.noise import first_order_noise
from psa_casadi.records.signals import Hold
from psa_casadi.records.split import Experiment, noise_share
from psa_casadi.shown import Reported, frame
from psa_casadi.simulation.sizes import sized
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.variables import Parameter, Provenance
from psa_casadi.version import __version__

FloatArray = npt.NDArray[np.float64]

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
    runs = experiments_of(
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
