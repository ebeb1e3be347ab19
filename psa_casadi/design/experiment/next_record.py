"""The next record of any model: rivals, noise and known information; the design."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.interruption import interruptible_work
from psa_casadi.common.progress import Progress, on_a_terminal, silent
from psa_casadi.design.experiment.criteria import (
    Optimality,
    Rival,
    SensorNoise,
    noise_of_fit,
    rival_of_fit,
    rival_of_model,
)
from psa_casadi.design.experiment.experiment import (
    Informative,
    Separated,
    informative_experiment,
    record_for,
    rival_of_effect,
    separating_experiment,
    usual_inputs,
)
from psa_casadi.design.experiment.limits import KINDS, Kind, Limits
from psa_casadi.design.experiment.search import Effort
from psa_casadi.diagnosis.generic import Attached, effects_of, extended, of_ones_own
from psa_casadi.diagnosis.pack import Pack, Task
from psa_casadi.diagnosis.result import Contender
from psa_casadi.diagnosis.search.state import fit_contenders, fitted_rivals
from psa_casadi.identification.experiments import experiments_of, given_to
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.multistart import free_of, known_zeros, search_starts
from psa_casadi.identification.search import CORE
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.ports import with_ports
from psa_casadi.records.signals import Hold
from psa_casadi.records.split import Experiment, whole
from psa_casadi.simulation.sizes import sized, sizes_of
from psa_casadi.simulation.start import is_stack

#: Noise of a sensor over what the output moves, by default.
NOISE_SHARE = 1e-3
_RAMP = 100


@on_a_terminal
@interruptible_work()
def design_experiment(
    model: Model,
    limits: Mapping[str, Limits],
    *,
    records: Any = (),
    separate: Sequence[str | Component] = (),
    parameters: Sequence[str] = (),
    free: Sequence[str] | None = None,
    optimality: Optimality = "D",
    noise: float | Mapping[str, float] | None = None,
    correlation: float = 0.0,
    zeros: Sequence[str] = (),
    hold: Hold | None = None,
    known_start: bool = False,
    kinds: Sequence[Kind] = KINDS,
    effort: Effort | None = None,
    progress: Progress = silent,
) -> Informative | Separated:
    """Return the record to measure next with any model: the inputs within their limits.

    Without effects to `separate` it is the record that best determines the `parameters` (all that
    may be fitted): D-, E- or A-optimal for their covariance (known + J^T W J)^-1. Else it is the
    one that best separates the effects, by the least distance between what one rival predicts and
    another that is fitted again to that (`psa_casadi.design.experiment.criteria`).

    Args:
        model: A stack's model, or any other.
        limits: `Limits` of every input that is to move, by name; the others stay at their start
            values. The inputs of any other model than a stack start at these values too.
        records: Records already measured: rivals are fitted to them. None means ordinary
            sizes of the effects.
        separate: Names of effects, of a stack's table or as a diagnosis of any other model names
            them, or components.
        parameters: Parameters to determine, by default all that are free.
        free: Parameters of a model that is no stack that are not known, by default all that may be
            fitted.
        optimality: "D" volume, "A" mean square, "E" worst direction of the confidence region.
        noise: Rms of every output's sensor in its unit, by name; one number where there is one
            output. By default a thousandth of what the output moves, or what the fits leave.
        correlation: Correlation of the noise in neighbouring samples.
        zeros: Outputs of a model that is no stack whose zero is unknown in each record.
        hold: What the inputs of a model that is no stack do between samples, by default linear.
        known_start: The record of a model that is no stack will start at its declared states.
        kinds: Families of waveforms to choose from.
        effort: How long to search.
        progress: Is called with what is being done.

    Raises:
        InputError: limits, names or records do not fit.
        SimulationError: the model cannot follow any of the inputs.
    """
    if isinstance(records, tuple | list) and not records:
        records = None
    if is_stack(model):
        rivals, base, left = _of_a_stack(model, records, separate, parameters, progress)
    else:
        words: dict[str, Any] = {
            "outputs": model.output_names, "zeros": known_zeros(model, zeros),
            "known_start": known_start, "hold": hold or "linear",
        }  # fmt: skip
        names = tuple(dict.fromkeys([*free_of(model, free), *parameters]))
        measured = None if records is None else given_to(model, records, hold)
        rivals, base, left = _of_any_model(
            model, limits, measured, separate, names, words, progress
        )
    sensors = left if left and noise is None else noise_of(rivals[0], limits, noise, correlation)
    ready = _resting(model, limits)
    if not separate:
        return informative_experiment(
            rivals[0], sensors, ready, names=parameters, optimality=optimality, kinds=kinds,
            effort=effort, progress=progress,
        )  # fmt: skip
    return separating_experiment(
        rivals, sensors, ready, base=base, kinds=kinds, effort=effort, progress=progress
    )


def _resting(model: Model, limits: Mapping[str, Limits]) -> dict[str, Limits]:
    """Return the limits with where the inputs rest: a stack's at the lowest voltage."""
    starts = {} if is_stack(model) else {i.name: i.start for i in model.structure.inputs}
    return {
        n: item if item.rest is not None else replace(item, rest=starts.get(n))
        for n, item in limits.items()
    }


