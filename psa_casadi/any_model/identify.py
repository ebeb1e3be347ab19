"""Identify any model from its records: several starts, and the noise that every output leaves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.fit import (
    Certainty,
    OdeFit,
    certainty,
    fit_ode,
    measured_outputs,
    refitted,
    refuse_unfit,
)
from psa_casadi.any_model.predict import shown_by, sized
from psa_casadi.any_model.runs import Run, given_to, noise_share, runs_of, told_of_columns
from psa_casadi.diagnosis.colour import Colour, noise_rms, uncertain
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note, texts
from psa_casadi.records.noise import first_order_noise
from psa_casadi.records.signals import Hold
from psa_casadi.shown import Reported, frame
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.variables import Parameter, Provenance
from psa_casadi.version import __version__

FloatArray = npt.NDArray[np.float64]

#: Noise is estimated from so many samples or more, and differs from so many standard errors on.
_TELLING, _SURE = 32, 3.0


def relevelled(fit: OdeFit, runs: Sequence[Run], rounds: int = 4) -> OdeFit:
    """Fit again with every output's residual as its noise level, until that stays the same."""
    for _ in range(rounds if len(fit.outputs) > 1 else 1):
        levels = tuple(max(o.rms, o.straight, 1e-300) for o in fit.outputs)
        change = np.max(np.abs(np.log(np.array(levels) / np.array(fit.levels))))
        if change < 0.02 or fit.interrupted:
            break
        fit = refitted(fit, runs, levels=levels)
    return fit


def with_noise(fit: OdeFit, runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return the experiments with their shares of the noise, as the fast parts of residuals tell.

    Of every output, over the usual one of all experiments (the geometric mean by samples). A share
    that cannot be told from 1 is 1. Of an experiment that is held out whole, its beginning tells.
    """
    shares = [r.noise.copy() for r in runs]
    beginnings = []
    for k, run in enumerate(runs):
        if run.held_out_whole:
            first = run.of_beginning()
            shown = shown_by(fit.model, first, fit.starts()[k], first.stop, fit.rtol, fit.zeros)
            beginnings.append((k, first, (run.outputs[: first.stop] - shown) / run.noise))
    for o in fit.outputs:
        fitted = zip(o.runs, o.parts, strict=True)
        begun = ((k, e[r.fitted(o.index)[: r.stop], o.index]) for k, r, e in beginnings)
        found = [(k, p) for k, p in (*fitted, *begun) if len(p) >= _TELLING]
        if len(found) < 2:
            continue
        noise = [max(first_order_noise(p)[0], o.straight, 1e-300) for _, p in found]
        over = np.log(noise) - np.average(np.log(noise), weights=[len(p) for _, p in found])
        for (k, part), own in zip(found, over, strict=True):
            if abs(own) > 0.5 * _SURE * uncertain(part):  # half of the power's error is the rms's
                shares[k][o.index] *= float(np.exp(own))
    return tuple(replace(r, noise=share) for r, share in zip(runs, shares, strict=True))


def unlike(runs: Sequence[Run], others: Sequence[Run]) -> bool:
    """Whether the shares of the noise differ."""
    return any(np.any(a.noise != b.noise) for a, b in zip(runs, others, strict=True))


def reweighted(fit: OdeFit, runs: Sequence[Run]) -> OdeFit:
    """Fit again with other shares of the noise."""
    return relevelled(refitted(fit, runs, evaluations=100), runs)


def noise_left(fit: OdeFit, colour: Colour) -> list[float]:
    """Return the noise in every output's residual, over the shares that weighted it."""
    rows = zip(fit.outputs, colour.each, strict=True)
    return [noise_rms(o.residuals, own) for o, own in rows]


def noise_told(
    fit: OdeFit, colour: Colour, runs: Sequence[Run]
) -> tuple[tuple[Run, ...], tuple[float, ...]]:
    """Return the experiments and every output's noise over them, in its unit, as a fit leaves it.

    What a search has weighted by is from the base's residual, which holds more than noise.
    """
    told, levels = with_noise(fit, runs), []
    for o, own in zip(fit.outputs, colour.each, strict=True):
        j = o.index
        rows = zip(o.runs, o.parts, strict=True)
        left = np.concatenate([p * (runs[k].noise[j] / told[k].noise[j]) for k, p in rows])
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
    runs = runs_of(model, given_to(model, records, hold), judged=False)
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
    # to begin with: a tenth of every measured output's standard deviation
    levels = [0.1 * _movement(runs, j) for j in measured_outputs(runs)]
    found: list[OdeFit] = []
    costs: list[float] = []
    rng = np.random.default_rng(_SEED)
    for number in range(max(1, starts)):
        declared = model.values  # the first start; random ones about them, within the bounds
        values = {n: _drawn(model.parameter(n), declared, rng) for n in free} if number else {}
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
    if fit.interrupted or not fit.converged:
        said.append(note("own_interrupted" if fit.interrupted else "cut_off"))
    if len(costs) > 1 and agreed == 1:
        said.append(note("one_start", starts=len(costs)))
    said += [note("own_undetermined", name=n) for n in sure.undetermined]
    said += [note("on_bound", name=n) for n in sure.on_bound]
    missed = {n: rms[n] / noise[n] for n in rms if noise[n] > 0}
    said += [note("output_missed", output=n, ratio=r) for n, r in missed.items() if r > MISSED]
    left_of = {o.column: rms[o.column] / _movement(runs, o.index) for o in fit.outputs}
    said += [note("output_not_followed", output=n, share=s) for n, s in left_of.items() if s > _ALL]
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
        remarks=tuple(said),
    )


def _movement(runs: Sequence[Run], output: int) -> float:
    """Return the standard deviation of an output over the fitted samples of all experiments."""
    return float(np.std(np.concatenate([r.outputs[r.fitted(output), output] for r in runs])))
