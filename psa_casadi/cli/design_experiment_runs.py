"""What `psa design experiment` does: effects, limits and noise from what is given; the design."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from psa_casadi.cli.inputs import Given
from psa_casadi.component import Component
from psa_casadi.design.experiment import criteria
from psa_casadi.design.experiment.experiment import (
    Informative,
    Separated,
    informative_experiment,
    rival_of_effect,
    separating_experiment,
)
from psa_casadi.design.experiment.limits import KINDS, Limits, limits_of
from psa_casadi.design.experiment.search import Effort
from psa_casadi.diagnosis.search.steps import fit_contenders
from psa_casadi.errors import InputError
from psa_casadi.identification.search import CORE
from psa_casadi.model.compose import Model
from psa_casadi.model.own_effects import known_effects
from psa_casadi.records import Record
from psa_casadi.report.page.designs import write_experiment_page
from psa_casadi.report.page.live import live_design
from psa_casadi.simulation.simulate import simulate

#: Noise of the sensor over the stroke where none is given, and samples of a record.
_NOISE_SHARE, _SAMPLES = 1e-3, 1000


def effects_of(given: Given, names: Sequence[str], parameters: Sequence[str]) -> list[Component]:
    """Return the effects to separate; all mistakes are noted."""
    table = known_effects(given.own)
    for name in dict.fromkeys(names):
        if name not in table:
            given.add(f"There is no effect '{name}'; `psa effects` lists them.")
    if len(set(names)) == 1:
        given.add(f"{names[0]} alone cannot be separated from anything; name two effects or more.")
    if names and parameters:
        given.add("--separate and --parameter are both given; design one record for each.")
    return [table[n] for n in dict.fromkeys(names) if n in table]


def limits_given(
    records: Sequence[Record], model: Model | None, wanted: Mapping[str, float | None]
) -> Limits | None:
    """Return the limits: as given, else those of the records, else the stack's rated voltage."""
    if records:
        return limits_of(records, **wanted)
    if model is None:
        return None
    own = {"low": 0.0, "high": model.values.get("u_rated"), "samples": float(_SAMPLES)}
    own |= {k: v for k, v in wanted.items() if v is not None}
    if own.get("duration") is None:
        raise InputError("No length is given; add --duration SECONDS, or --record with records.")
    if own["high"] is None:
        raise InputError("The model has no rated voltage; add --high VOLTS.")
    given = {k: float(v) for k, v in own.items() if v is not None}
    return Limits(samples=int(given.pop("samples")), **given)


def noise_of(
    model: Model, limits: Limits, noise: float | None, correlation: float
) -> criteria.SensorNoise:
    """Return the noise [nm] as given, else a share of the stroke within the limits."""
    if noise is not None:
        return criteria.SensorNoise(1e-9 * noise, correlation)
    time = limits.grid(100)
    ramp = limits.low + limits.span * time / time[-1]
    reached = simulate(model, time, ramp, as_exported=False).outputs["displacement"]
    return criteria.SensorNoise(_NOISE_SHARE * float(reached.max() - reached.min()), correlation)


def designed(
    model: Model,
    effects: Sequence[Component],
    records: Sequence[Record],
    *,
    parameters: Sequence[str],
    optimality: criteria.Optimality,
    limits: Limits,
    noise: criteria.SensorNoise,
    family: str,
    effort: Effort,
    progress: Callable[[str], None],
) -> tuple[Informative | Separated, list[criteria.Rival]]:
    """Return the record that tells effects apart, else the one that sharpens parameters.

    The rivals that it was designed for are fitted to records if there are any; without effects the
    one is the model, with what records of loops determine and what is wanted as its unknowns.
    """
    kinds = tuple(k for k in KINDS if family in ("any", k))
    free = [n for n in CORE if n in model.parameter_names]
    if not effects:
        own = [n for e in model.effects for n in e.fitted]
        names = dict.fromkeys([*free, *own, *(n for n in parameters if n in model.parameter_names)])
        whole = criteria.rival_of_model(model.name, model, tuple(names))
        found = informative_experiment(
            whole, noise, limits, names=parameters, optimality=optimality, kinds=kinds,
            effort=effort, progress=progress,
        )  # fmt: skip
        return found, [whole]
    base = None
    if records:
        fit, contenders, experiments = fit_contenders(
            records, effects, model=model, progress=progress
        )
        best = min(contenders, key=lambda c: c.fit.rms).fit
        noise, colour = criteria.noise_of_fit(best, experiments)
        rivals = [criteria.rival_of_fit(c.effect, c.fit, colour, c.evidence) for c in contenders]
        base = criteria.rival_of_fit("base", fit, colour)
    else:
        plain = model.without(e.name for e in effects)
        free = [n for n in free if n in plain.parameter_names]
        rivals = [rival_of_effect(model, e, free) for e in effects]
    return separating_experiment(
        rivals, noise, limits, base=base, kinds=kinds, effort=effort, progress=progress
    ), rivals


def write_page(
    path: Path,
    design: Informative | Separated,
    model: Model,
    rivals: Sequence[criteria.Rival],
    still: bool,
) -> None:
    """Write the page of a design, with the model that runs in it unless it is `still`."""
    time, voltage = design.record.time, design.record.voltage
    live = None
    if not still:
        live = live_design(model, (time, voltage, simulate(model, time, voltage).displacement))
    responses = {r.name: r.predict(design.record, r.truth) for r in rivals}
    write_experiment_page(path, design, model, responses, live)
