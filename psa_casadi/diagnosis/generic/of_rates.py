"""Effects in the rate of a state or an intermediate, and the table of all effects of a model."""

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
    size_at,
    size_of,
)
from psa_casadi.diagnosis.generic.of_parameters import changing
from psa_casadi.diagnosis.generic.of_signals import ANGLE, bent, beyond, level_of, signal_effects
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import (
    Port,
    definition_of,
    is_place,
    kinematics,
    ports_of,
    seen_by,
    unit_of,
)
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


def sum_effects(model: Model, port: Port, sizes: Sizes) -> tuple[Attached, ...]:
    """Return what may be missing in the rate of a state, or in an intermediate.

    Of an intermediate, what is no coordinate may be lost by; a rate is lost by its own state.
    """
    item = [port.variable] if port.kind == "rate" else []
    items = [n for n in seen_by(model, port) if n not in model.input_names]
    ways = [n for n in items if n not in item and not _way(model, n)[1]]
    losing = item or [n for n in items if n not in ways]
    # a hysteresis works along coordinates, else along all that is seen
    return (
        _constant(model, port, sizes),
        *(make(model, port, sizes, n) for n in losing for make in (_loss, _friction, _drag)),
        *(make(model, port, sizes, n) for n in items for make in (_curve, _stop)),
        *(_hysteresis(model, port, sizes, n) for n in ways or items),
    )


def _way(model: Model, name: str) -> tuple[list[tuple[str, float]], tuple[Port, ...]]:
    """Return how fast a state or a kinematic intermediate changes: a sum of symbols times numbers.

    And the rates among these. A coordinate has none: all are states.
    """
    ports = {p.variable: p for p in ports_of(model) if p.kind == "rate"}
    parts = kinematics(model).get(name, {name: 1.0})
    speeds = {q: definition_of(model, q) for q in parts}
    reads = tuple(ports[q] for q, speed in speeds.items() if speed is None)
    return [(speeds[q] or ports[q].balance, factor) for q, factor in parts.items()], reads


def _name(kind: str, port: Port, q: str) -> str:
    item = port.kind == "rate" and q == port.variable
    return f"{kind}_in_{q}" if item else f"{kind}_of_{q}_in_{port.variable}"


def _constant(_: Model, port: Port, sizes: Sizes) -> Attached:
    return at_port(
        port, f"constant_in_{port.variable}", lambda s, item: item("size"),
        gain="size",
        words=(
            "a constant is missing",
            "weight, leak, offset of an input",
            "Q gains size",
            "a residual of the form of a step answer in every record",
        ),
        parameters=(size_of(port.unit, size_at(port, sizes), "constant part"),),
    )  # fmt: skip


def _loss(model: Model, port: Port, sizes: Sizes, v: str) -> Attached:
    return at_port(
        port, _name("loss", port, v), lambda s, item: -item("size") * getattr(s, v) / item("range"),
        gain="size",
        words=(
            f"it loses in proportion to {v}",
            "viscous damping, leak, cooling",
            f"Q loses size {v}/range",
            "resonances are lower, and decays faster, at every level alike",
        ),
        parameters=(
            size_of(port.unit, size_at(port, sizes), f"loss at the largest {v}"),
            _range(model, sizes, v),
        ),
    )  # fmt: skip


def _friction(model: Model, port: Port, sizes: Sizes, v: str) -> Attached:
    size = rounded(sizes.signals[v])

    def law(s: Symbols, item: Own) -> Expression:
        state = getattr(s, v)
        return -item("size") * state / ca.sqrt(state**2 + item("width") ** 2)

    return at_port(
        port, _name("friction", port, v), law,
        gain="size",
        words=(
            "dry friction holds against the motion",
            "Coulomb's friction, smooth about rest",
            f"Q loses size {v}/sqrt({v}^2 + width^2)",
            "what stands still needs a push to move; small motions are missed most",
        ),
        parameters=(
            size_of(
                port.unit, size_at(port, sizes), "friction, as a rate", positive=port.kind == "rate"
            ),
            Parameter(
                "width", 0.02 * size, unit_of(model, v), (5e-4 * size, 0.7 * size),
                f"{v} below which it fades", log=True, limit=True
            ),
        ),
        probe={"width": (0.01 * size, 0.05 * size)},
    )  # fmt: skip


