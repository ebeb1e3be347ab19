"""Effects in the rate of a state, and the table of all effects of a model."""

import casadi as ca

from psa_casadi.component import Expression, Symbols
from psa_casadi.diagnosis.generic.attached import (
    LARGEST,
    ORDINARY,
    Attached,
    Own,
    Terms,
    at_port,
    rounded,
    scale_of,
    size_of,
)
from psa_casadi.diagnosis.generic.of_parameters import parameter_effects
from psa_casadi.diagnosis.generic.of_signals import ANGLE, bent, beyond, level_of, signal_effects
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Port, ports_of, state_unit
from psa_casadi.shapes import ANGLES, magnitude_power, signed_power, smooth_magnitude
from psa_casadi.simulation.sizes import Sizes
from psa_casadi.units import rate_unit
from psa_casadi.variables import Parameter, State

#: Ordinary sizes at which a memory is looked for: the derivative at 0 tells little of one that acts
#: in full.
_IN_FULL = (0.0, 2.0, -2.0)
#: A rate below this share of its size has no direction.
_STILL = 1e-3
#: Stiffest stop, over the largest rate at one range beyond it; width of its corner over the range.
_STIFF, _CORNER = 1e4, 0.005


def rate_effects(model: Model, port: Port, sizes: Sizes) -> tuple[Attached, ...]:
    """Return the effects in the rate of one state of a model."""
    state = port.variable
    found = {q.name() for q in ca.symvar(model.structure.xdot[model.state_names.index(state)])}
    base = [q.name for c in model.components if c.gain is None for q in c.states]
    seen = [n for n in base if n in found or n == state]  # what the rate depends on, and itself
    # a hysteresis works along positions, else along all that is seen
    ways = [n for n in seen if n != state and _speed(model, n) is not None] or seen
    return (
        *(make(model, port, sizes) for make in (_constant, _loss, _friction, _drag)),
        *(make(model, port, sizes, n) for n in seen for make in (_curve, _stop)),
        *(_hysteresis(model, port, sizes, n) for n in ways),
    )


def _speed(model: Model, state: str) -> str | None:
    """Return the state that is the rate of another one by definition, None if there is none."""
    rate = ca.SX(model.structure.der[state])
    return str(rate.name()) if rate.is_symbolic() and rate.name() in model.state_names else None


def _constant(_: Model, port: Port, sizes: Sizes) -> Attached:
    return at_port(
        port, f"constant_in_{port.variable}", lambda s, own: own("size"),
        gain="size",
        words=(
            "a constant is missing",
            "weight, leak, offset of an input",
            "Q gains size",
            "a residual of the form of a step answer in every record",
        ),
        parameters=(size_of(port.unit, sizes.rates[port.variable], "constant part of the rate"),),
    )  # fmt: skip


def _loss(model: Model, port: Port, sizes: Sizes) -> Attached:
    v = port.variable
    return at_port(
        port, f"loss_in_{v}", lambda s, own: -own("size") * getattr(s, v) / own("range"),
        gain="size",
        words=(
            "it loses in proportion to its state",
            "viscous damping, leak, cooling",
            f"Q loses size {v}/range",
            "resonances are lower, and decays faster, at every level alike",
        ),
        parameters=(
            size_of(port.unit, sizes.rates[v], "loss at the largest state"),
            _range(model, sizes, v),
        ),
    )  # fmt: skip


def _friction(model: Model, port: Port, sizes: Sizes) -> Attached:
    v = port.variable
    size = rounded(sizes.states[v])

    def law(s: Symbols, own: Own) -> Expression:
        state = getattr(s, v)
        return -own("size") * state / ca.sqrt(state**2 + own("width") ** 2)

    return at_port(
        port, f"friction_in_{v}", law,
        gain="size",
        words=(
            "dry friction holds against the motion",
            "Coulomb's friction, smooth about rest",
            f"Q loses size {v}/sqrt({v}^2 + width^2)",
            "what stands still needs a push to move; small motions are missed most",
        ),
        parameters=(
            size_of(port.unit, sizes.rates[v], "friction, as a rate", positive=True),
            Parameter(
                "width", 0.02 * size, state_unit(model, v), (5e-4 * size, 0.7 * size),
                f"{v} below which it fades", log=True, limit=True
            ),
        ),
        probe={"width": (0.01 * size, 0.05 * size)},
    )  # fmt: skip


def _drag(model: Model, port: Port, sizes: Sizes) -> Attached:
    v = port.variable

    def law(s: Symbols, own: Own) -> Expression:
        part = getattr(s, v) / own("range")
        return -own("size") * part * smooth_magnitude(part, _STILL)

    return at_port(
        port, f"drag_in_{v}", law,
        gain="size",
        words=(
            "it loses with the square of its state",
            "drag of a turbulent flow",
            f"Q loses size r |r|,  r = {v}/range",
            "damping that grows with the level",
        ),
        parameters=(
            size_of(port.unit, sizes.rates[v], "loss at the largest state"),
            _range(model, sizes, v),
        ),
    )  # fmt: skip


