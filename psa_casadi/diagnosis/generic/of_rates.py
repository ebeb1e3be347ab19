"""Effects in the rate of a state or an intermediate, and the table of all effects of a model.

Parameters, and gains of intermediates, may change with a state, an input or time.
"""

from dataclasses import dataclass, replace

import casadi as ca

from psa_casadi.common.units import rate_unit
from psa_casadi.diagnosis.generic.of_signals import (
    ANGLE,
    LARGEST,
    ORDINARY,
    Attached,
    SymbolOf,
    Terms,
    at_port,
    bent,
    beyond,
    level_of,
    rounded,
    scale_of,
    signal_effects,
    size_at,
    size_of,
)
from psa_casadi.model import ports
from psa_casadi.model.component import Expression, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.model.shapes import magnitude_power, signed_power, smooth_magnitude
from psa_casadi.model.variables import Parameter, State
from psa_casadi.simulation.sizes import Sizes

#: Ordinary sizes at which a memory is looked for: the derivative at 0 holds little information on
#: one that acts in full.
_IN_FULL = (0.0, 2.0, -2.0)
#: A rate below this share of its size has no direction.
_STILL = 1e-3
#: Stiffest stop, over the largest rate at one range beyond it; width of its corner over the range.
_STIFF, _CORNER = 1e4, 0.005
#: Usual and largest change of a parameter over its value.
_CHANGES, _MOST = 0.1, 5.0


@dataclass(frozen=True)
class _Sum:
    """The sum at a port of a model, with the sizes of its signals and rates."""

    model: Model
    port: ports.Port
    sizes: Sizes

    @property
    def largest(self) -> float:
        """The largest magnitude of what the port adds to."""
        return size_at(self.port, self.sizes)

    def size(self, what: str, *, positive: bool = False) -> Parameter:
        """Return the parameter that removes an effect at 0."""
        return size_of(self.port.unit, self.largest, what, positive=positive)

    def range(self, x: str) -> Parameter:
        """Return the scale of a signal."""
        return scale_of("range", self.sizes.signals[x], self.unit(x), x)

    def unit(self, x: str) -> str:
        """Return the unit of a signal."""
        return ports.unit_of(self.model, x)


def sum_effects(model: Model, port: ports.Port, sizes: Sizes) -> tuple[Attached, ...]:
    """Return what may be missing in the rate of a state, or in an intermediate.

    Losses in an intermediate depend on variables that are no coordinates, in a rate on its state.
    """
    at = _Sum(model, port, sizes)
    rate = [port.variable] if port.kind == "rate" else []
    variables = [n for n in ports.seen_by(model, port) if n not in model.input_names]
    ways = [n for n in variables if n not in rate and not _way(model, n)[1]]
    losing = rate or [n for n in variables if n not in ways]
    # a hysteresis works along coordinates, else along all variables
    return (
        _constant(at),
        *(make(at, n) for n in losing for make in (_loss, _friction, _drag)),
        *(make(at, n) for n in variables for make in (_curve, _stop)),
        *(_hysteresis(at, n) for n in ways or variables),
    )


def _way(model: Model, name: str) -> tuple[list[tuple[str, float]], tuple[ports.Port, ...]]:
    """Return how fast a state or a kinematic intermediate changes: a sum of symbols times numbers.

    And the rates among these. A coordinate has none: all are states.
    """
    rates = {p.variable: p for p in ports.ports_of(model) if p.kind == "rate"}
    parts = ports.kinematics(model).get(name, {name: 1.0})
    speeds = {q: ports.definition_of(model, q) for q in parts}
    reads = tuple(rates[q] for q, speed in speeds.items() if speed is None)
    return [(speeds[q] or rates[q].balance, factor) for q, factor in parts.items()], reads


def _name(kind: str, port: ports.Port, q: str) -> str:
    itself = port.kind == "rate" and q == port.variable
    return f"{kind}_in_{q}" if itself else f"{kind}_of_{q}_in_{port.variable}"


def _constant(at: _Sum) -> Attached:
    return at_port(
        at.port, f"constant_in_{at.port.variable}", lambda s, symbol: symbol("size"),
        words=(
            "a constant is missing",
            "weight, leak, offset of an input",
            "Q gains size",
            "a residual of the form of a step answer in every record",
        ),
        parameters=(at.size("constant part"),),
    )  # fmt: skip


