"""The parts around a stack: each is a separate model, tuned to the stack on request."""

from dataclasses import dataclass, replace
from math import inf, pi

from psa_casadi.common.errors import InputError
from psa_casadi.model.components import COMPONENTS
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.effects import EFFECTS

__all__ = ["PARTS", "PartKind", "compensator_for", "part_model"]


@dataclass(frozen=True)
class PartKind:
    """A part by name: what it is and the components that it consists of."""

    name: str
    description: str
    components: tuple[str, ...]


#: What each part is, and its components where these are others than the one of its name.
_PARTS: dict[str, tuple[str, ...]] = {
    "flexure_stage": ("guided stage that a stack pushes through a contact stiffness", "flexure"),
    "position_controller": (
        "sampled position controller: PI behind a notch, saturation, anti-windup",
    ),
    "hysteresis_compensator": (
        "observer of a stack's hysteresis force that takes it off the command",
        "hysteresis_compensator", "linear_force", "bouc_wen",
    ),
    "voltage_amplifier": ("voltage amplifier of finite bandwidth, output range and current",),
    "charge_amplifier": ("charge amplifier with a leakage corner",),
    "prestress_mechanism": ("mass, spring and damper that a stack's tip moves",),
    "online_identification": (
        "recursive least squares of a stack's hysteresis parameters, sampled",
    ),
    "hysteresis_observer": ("observer of a stack's hysteresis force, sampled",),
    "feed_forward": (
        "voltage for a wanted displacement, the stack's hysteresis taken off, sampled",
    ),
    "adaptive_feed_forward": ("feed_forward that follows the measured displacement, sampled",),
}  # fmt: skip
PARTS = {
    name: PartKind(name, text, tuple(components) or (name,))
    for name, (text, *components) in _PARTS.items()
}
"""The parts around a stack by name, as `part_model` takes them."""

#: Effects on the generated force that the observer can run: those of u and of states. (The one of
#: rate_dependent_hysteresis follows u' at once, which is the compensated command itself: a loop.)
_OBSERVED = (
    "field_dependent_gain",
    "hysteresis_memory",
    "rate_independent_asymmetry",
    "saturation_of_strain",
)


def part_model(name: str, **values: float) -> Model:
    """Return a part by name as a model, with some values replaced (SI units).

    Raises InputError for an unknown name, an unknown parameter or a value out of bounds.
    """
    if name not in PARTS:
        raise InputError(f"There is no part named '{name}'; there are {', '.join(PARTS)}.")
    kind = PARTS[name]
    components = [COMPONENTS[n] for n in kind.components]
    return compose(components, values, name=name, description=kind.description)


def compensator_for(
    stack: Model, *, amplifier_gain: float = 1.0, amplifier_bandwidth: float = inf
) -> Model:
    """Return the hysteresis compensator of a stack: the stack's equation (8) with its values.

    The command is scaled so that `amplifier_gain` [1] times it is the voltage at the stack's input;
    the observer's lag is that of the stack's drive and of an amplifier of `amplifier_bandwidth`
    [Hz]. Effects of the stack on the force that its wafers generate come along; creep and what lies
    behind the force stay.

    Raises InputError for a model without drive, linear force and Bouc-Wen hysteresis.
    """
    needed = ("drive", "linear_force", "bouc_wen")
    there = {c.name for c in stack.components}
    missing = [n for n in needed if n not in there]
    if missing:
        raise InputError(
            f"The model '{stack.name}' has no {', '.join(missing)}; a compensator needs a stack"
            " with them, such as one of `psa stacks`."
        )
    kind = PARTS["hysteresis_compensator"]
    components = [COMPONENTS[n] for n in kind.components]
    components += [EFFECTS[n] for n in _OBSERVED if n in there]
    lag = 0.0 if amplifier_bandwidth == inf else 1.0 / (2.0 * pi * amplifier_bandwidth)
    table = {p.name: stack.values[p.name] for c in components for p in c.parameters
           if p.name in stack.values}  # fmt: skip
    table["drive_gain"] = stack.values["G"] * amplifier_gain
    table["drive_time"] = stack.values["R_s"] * stack.values["C_p"] + lag
    note = f"Compensates the hysteresis of {stack.name}, with that model's values."
    model = compose(components, table, name=kind.name, description=kind.description)
    return model.with_values({}, provenance=replace(stack.provenance, notes=(note,)))