def _curve(model: Model, port: Port, sizes: Sizes, x: str) -> Attached:
    return at_port(
        port, f"curve_of_{x}_in_{port.variable}",
        lambda s, own: own("size") * bent(getattr(s, x) / own("range"), own("angle")),
        gain="size",
        words=(
            f"it depends on {x} along a curve",
            "hardening or softening spring; first two terms beyond the straight line",
            f"Q gains size (cos(angle) r^2 + sin(angle) r^3),  r = {x}/range",
            "resonances move with the level; harmonics",
        ),
        parameters=(
            size_of(
                port.unit, sizes.rates[port.variable], "deviation from the line at the range's end"
            ),
            ANGLE,
            _range(model, sizes, x),
        ),
        probe={"angle": ANGLES},
    )  # fmt: skip


def _stop(model: Model, port: Port, sizes: Sizes, x: str) -> Attached:
    force, size = sizes.rates[port.variable], rounded(sizes.states[x])

    def law(s: Symbols, own: Own) -> Expression:
        excess = beyond(getattr(s, x), own("level"), _CORNER * own("range"))
        return -own("size") * excess / own("range")

    return at_port(
        port, f"stop_of_{x}_in_{port.variable}", law,
        gain="size",
        words=(
            f"a stop or an overflow holds {x} at a level",
            "contact with an elastic stop; softplus: Dugas et al., NIPS 13 (2000)",
            f"Q loses size (excess of {x} over +-level)/range",
            "flat tops at one level, and shocks or a lag where it is left",
        ),
        parameters=(
            Parameter(
                "size", 0.0, port.unit, (0.0, _STIFF * force),
                "force of the stop, as a rate, at one range beyond it", scale=force,
            ),
            level_of(0.8, (0.02, 2.0), size, state_unit(model, x)),
            _range(model, sizes, x),
        ),
        probe={"level": tuple(share * size for share in (0.5, 0.7, 0.85, 0.95))},
    )  # fmt: skip


def _hysteresis(model: Model, port: Port, sizes: Sizes, x: str) -> Attached:
    """Bouc and Wen's element along a state: z' = w (1 - bend |r|^n) - loss |w| sgn(r) |r|^n.

    w = x'/range and r = z, so that the loop's own way is one range where loss and bend are 1.
    """
    speed, force = _speed(model, x), sizes.rates[port.variable]
    rates = (p for p in ports_of(model) if p.kind == "rate" and p.variable == x)
    reads = () if speed else tuple(rates)

    def law(s: Symbols, own: Own) -> Terms:
        rate = getattr(s, speed) if speed else getattr(s, reads[0].balance)
        w, z = rate / own("range"), own("state")
        size = smooth_magnitude(w, _STILL * own("rate") / own("range"))
        power, signed = magnitude_power(z, own("n")), signed_power(z, own("n"))
        der = w * (1 - own("bend") * power) - own("loss") * size * signed
        return {"state": der}, -own("size") * z

    return at_port(
        port, f"hysteresis_of_{x}_in_{port.variable}", law,
        gain="size",
        words=(
            f"it depends on the way that {x} came",
            "Bouc and Wen's model of hysteresis (Wen, J. Eng. Mech. 102 (1976), 249)",
            f"Q loses size z,  z' = w (1 - bend |z|^n) - loss |w| sgn(z) |z|^n,  w = {x}'/range",
            "loops that stay open however slow the motion, and rest where it rests",
        ),
        parameters=(
            Parameter(
                "size", 0.0, port.unit, (-LARGEST * force, LARGEST * force),
                "slope of the loop's part, as a rate", scale=3 * ORDINARY * force,
            ),
            Parameter("loss", 1.0, "1", (1e-3, 1e3), "how fast the loop turns", log=True),
            Parameter("bend", 0.0, "1", (-500.0, 500.0), "how the loop bends", scale=0.3),
            Parameter("n", 1.0, "1", (0.2, 8.0), "sharpness of the loop's turns", log=True),
            _range(model, sizes, x),
            scale_of("rate", sizes.rates[x], rate_unit(state_unit(model, x)), f"rate of {x}"),
        ),
        states=(State("state", "1", "memory of the way", 0.5, memory=True, settles=False),),
        probe={"loss": (0.3, 1.0, 4.0, 16.0)},
        finite_step=_IN_FULL,
        reads=reads,
    )  # fmt: skip


def _range(model: Model, sizes: Sizes, x: str) -> Parameter:
    return scale_of("range", sizes.states[x], state_unit(model, x), x)


def effects_of(model: Model, sizes: Sizes) -> tuple[Attached, ...]:
    """Return every generic effect at every port of a model that has no effects yet."""
    found: list[Attached] = []
    for port in ports_of(model):
        if port.kind == "rate":
            found += rate_effects(model, port, sizes)
        else:
            found += signal_effects(port, sizes)
    return (*found, *parameter_effects(model, sizes))