def _loss(at: _Sum, v: str) -> Attached:
    return at_port(
        at.port, _name("loss", at.port, v),
        lambda s, symbol: -symbol("size") * getattr(s, v) / symbol("range"),
        words=(
            f"it loses in proportion to {v}",
            "viscous damping, leak, cooling",
            f"Q loses size {v}/range",
            "resonances are lower, and decays faster, at every level alike",
        ),
        parameters=(at.size(f"loss at the largest {v}"), at.range(v)),
    )  # fmt: skip


def _friction(at: _Sum, v: str) -> Attached:
    size = rounded(at.sizes.signals[v])

    def law(s: Symbols, symbol: SymbolOf) -> Expression:
        state = getattr(s, v)
        return -symbol("size") * state / ca.sqrt(state**2 + symbol("width") ** 2)

    return at_port(
        at.port, _name("friction", at.port, v), law,
        words=(
            "dry friction holds against the motion",
            "Coulomb's friction, smooth about rest",
            f"Q loses size {v}/sqrt({v}^2 + width^2)",
            "what stands still needs a push to move; small motions are missed most",
        ),
        parameters=(
            at.size("friction, as a rate", positive=at.port.kind == "rate"),
            Parameter(
                "width", 0.02 * size, at.unit(v), (5e-4 * size, 0.7 * size),
                f"{v} below which it fades", log=True, limit=True
            ),
        ),
        probe={"width": (0.01 * size, 0.05 * size)},
    )  # fmt: skip


def _drag(at: _Sum, v: str) -> Attached:
    def law(s: Symbols, symbol: SymbolOf) -> Expression:
        part = getattr(s, v) / symbol("range")
        return -symbol("size") * part * smooth_magnitude(part, _STILL)

    return at_port(
        at.port, _name("drag", at.port, v), law,
        words=(
            f"it loses with the square of {v}",
            "drag of a turbulent flow",
            f"Q loses size r |r|,  r = {v}/range",
            "damping that grows with the level",
        ),
        parameters=(at.size(f"loss at the largest {v}"), at.range(v)),
    )  # fmt: skip


def _curve(at: _Sum, x: str) -> Attached:
    return at_port(
        at.port, f"curve_of_{x}_in_{at.port.variable}",
        lambda s, symbol: symbol("size") * bent(getattr(s, x) / symbol("range"), symbol("angle")),
        words=(
            f"it depends on {x} along a curve",
            "hardening or softening spring; first two terms beyond the straight line",
            f"Q gains size (cos(angle) r^2 + sin(angle) r^3),  r = {x}/range",
            "resonances move with the level; harmonics",
        ),
        parameters=(at.size("deviation from the line at the range's end"), ANGLE, at.range(x)),
    )  # fmt: skip


def _stop(at: _Sum, x: str) -> Attached:
    force, size = at.largest, rounded(at.sizes.signals[x])

    def law(s: Symbols, symbol: SymbolOf) -> Expression:
        excess = beyond(getattr(s, x), symbol("level"), _CORNER * symbol("range"))
        return -symbol("size") * excess / symbol("range")

    return at_port(
        at.port, f"stop_of_{x}_in_{at.port.variable}", law,
        words=(
            f"a stop or an overflow holds {x} at a level",
            "contact with an elastic stop; softplus: Dugas et al., NIPS 13 (2000)",
            f"Q loses size (excess of {x} over +-level)/range",
            "flat tops at one level, and shocks or a lag where it is left",
        ),
        parameters=(
            Parameter(
                "size", 0.0, at.port.unit, (0.0, _STIFF * force),
                "force of the stop, as a rate, at one range beyond it", scale=force,
            ),
            level_of(0.8, (0.02, 2.0), size, at.unit(x)),
            at.range(x),
        ),
        probe={"level": tuple(share * size for share in (0.5, 0.7, 0.85, 0.95))},
    )  # fmt: skip