def noise_of(
    rival: Rival,
    limits: Mapping[str, Limits],
    noise: float | Mapping[str, float] | None,
    correlation: float,
) -> tuple[SensorNoise, ...]:
    """Return the stated noise of every output, else a share of what it moves along a ramp.

    Raises InputError for a number where there are several outputs, and for a wrong name.
    """
    names = rival.outputs
    if isinstance(noise, float | int):
        if len(names) > 1:
            raise InputError(
                f"The model has the outputs {', '.join(names)}; give the noise of each by name, as"
                f" {{'{names[0]}': {noise:g}, ...}}."
            )
        noise = {names[0]: float(noise)}
    rms_by_output = dict(noise or {})
    for name, rms in rms_by_output.items():
        if name not in names or not rms > 0.0:
            raise InputError(
                f"The noise of '{name}' is {rms:g}; give a positive rms of one of"
                f" {', '.join(names)}."
            )
    if len(rms_by_output) < len(names):
        some = next(iter(limits.values()))
        time = some.grid(_RAMP)
        ramps = {n: each.low + each.span * time / time[-1] for n, each in limits.items()}
        outputs = rival.predict(record_for(rival.model)("ramp", time, ramps), rival.truth)
        sizes = dict(zip(rival.model.output_names, rival.model.output_nominals(), strict=True))
        for name, y in zip(names, outputs.T, strict=True):
            moved = float(np.ptp(y))
            rms_by_output.setdefault(name, NOISE_SHARE * (moved or float(sizes[name])))
    return tuple(SensorNoise(rms_by_output[n], correlation) for n in names)


#: The models that a record is designed for, the base, and the noise that a fit leaves.
_Rivals = tuple[list[Rival], Rival | None, tuple[SensorNoise, ...] | None]


def _of_any_model(
    model: Model, limits: Mapping[str, Limits], records: Any, separate: Sequence[str | Component],
    names: Sequence[str], words: dict[str, Any], progress: Progress,
) -> _Rivals:  # fmt: skip
    """Return the rivals of a model with free parameters `names`; `words` are fields of a rival.

    Without effects the one rival is the model. Raises InputError.
    """
    runs: tuple[Experiment, ...] = ()
    base: Fit | None = None
    if records is not None:
        runs = experiments_of(
            model, records, judged=False, zeros=words["zeros"], known_start=words["known_start"]
        )
        progress("fitting from several starts")
        base, _ = search_starts(sized(model, runs), runs, names, starts=8)
        runs = base.experiments
        words["outputs"] = tuple(c.column for c in base.channels)
    if not separate:
        if base is None:
            return [rival_of_model(model.name, model, names, **words)], None, None
        noise, colours = noise_of_fit(base)
        return [rival_of_fit(model.name, base, colours, **words)], None, noise
    effects = _attached(model, limits, separate, runs, base)
    if base is None:
        return [
            rival_of_effect(extended(model, [e]), e.component, names, **words) for e in effects
        ], None, None  # fmt: skip
    opened = replace(base, model=with_ports(base.model))
    components = tuple(e.component for e in effects)
    task = Task(components, Pack(), progress=progress)
    return _fitted(base, fitted_rivals(opened, task), words)


def _of_a_stack(
    model: Model, records: Any, separate: Sequence[str | Component], parameters: Sequence[str],
    progress: Progress,
) -> _Rivals:  # fmt: skip
    free = [n for n in CORE if n in model.parameter_names]
    if not separate:
        fitted = [n for e in model.effects for n in e.fitted]
        wanted = [n for n in parameters if n in model.parameter_names]
        names = tuple(dict.fromkeys([*free, *fitted, *wanted]))
        return [rival_of_model(model.name, model, names)], None, None
    effects = [EFFECTS[e] if isinstance(e, str) else e for e in separate]
    if records is not None:
        base, contenders = fit_contenders(records, effects, model=model, progress=progress)
        return _fitted(base, contenders, {})
    plain = model.without(e.name for e in effects)
    free = [n for n in free if n in plain.parameter_names]
    return [rival_of_effect(model, e, free) for e in effects], None, None


def _fitted(
    base: Fit, contenders: Sequence[Contender], words: dict[str, Any]
) -> tuple[list[Rival], Rival, tuple[SensorNoise, ...]]:
    """Return rivals that were fitted to records, the base, and the noise that the best leaves."""
    best = min(contenders, key=lambda c: c.fit.cost if words else c.fit.rms).fit
    noise, colours = noise_of_fit(best)
    rivals = [rival_of_fit(c.effect, c.fit, colours, c.evidence, **words) for c in contenders]
    return rivals, rival_of_fit("base", base, colours, **words), noise


def _attached(
    model: Model,
    limits: Mapping[str, Limits],
    separate: Sequence[str | Component],
    runs: Sequence[Experiment],
    base: Fit | None,
) -> list[Attached]:
    """Return effects of a model that is no stack, by their names or as components.

    Their sizes are those of the records, else those that a triangle within the limits shows.
    """
    if base is None:
        waves = usual_inputs(_resting(model, limits))["triangle"]
        time = next(iter(limits.values())).grid()
        planned: Any = record_for(model)("triangle", time, waves)
        sizes = sizes_of(model, [whole(planned)])
    else:
        sizes = sizes_of(base.model, runs, base.starts())
    known = {e.name: e for e in effects_of(model, sizes)}
    attached = []
    for effect in separate:
        if isinstance(effect, Component):
            attached.append(of_ones_own(model, effect))
        elif effect in known:
            attached.append(known[effect])
        else:
            near = get_close_matches(effect, known, 3, 0.3) or list(known)[:3]
            raise InputError(
                f"There is no effect '{effect}' of the model '{model.name}'; of {len(known)} the"
                f" nearest are {', '.join(near)}."
            )
    return attached