def _drag(model: Model, port: Port, sizes: Sizes, v: str) -> Attached:
    def law(s: Symbols, item: Own) -> Expression:
        part = getattr(s, v) / item("range")
        return -item("size") * part * smooth_magnitude(part, _STILL)

    return at_port(
        port, _name("drag", port, v), law,
        gain="size",
        words=(
            f"it loses with the square of {v}",
            "drag of a turbulent flow",
            f"Q loses size r |r|,  r = {v}/range",
            "damping that grows with the level",
        ),
        parameters=(
            size_of(port.unit, size_at(port, sizes), f"loss at the largest {v}"),
            _range(model, sizes, v),
        ),
    )  # fmt: skip


def _curve(model: Model, port: Port, sizes: Sizes, x: str) -> Attached:
    return at_port(
        port, f"curve_of_{x}_in_{port.variable}",
        lambda s, item: item("size") * bent(getattr(s, x) / item("range"), item("angle")),
        gain="size",
        words=(
            f"it depends on {x} along a curve",
            "hardening or softening spring; first two terms beyond the straight line",
            f"Q gains size (cos(angle) r^2 + sin(angle) r^3),  r = {x}/range",
            "resonances move with the level; harmonics",
        ),
        parameters=(
            size_of(port.unit, size_at(port, sizes), "deviation from the line at the range's end"),
            ANGLE,
            _range(model, sizes, x),
        ),
        probe={"angle": ANGLES},
    )  # fmt: skip


def _stop(model: Model, port: Port, sizes: Sizes, x: str) -> Attached:
    force, size = size_at(port, sizes), rounded(sizes.signals[x])

    def law(s: Symbols, item: Own) -> Expression:
        excess = beyond(getattr(s, x), item("level"), _CORNER * item("range"))
        return -item("size") * excess / item("range")

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
            level_of(0.8, (0.02, 2.0), size, unit_of(model, x)),
            _range(model, sizes, x),
        ),
        probe={"level": tuple(share * size for share in (0.5, 0.7, 0.85, 0.95))},
    )  # fmt: skip


def _hysteresis(model: Model, port: Port, sizes: Sizes, x: str) -> Attached:
    """Bouc and Wen's element along a state: z' = w (1 - bend |r|^n) - loss |w| sgn(r) |r|^n.

    w = x'/range and r = z, so that the loop's own way is one range where loss and bend are 1.
    """
    (parts, reads), force = _way(model, x), size_at(port, sizes)

    def law(s: Symbols, item: Own) -> Terms:
        rate = sum(factor * getattr(s, speed) for speed, factor in parts)
        w, z = rate / item("range"), item("state")
        size = smooth_magnitude(w, _STILL * item("rate") / item("range"))
        power, signed = magnitude_power(z, item("n")), signed_power(z, item("n"))
        der = w * (1 - item("bend") * power) - item("loss") * size * signed
        return {"state": der}, -item("size") * z

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
            scale_of("rate", sizes.rates[x], rate_unit(unit_of(model, x)), f"rate of {x}"),
        ),
        states=(State("state", "1", "memory of the way", 0.5, memory=True, settles=False),),
        probe={"loss": (0.3, 1.0, 4.0, 16.0)},
        finite_step=_IN_FULL,
        reads=reads,
    )  # fmt: skip


def _range(model: Model, sizes: Sizes, x: str) -> Parameter:
    return scale_of("range", sizes.signals[x], unit_of(model, x), x)


def effects_of(model: Model, sizes: Sizes) -> tuple[Attached, ...]:
    """Return every generic effect at every port of a model that has no effects yet."""
    result, imported = list[Attached](), bool(model.structure.foreign)
    for port in ports_of(model):
        if port.kind != "rate":
            result += signal_effects(port, sizes, imported=imported)
        if port.kind == "rate" or is_place(model, port):
            result += sum_effects(model, port, sizes)
    return (*result, *changing(model, sizes))