def _hysteresis(at: _Sum, x: str) -> Attached:
    """Bouc and Wen's element along a state: z' = w (1 - bend |r|^n) - loss |w| sgn(r) |r|^n.

    w = x'/range and r = z, so that the loop's way is one range where loss and bend are 1.
    """
    (parts, reads), force = _way(at.model, x), at.largest

    def law(s: Symbols, symbol: SymbolOf) -> Terms:
        rate = sum(factor * getattr(s, speed) for speed, factor in parts)
        w, z = rate / symbol("range"), symbol("state")
        size = smooth_magnitude(w, _STILL * symbol("rate") / symbol("range"))
        power, signed = magnitude_power(z, symbol("n")), signed_power(z, symbol("n"))
        der = w * (1 - symbol("bend") * power) - symbol("loss") * size * signed
        return {"state": der}, -symbol("size") * z

    return at_port(
        at.port, f"hysteresis_of_{x}_in_{at.port.variable}", law,
        words=(
            f"it depends on the way that {x} came",
            "Bouc and Wen's model of hysteresis (Wen, J. Eng. Mech. 102 (1976), 249)",
            f"Q loses size z,  z' = w (1 - bend |z|^n) - loss |w| sgn(z) |z|^n,  w = {x}'/range",
            "loops that stay open however slow the motion, and rest where it rests",
        ),
        parameters=(
            Parameter(
                "size", 0.0, at.port.unit, (-LARGEST * force, LARGEST * force),
                "slope of the loop's part, as a rate", scale=3 * ORDINARY * force,
            ),
            Parameter("loss", 1.0, "1", (1e-3, 1e3), "how fast the loop turns", log=True),
            Parameter("bend", 0.0, "1", (-500.0, 500.0), "how the loop bends", scale=0.3),
            Parameter("n", 1.0, "1", (0.2, 8.0), "sharpness of the loop's turns", log=True),
            at.range(x),
            scale_of("rate", at.sizes.rates[x], rate_unit(at.unit(x)), f"rate of {x}"),
        ),
        states=(State("state", "1", "memory of the way", 0.5, memory=True, settles=False),),
        probe={"loss": (0.3, 1.0, 4.0, 16.0)},
        finite_step=_IN_FULL,
        reads=reads,
    )  # fmt: skip


def changing(model: Model, sizes: Sizes) -> tuple[Attached, ...]:
    """Return how every parameter and intermediate may change with states, inputs and time."""
    states = [q.name for c in model.components if c.gain is None for q in c.states]
    known = {i.name: i.unit for i in model.structure.inputs}
    marked = [p for p in ports.ports_of(model) if p.kind == "intermediate"]
    attacheds: list[Attached] = []
    for port in (*ports.parameter_ports(model), *marked):
        attacheds += [_with(port, x, ports.unit_of(model, x), sizes.signals[x]) for x in states]
        attacheds += [_with(port, u, unit, sizes.signals[u]) for u, unit in known.items()]
        attacheds.append(_with(port, "time", "s", sizes.duration))
    return tuple(attacheds)


def _with(port: ports.Port, x: str, unit: str, size: float) -> Attached:
    p = port.variable if port.kind == "parameter" else ports.true_sum(port.variable)

    def law(s: Symbols, symbol: SymbolOf) -> Expression:
        part = getattr(s, x) / symbol("range")
        curve = ca.cos(symbol("angle")) * part + ca.sin(symbol("angle")) * part**2
        return symbol("size") * getattr(s, p) * curve

    return at_port(
        port, f"change_of_{port.variable}_with_{x}", law,
        words=(
            "it drifts: ageing, heat, wear" if x == "time" else f"it depends on {x}",
            "first two terms of its series",
            f"Q = {p} (1 + size (cos(angle) r + sin(angle) r^2)),  r = {x}/range",
            "what the parameter stands for is another one at another level or time",
        ),
        parameters=(
            Parameter(
                "size", 0.0, "1", (-_MOST, _MOST), "relative change at the range's end",
                scale=_CHANGES,
            ),
            replace(ANGLE, description="form of the curve: 0 straight, pi/2 quadratic"),
            scale_of("range", size, unit, x),
        ),
    )  # fmt: skip


def effects_of(model: Model, sizes: Sizes) -> tuple[Attached, ...]:
    """Return every generic effect at every port of a model that has no effects yet."""
    result, imported = list[Attached](), bool(model.structure.foreign)
    for port in ports.ports_of(model):
        if port.kind != "rate":
            result += signal_effects(port, sizes, imported=imported)
        if port.kind == "rate" or ports.is_place(model, port):
            result += sum_effects(model, port, sizes)
    return (*result, *changing(model, sizes))
