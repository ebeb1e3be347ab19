"""What `psa design experiment` is given, turned into limits, noise and rivals, and the design."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from psa_casadi.cli.inputs import Given
    from psa_casadi.component import Component
    from psa_casadi.design.experiment.criteria import Optimality, Rival, SensorNoise
    from psa_casadi.design.experiment.experiment import Informative, Separated
    from psa_casadi.design.experiment.limits import Kind, Limits
    from psa_casadi.design.experiment.search import Effort
    from psa_casadi.model.compose import Model
    from psa_casadi.records.record import Record

#: Noise of the sensor over the stroke where none is given, and samples of a record.
_NOISE_SHARE, _SAMPLES = 1e-3, 1000


@dataclass(frozen=True)
class Plan:
    """What a design keeps to: limits, noise, family of voltages ("any" for all), effort."""

    limits: "Limits"
    noise: "SensorNoise"
    family: str
    effort: "Effort"

    @property
    def kinds(self) -> "tuple[Kind, ...]":
        """The families to search."""
        from psa_casadi.design.experiment.limits import KINDS

        return KINDS if self.family == "any" else tuple(k for k in KINDS if k == self.family)


def effects(
    given: "Given", names: "Sequence[str]", parameters: "Sequence[str]"
) -> "list[Component]":
    """Return the effects to separate; all mistakes are noted."""
    from psa_casadi.model.own_effects import known_effects

    table = known_effects(given.effects)
    for name in dict.fromkeys(names):
        if name not in table:
            given.add(f"There is no effect '{name}'; `psa effects` lists them.")
    if len(set(names)) == 1:
        given.add(f"{names[0]} alone cannot be separated from anything; name two effects or more.")
    if names and parameters:
        given.add("--separate and --parameter are both given; design one record for each.")
    return [table[n] for n in dict.fromkeys(names) if n in table]


def check_noise(given: "Given", noise: float | None, correlation: float, starts: int) -> None:
    """Note a noise or a number of starts that is none."""
    if noise is not None and not noise > 0.0:
        given.add(f"--noise is {noise:g} nm; give the positive rms of the sensor's noise.")
    if not 0.0 <= correlation < 1.0:
        given.add(f"--correlation is {correlation:g}; give a number from 0 to below 1.")
    if starts < 1:
        given.add(f"--starts is {starts}; give 1 or more.")


def limits(
    records: "Sequence[Record]", model: "Model | None", wanted: "Mapping[str, float | None]"
) -> "Limits | None":
    """Return the limits: as given, else those of the records, else the stack's rated voltage."""
    from psa_casadi.design.experiment.limits import Limits, limits_of
    from psa_casadi.errors import InputError

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


def noise(
    model: "Model", limits: "Limits", noise: float | None, correlation: float
) -> "SensorNoise":
    """Return the noise [nm] as given, else a share of the stroke within the limits."""
    from psa_casadi.design.experiment.criteria import SensorNoise
    from psa_casadi.simulation.simulate import simulate

    if noise is not None:
        return SensorNoise(1e-9 * noise, correlation)
    time = limits.grid(100)
    ramp = limits.low + limits.span * time / time[-1]
    reached = simulate(model, time, ramp, as_exported=False).outputs["displacement"]
    return SensorNoise(_NOISE_SHARE * float(reached.max() - reached.min()), correlation)


def separating(
    model: "Model",
    effects: "Sequence[Component]",
    records: "Sequence[Record]",
    plan: Plan,
    progress: "Callable[[str], None]",
) -> "tuple[Separated, list[Rival]]":
    """Return the record that tells effects apart, and the rivals it was designed for."""
    from psa_casadi.design.experiment.experiment import separating_experiment

    base, found, fitted = rivals(model, effects, records, progress)
    design = separating_experiment(
        found, fitted or plan.noise, plan.limits,
        base=base, kinds=plan.kinds, effort=plan.effort, progress=progress,
    )  # fmt: skip
    return design, found


def informative(
    model: "Model",
    parameters: "Sequence[str]",
    optimality: "Optimality",
    plan: Plan,
    progress: "Callable[[str], None]",
) -> "tuple[Informative, list[Rival]]":
    """Return the record that sharpens parameters, and the model with what is free in it."""
    from psa_casadi.design.experiment.experiment import informative_experiment

    rival = whole(model, parameters)
    design = informative_experiment(
        rival, plan.noise, plan.limits, names=parameters, optimality=optimality,
        kinds=plan.kinds, effort=plan.effort, progress=progress,
    )  # fmt: skip
    return design, [rival]


def rivals(
    model: "Model",
    effects: "Sequence[Component]",
    records: "Sequence[Record]",
    progress: "Callable[[str], None]",
) -> "tuple[Rival | None, list[Rival], SensorNoise | None]":
    """Return the base, the rivals and the noise, fitted to records if there are any."""
    from psa_casadi.design.experiment.criteria import noise_of_fit, rival_of_fit
    from psa_casadi.design.experiment.experiment import rival_of_effect
    from psa_casadi.diagnosis.search.steps import fit_contenders
    from psa_casadi.identification.search import CORE

    if not records:
        plain = model.without(e.name for e in effects)
        free = [n for n in CORE if n in plain.parameter_names]
        return None, [rival_of_effect(model, e, free) for e in effects], None
    base, found, experiments = fit_contenders(records, effects, model=model, progress=progress)
    noise, colour = noise_of_fit(min(found, key=lambda c: c.fit.rms).fit, experiments)
    fitted = [rival_of_fit(c.effect, c.fit, colour, c.evidence) for c in found]
    return rival_of_fit("base", base, colour), fitted, noise


def whole(model: "Model", wanted: "Sequence[str]") -> "Rival":
    """Return the model with what records of loops determine as its unknowns, and what is wanted."""
    from psa_casadi.design.experiment.criteria import rival_of_model
    from psa_casadi.identification.search import CORE

    own = [n for e in model.effects for n in e.fitted]
    free = [n for n in CORE if n in model.parameter_names]
    names = dict.fromkeys([*free, *own, *(n for n in wanted if n in model.parameter_names)])
    return rival_of_model(model.name, model, tuple(names))
