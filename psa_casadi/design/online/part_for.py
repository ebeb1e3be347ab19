"""Parts of a control loop by name, sampled at a period and tuned to a stack."""

from psa_casadi.components import COMPONENTS
from psa_casadi.design.online.observer import stack_values
from psa_casadi.design.online.recursive_least_squares import identifier_for
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.nanopositioner import nanopositioner
from psa_casadi.model.parts import PARTS, compensator_for, part_model

__all__ = ["part_for"]

#: The rms error of sensor and model as a share of the stroke, where none is given.
_NOISE = 1e-3
_OBSERVING = ("hysteresis_observer", "feed_forward")
_LEARNING = ("online_identification", "adaptive_feed_forward")
_TUNED = ("position_controller", "hysteresis_compensator", *_OBSERVING, *_LEARNING)


def part_for(
    name: str, stack: Model | None = None, *, period: float, noise: float | None = None
) -> Model:
    """Return a part by name that acts every `period` [s], tuned to a stack if one is given.

    The position controller is that of `nanopositioner` around the stack. Observers, feed-forward
    and identification have the stack's values; they see the command, amplifier included. `noise`
    [m] is the rms error of sensor and model for those that learn, by default 0.1 % of the stroke.

    Raises InputError for an unknown name, a part that is not tuned to a stack, and for what the
    tuning refuses.
    """
    bare = part_model(name)
    sampled = bare.structure.period
    if stack is None:
        return bare.with_values({sampled: period} if sampled else {})
    if name not in _TUNED:
        raise InputError(
            f"The part '{name}' is not tuned to a stack; leave the stack out. Tuned are"
            f" {', '.join(_TUNED)}."
        )
    if name == "position_controller":
        return nanopositioner(stack, sample_time=period).parts["controller"]
    if name == "hysteresis_compensator":
        return compensator_for(stack)
    values = stack_values(stack, period)
    if name in _LEARNING:
        stroke = abs(values["k_L"]) * values["u_rated"] / values["stiffness"]
        error = noise if noise is not None else _NOISE * stroke
        values = dict(identifier_for(stack, period, noise=error).values)
    component = COMPONENTS[name]
    own = {p.name: values[p.name] for p in component.parameters}
    return compose([component], own, name=name, description=PARTS[name].description)
