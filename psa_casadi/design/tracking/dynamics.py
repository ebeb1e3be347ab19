"""A model as the design sees it: voltage in; displacement and current out; numbers inside."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from psa_casadi.design.tracking.amplifier_limits import AmplifierLimits
from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model
from psa_casadi.simulation.start import start_state
from psa_casadi.units import FloatArray


@dataclass(frozen=True, eq=False)
class Dynamics:
    """The equations that a design is made on.

    `f` is a CasADi function (time, x, v) -> (xdot, displacement, current) with columns of nx, one
    voltage [V], one displacement [m] and one current [A]; it may come from a model (`dynamics_of`)
    or from anything that has the same states, such as an imported FMU. `nominal` (nx,) are the
    sizes of the states.
    """

    f: ca.Function
    nominal: FloatArray


def dynamics_of(model: Model) -> Dynamics:
    """Return the equations of a stack's model; all other inputs stay at their start values.

    Raises InputError if the model has no voltage or no displacement.
    """
    demand_stack(model)
    s = model.structure
    time, x, v = ca.SX.sym("time"), ca.SX.sym("x", len(s.states)), ca.SX.sym("v")
    u = [v if i.name == "voltage" else ca.SX(i.start) for i in s.inputs]
    xdot, y = s.f(time, x, ca.vertcat(*u), model.parameter_vector())
    row = model.output_names.index
    current = y[row("current")] if "current" in model.output_names else ca.SX(0)
    f = ca.Function("dynamics", [time, x, v], [xdot, y[row("displacement")], current])
    return Dynamics(f, model.state_nominals())


def demand_stack(model: Model) -> None:
    """Raise InputError for a model that does not turn a voltage into a displacement."""
    if "voltage" not in model.input_names or "displacement" not in model.output_names:
        raise InputError(
            f"The model '{model.name}' has no voltage input or no displacement output, so no"
            " voltage can make it follow a path; give the model of a stack."
        )
    if getattr(model.structure, "sampled", ()):
        raise InputError(
            f"The model '{model.name}' has states that change at sample instants only, which a"
            " design cannot see through; give the stack without its controller."
        )


def smooth_form(model: Model, width: float) -> Model:
    """Return the model with the kinks at u' = 0 rounded over the rates `width` [V/s].

    The model's own sign of the rate is u' / sqrt(u'^2 + hold_rate^2); the smooth form has `width`
    in place of a smaller hold_rate. A model without hysteresis is returned as it is.
    """
    if "hold_rate" not in model.values:
        return model
    wide = min(max(model.values["hold_rate"], width), model.parameter("hold_rate").bounds[1])
    return model.with_values({"hold_rate": wide})


def rest_at(model: Model, displacement: float) -> tuple[float, FloatArray]:
    """Return the voltage [V] that holds a displacement [m] without a past, and the state (nx,).

    Newton's method on the settled state by secants; the displacement at rest is all but linear in
    the voltage. Raises InputError if no voltage gives the displacement.
    """
    row = model.output_names.index("displacement")
    starts = [i.start for i in model.structure.inputs]
    column = model.input_names.index("voltage")
    p = model.parameter_vector()

    def settled(v: float) -> tuple[float, FloatArray]:
        u = [v if k == column else start for k, start in enumerate(starts)]
        x = start_state(model, u).x
        return float(model.structure.f(0.0, x, u, p)[1][row]), x

    before, after = 0.0, 1.0
    reached = settled(before)[0]
    for _ in range(20):
        found, x = settled(after)
        if found == reached or abs(found - displacement) < 1e-9 * model.output_nominals()[row]:
            break
        slope = (found - reached) / (after - before)
        before, reached, after = after, found, after + (displacement - found) / slope
    if not abs(found - displacement) < 1e-6 * model.output_nominals()[row]:
        raise InputError(
            f"No voltage holds the stack at {1e6 * displacement:g} um; the path is likely in"
            " another unit, or far beyond the stroke: correct it."
        )
    return after, x


def move_ends(
    model: Model, begin: float, end: float, limits: AmplifierLimits
) -> tuple[float, FloatArray]:
    """Return voltage [V] and state where a move [m] begins; both its ends must be within limits."""
    demand_stack(model)
    problems = Problems()
    if begin == end:
        problems.add("The move begins where it ends; name two positions.")
    if not np.isfinite([limits.min_voltage, limits.max_voltage]).all():
        problems.add(
            "A quickest move uses the whole voltage range; give both limits of the voltage."
        )
    problems.raise_if_any()
    (rest, start), (final, _) = rest_at(model, begin), rest_at(model, end)
    for where, voltage in ((begin, rest), (end, final)):
        if not limits.min_voltage - 1e-9 <= voltage <= limits.max_voltage + 1e-9:
            problems.add(
                f"The stack rests at {1e6 * where:.4g} um with {voltage:.4g} V, outside the voltage"
                " limits; widen them or choose another position."
            )
    problems.raise_if_any()
    return float(np.clip(rest, limits.min_voltage, limits.max_voltage)), start
