"""Identify any model from its records: a search from several starts within the bounds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.certainty import Certainty, certainty
from psa_casadi.any_model.fit import OdeFit, fit_ode, refitted, refuse_unfit
from psa_casadi.any_model.levels import first_levels, relevelled, reweighted, unlike, with_noise
from psa_casadi.any_model.runs import Run, noise_share, runs_of, told_of_columns
from psa_casadi.any_model.sizes import sized
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.records.quality.noise import first_order_noise
from psa_casadi.records.signals import Hold, signals_given
from psa_casadi.shown import Reported, frame
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
    """A model with fitted values, how sure they are, and warnings.

    `errors` are the parameters' standard errors, `intervals` their 95 % intervals in
    `model.provenance`; `rms` is what is left of every measured output and `noise` the fast part of
    that over all records, in the outputs' units. `costs` are those of the starts, nan for one that
    failed; `agreed` of them led to the same minimum. `runs` are the records.
    """

    model: Model
    fit: OdeFit
    runs: tuple[Run, ...]
    errors: Mapping[str, float]
    undetermined: tuple[str, ...]
    rms: Mapping[str, float]
    noise: Mapping[str, float]
    costs: tuple[float, ...]
    agreed: int
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        """Return the parameters with their standard errors, and what is left of the outputs."""
        rows = [
            f"  {n} = {self.model.values[n]:.6g} +- {e:.2g} {self.model.parameter(n).unit}"
            for n, e in self.errors.items()
        ]
        left = [f"  {n}: {v:.3g} rms left, noise {self.noise[n]:.3g}" for n, v in self.rms.items()]
        said = [f"  {w}" for w in self.warnings]
        return "\n".join([f"identified '{self.model.name}':", *rows, *left, *said])

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
    runs = runs_of(model, signals_given(records, hold), judged=False)
    fit, runs, costs = search_starts(
        sized(model, runs), runs, free_of(model, free), starts=starts,
        zeros=known_zeros(model, zeros), known_start=known_start,
    )  # fmt: skip
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
    model: Model,
    runs: Sequence[Run],
    free: Sequence[str],
    *,
    starts: int,
    zeros: tuple[str, ...],
    known_start: bool,
) -> tuple[OdeFit, tuple[Run, ...], tuple[float, ...]]:
    """Return the best fit from several starts, the experiments with their noise, and all costs.

    The costs are those of the starts with the same noise in all experiments. Raises SimulationError
    where none can be simulated.
    """
    levels, found = first_levels(runs), []
    costs: list[float] = []
    for values in _starts(model, free, max(1, starts)):
        try:
            own = fit_ode(
                model.with_values(values), runs, free, levels=levels,
                starts=seen_starts(model, runs) if not known_start else None,
                evaluations=_QUICK if starts > 1 else 3 * _QUICK, tolerance=1e-4, zeros=zeros,
                known_start=known_start,
            )  # fmt: skip
        except SimulationError:
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
        return replace(found[0], interrupted=True, converged=False), tuple(runs), tuple(costs)
    ended = [refitted(f, runs, evaluations=100) for f in found[:_FOLLOWED]]
    for quick, end in zip(found, ended, strict=False):
        costs[costs.index(quick.cost)] = end.cost
    best = relevelled(min(ended, key=lambda f: f.cost), runs)
    weighted = with_noise(best, runs)
    if unlike(weighted, runs):
        best = reweighted(best, weighted)
    return best, weighted, tuple(costs)


def seen_starts(model: Model, runs: Sequence[Run]) -> list[dict[str, float]]:
    """Return deviations of initial states that an output shows at its first sample."""
    y, x = model.structure.y, model.structure.x
    names = [x[k].name() for k in range(x.numel())]
    shown = [
        (j, names.index(y[j].name()))
        for j in range(y.numel())
        if y[j].is_symbolic() and y[j].name() in names
    ]
    found = []
    for run in runs:
        own, known = {}, run.of_beginning() if run.held_out_whole else run
        for j, k in shown:
            valid = np.flatnonzero(known.fitted(j))
            if valid.size:
                declared = model.structure.states[k].start
                own[names[k]] = float(run.outputs[valid[0], j]) - declared
        found.append(own)
    return found


def _starts(model: Model, free: Sequence[str], count: int) -> list[dict[str, float]]:
    """Return the declared values and random ones about them, within the bounds."""
    rng = np.random.default_rng(_SEED)
    declared = {n: model.values[n] for n in free}
    drawn = (
        {n: _drawn(model.parameter(n), model.values, rng) for n in free} for _ in range(count - 1)
    )
    return [declared, *drawn]


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
    model: Model, runs: Sequence[Run], found: Certainty, interrupted: bool = False
) -> Model:
    """Return a fitted model that says from which records it comes and how sure its values are."""
    provenance = Provenance(
        identified_from=tuple((r.name, r.signals.sha256) for r in runs),
        package_version=__version__,
        free=tuple(found.errors),
        intervals=found.intervals,
        force_scale="given",
        interrupted=interrupted,
    )
    return replace(model, provenance=provenance, evidence=None)


def _told(fit: OdeFit, runs: Sequence[Run], costs: tuple[float, ...]) -> OdeIdentification:
    sure = certainty(fit)
    noise, rms = {}, {}
    for o in fit.outputs:
        noise[o.column] = first_order_noise(o.residuals)[0] * noise_share(runs, o.index)
        left = [p * runs[k].noise[o.index] for k, p in zip(o.runs, o.parts, strict=True)]
        rms[o.column] = float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
    good = [c for c in costs if np.isfinite(c)]
    agreed = sum(c <= (1.0 + _SAME) * min(good) for c in good)
    said = []
    if fit.interrupted:
        said.append("The search was interrupted; these are the best values so far.")
    elif not fit.converged:
        said.append("The fit was cut off before it converged; its values are not final.")
    if len(costs) > 1 and agreed == 1:
        said.append(
            f"Of {len(costs)} starts only one led to this minimum; it is the best found, and may"
            " not be the best there is."
        )
    said += [f"'{n}' is not determined by these records." for n in sure.undetermined]
    said += [
        f"'{n}' sits on a bound of its range; its interval means nothing." for n in sure.on_bound
    ]
    said += [
        f"'{n}' is missed by {rms[n] / noise[n]:.2g} times its noise: the model lacks something, so"
        " that the values bend to it, and their errors are too small; psa.diagnose looks for the"
        " cause."
        for n in rms
        if noise[n] > 0 and rms[n] > MISSED * noise[n]
    ]
    said += [
        f"'{o.column}' is left with {100 * share:.0f} % of its own movement: see that its column,"
        " and those of the inputs, are in the model's units."
        for o in fit.outputs
        if (share := rms[o.column] / _movement(runs, o.index)) > _ALL
    ]
    said += told_of_columns(fit.model, runs)
    return OdeIdentification(
        model=with_told(fit.model, runs, sure, fit.interrupted),
        fit=fit,
        runs=tuple(runs),
        errors=sure.errors,
        undetermined=sure.undetermined,
        rms=rms,
        noise=noise,
        costs=costs,
        agreed=agreed,
        warnings=tuple(said),
    )


def _movement(runs: Sequence[Run], output: int) -> float:
    """Return the standard deviation of an output over the fitted samples of all experiments."""
    return float(np.std(np.concatenate([r.outputs[r.fitted(output), output] for r in runs])))
