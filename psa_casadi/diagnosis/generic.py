"""Effects of any model: what may be missing at its ports, and the table of all of them.

Every effect adds a term to a port's sum. At an input (drive), at an output (sensor), or within the
model, at an intermediate, the term makes the signal q another one: q is the input of the model, the
output before its sensor, the intermediate by its equation. Other effects are those in the rate of a
state or in an intermediate. Parameters, and gains of intermediates, may change with a state, an
input or time.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import rate_unit
from psa_casadi.model import ports, shapes
from psa_casadi.model.component import (
    Component,
    Equations,
    Expression,
    Kind,
    OnDemand,
    Remedy,
    Symbols,
)
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Port, parameter_ports, ports_of, true_sum, with_ports
from psa_casadi.model.variables import Parameter, State
from psa_casadi.simulation.sizes import Sizes

#: An ordinary size of an effect over what it acts on, and the largest that a fit may reach.
ORDINARY, LARGEST = 0.03, 10.0


#: What ends the kind of an effect in its name; the kind is the code of its remedy, too.
_KIND = re.compile("_(?:of|in)_")
#: What these do (`Component.kind`).
_DOES: dict[str, Kind] = {
    "lag": "lag", "delay": "lag", "bend": "curve", "saturation": "curve", "dead_zone": "curve",
    "zero": "time", "drift": "time", "constant": "time", "loss": "damping", "friction": "damping",
    "drag": "damping", "curve": "curve", "stop": "curve", "hysteresis": "hysteresis",
    "change": "changing gain", "gain": "gain", "backlash": "hysteresis",
}  # fmt: skip
#: Returns a parameter or a state of an effect by its short name.
SymbolOf = Callable[[str], Expression]
#: The derivatives of an effect's states, by short name, and its term.
Terms = tuple[dict[str, Expression], Expression]
#: The equations of an effect: (symbols, the effect's by short name) -> term, or both.
Law = Callable[[Symbols, SymbolOf], Terms | Expression]


@dataclass(frozen=True)
class Attached:
    """An effect, the port that it is at, and further ports whose sums it reads."""

    component: Component
    port: Port
    reads: tuple[Port, ...] = ()

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.component.name

    @property
    def ports(self) -> frozenset[Port]:
        """Every port that the model must have for it."""
        return frozenset((self.port, *self.reads))


def at_port(
    port: Port,
    name: str,
    law: Law,
    description: str,
    source: str,
    text: str,
    looks_like: str,
    *,
    parameters: tuple[Parameter, ...],
    gain: str = "size",
    states: tuple[State, ...] = (),
    probe: Mapping[str, tuple[float, ...]] | None = None,
    finite_step: tuple[float, ...] = (),
    belongs_to: str = "plant",
    signal: str = "q",
    reads: tuple[Port, ...] = (),
) -> Attached:
    """Return an effect that adds a term to a port's sum.

    Parameters and states have short names here; in the model the effect's name precedes them. A
    parameter `angle` is tried at `ANGLES`. In the `text` of the equation, Q denotes the port's sum
    and q the `signal`.
    """

    def equations(s: Symbols) -> Equations:
        result = law(s, lambda short: getattr(s, f"{name}_{short}"))
        der, term = result if isinstance(result, tuple) else ({}, result)
        return Equations(
            der={f"{name}_{short}": rate for short, rate in der.items()}, add={port.balance: term}
        )

    what = _KIND.split(name)[0]
    angles = {p.name: shapes.ANGLES for p in parameters if p.name == "angle"}
    component = Component(
        name=name,
        description=f"{port.words}: {description}",
        source=source,
        equations=equations,
        parameters=tuple(replace(p, name=f"{name}_{p.name}") for p in parameters),
        states=tuple(replace(q, name=f"{name}_{q.name}") for q in states),
        gain=f"{name}_{gain}",
        probe={f"{name}_{short}": grid for short, grid in (probe or angles).items()},
        finite_step=finite_step,
        equation_text=text.replace("Q", port.balance).replace("q", signal),
        looks_like=looks_like,
        kind=_DOES[what],
        belongs_to=belongs_to,
        remedy=Remedy(what, "record"),
    )
    return Attached(component, port, reads)


def of_ones_own(model: Model, component: Component) -> Attached:
    """Return an effect that a user wrote, with the ports of a model that its equations add to.

    Raises InputError for one without a gain, or that adds to no port.
    """
    places = (*ports_of(model), *parameter_ports(model))
    symbols, ports = OnDemand(), {p.balance: p for p in places}
    added = [ports[name] for name in component.equations(symbols).add if name in ports]
    if component.gain is None or not added:
        lacks = "adds to no port" if component.gain else "has no gain that removes it at 0"
        raise InputError(
            f"The effect '{component.name}' {lacks} of the model '{model.name}'; let its equations"
            f" add to one of {', '.join(ports)}, and name a parameter as its gain."
        )
    reads = tuple(p for name, p in ports.items() if name in symbols.made and p not in added)
    described = replace(component, description=f"{added[0].words}: {component.description}")
    return Attached(described, added[0], (*added[1:], *reads))


def extended(base: Model, effects: Iterable[Attached]) -> Model:
    """Return a model with effects, their gains 0, and sums at the ports that they need."""
    chosen = list(effects)
    ports = frozenset(p for e in chosen for p in e.ports)
    opened = with_ports(base, ports) if ports else base
    return opened.with_components((*opened.components, *(e.component for e in chosen)))


def size_at(port: Port, sizes: Sizes) -> float:
    """Return the largest magnitude of what a port adds to."""
    return (sizes.rates if port.kind == "rate" else sizes.signals)[port.variable]


def scale_of(name: str, value: float, unit: str, what: str) -> Parameter:
    """Return the parameter of a size that is not fitted: the equations divide by it."""
    words = f"largest {what} in the records, a scale only"
    return Parameter(name, rounded(value), unit, (0.0, float("inf")), words, fitted=False)


def rounded(size: float) -> float:
    """Return the size of a signal with two digits: no more is known of how large it can be."""
    return float(f"{size:.2g}")


def size_of(unit: str, size: float, what: str, *, positive: bool = False) -> Parameter:
    """Return the parameter that removes an effect at 0, in the unit of what it adds to."""
    most = LARGEST * size
    low = 0.0 if positive else -most
    return Parameter("size", 0.0, unit, (low, most), what, scale=ORDINARY * size)


#: Width of the rounded corner of a saturation or a dead zone, over the signal's size: usual, and
#: the least and the most that a fit may reach. A wider corner is a bend.
_ROUNDED, _SHARPEST, _ROUNDEST = 0.01, 1e-4, 0.1
#: Smallest time of a filter over the sampling interval: keeps it defined at a time of 0.
_FLOOR = 0.02

#: Steps of a time, in sampling intervals, at which lags and delays are looked for.
_STEPS = (0.0, 5.0, 20.0, 60.0)
#: The form of a curve.
ANGLE = Parameter(
    "angle", 0.0, "rad", (-2.0 * ca.pi, 2.0 * ca.pi), "form of the curve: 0 quadratic, pi/2 cubic",
    scale=0.3,
)  # fmt: skip
#: What a signal belongs to.
_PLACE = {"input": "drive", "output": "sensor", "intermediate": "plant"}
#: As `Law`, with the signal's value: (symbols, signal, effect's by short name) -> term, or both.
_Law = Callable[[Symbols, Expression, SymbolOf], Terms | Expression]


def signal_effects(port: Port, sizes: Sizes, *, imported: bool = False) -> tuple[Attached, ...]:
    """Return the effects of an input, an output or an intermediate.

    Those of an `imported` FMU have a gain, which parameters need not have there, and a backlash.
    """
    makers = [_lag, _delay, _bend, _saturation]
    makers += [_zero, _drift] if port.kind == "output" else [_dead_zone]
    makers += [_gain, _backlash] if imported else []
    return tuple(make(port, sizes) for make in makers)


def _size(port: Port, sizes: Sizes) -> float:
    return rounded(sizes.signals[port.variable])


def _made(port: Port, kind: str, law: _Law, *words: str, **more: Any) -> Attached:
    """Return an effect of a signal, which its `law` has too; see `at_port`."""
    signal = port.variable if port.kind == "input" else true_sum(port.variable)
    return at_port(
        port,
        f"{kind}_of_{port.variable}",
        lambda s, symbol: law(s, getattr(s, signal), symbol),
        *words,
        belongs_to=_PLACE[port.kind],
        signal=signal,
        **more,
    )


def _lag(port: Port, sizes: Sizes) -> Attached:
    def law(s: Symbols, q: Expression, symbol: SymbolOf) -> Terms:
        time, behind = symbol("time") + symbol("floor"), symbol("state") - q
        return {"state": -behind / time}, symbol("time") / time * behind

    return _made(
        port, "lag", law,
        "it follows through a lag of first order",
        "amplifier, valve or filter with one pole",
        "T Q' + Q = q",
        "the residual follows the signal's rate; the roll-off grows with frequency",
        gain="time",
        parameters=_times(sizes, "time constant"),
        states=(State("state", port.unit, "behind the lag", _size(port, sizes)),),
        finite_step=_STEPS,
    )  # fmt: skip


def _delay(port: Port, sizes: Sizes) -> Attached:
    def law(s: Symbols, q: Expression, symbol: SymbolOf) -> Terms:
        half, floor = symbol("time") / 2, symbol("floor")
        a1, b1, first = shapes.pade_section(half, floor, q, symbol("a1"), symbol("b1"))
        a2, b2, second = shapes.pade_section(half, floor, first, symbol("a2"), symbol("b2"))
        return {"a1": a1, "b1": b1, "a2": a2, "b2": b2}, second - q

    size = _size(port, sizes)
    return _made(
        port, "delay", law,
        "it arrives late by a fixed time",
        "Pade approximation of exp(-s T), two second-order sections in series",
        "Q(t) = q(t - T)",
        "phase linear in frequency at unchanged size",
        gain="time",
        parameters=_times(sizes, "delay"),
        states=tuple(
            State(name, port.unit, f"filter of section {name[1]}", size)
            for name in ("a1", "b1", "a2", "b2")
        ),
        finite_step=_STEPS,
    )  # fmt: skip


def _gain(port: Port, sizes: Sizes) -> Attached:
    return _made(
        port, "gain", lambda s, q, symbol: symbol("size") * q,
        "its gain is another one",
        "amplifier, scale of a sensor, a wrong unit",
        "Q = (1 + size) q",
        "a residual that is the signal's share, the same at every level and frequency",
        parameters=(
            Parameter("size", 0.0, "1", (-LARGEST, LARGEST), "change of the gain", scale=ORDINARY),
        ),
    )  # fmt: skip


def _backlash(port: Port, sizes: Sizes) -> Attached:
    size = _size(port, sizes)

    def law(s: Symbols, q: Expression, symbol: SymbolOf) -> Terms:
        behind = q - symbol("state")
        pushed = beyond(behind, symbol("width"), symbol("corner"))
        return {"state": pushed / symbol("floor")}, -symbol("gain") * behind

    words = "width over which the corner is rounded, a scale only"
    return _made(
        port, "backlash", law,
        "it follows with a backlash",
        "play of a joint; Krasnoselskii and Pokrovskii, Systems with Hysteresis, 1989",
        "Q = q - gain (q - z),  z follows q where it is further than width away",
        "loops of one width, however slow the signal, and flat tops at its turns",
        gain="gain",
        parameters=(
            Parameter("gain", 0.0, "1", (0.0, 1.0), "share that has the backlash", scale=0.1),
            Parameter(
                "width", 0.05 * size, port.unit, (1e-3 * size, 0.7 * size), "half the backlash",
                log=True,
            ),
            scale_of("corner", 2e-3 * size, port.unit, words),
            scale_of("floor", 0.2 * sizes.sample, "s", "time in which it is pushed"),
        ),
        states=(State("state", port.unit, "what follows", size, memory=True, settles=False),),
        probe={"width": tuple(share * size for share in (0.02, 0.06, 0.2))},
    )  # fmt: skip


def _bend(port: Port, sizes: Sizes) -> Attached:
    size = _size(port, sizes)
    return _made(
        port, "bend",
        lambda s, q, symbol: symbol("size") * bent(q / symbol("range"), symbol("angle")),
        "its gain depends on its level",
        "first two terms of a static curve beyond the straight line",
        "Q = q + size (cos(angle) r^2 + sin(angle) r^3),  r = q/range",
        "harmonics that grow with the level, the same at every frequency",
        parameters=(
            size_of(port.unit, size, "deviation from the line at the range's end"), ANGLE,
            scale_of("range", size, port.unit, port.variable),
        ),
    )  # fmt: skip


def _saturation(port: Port, sizes: Sizes) -> Attached:
    size = _size(port, sizes)
    return _made(
        port, "saturation",
        lambda s, q, symbol: -symbol("gain") * beyond(q, symbol("level"), symbol("corner")),
        "it goes no further than a level, to either side",
        "end stops, limited supply; softplus: Dugas et al., NIPS 13 (2000)",
        "Q = q - gain (excess of q over +-level);  gain = 1 is a hard stop",
        "flat tops at one level",
        gain="gain",
        parameters=(
            Parameter("gain", 0.0, "1", (0.0, 1.0), "share of the excess that is lost", scale=0.1),
            level_of(0.7, (0.05, 1.2), size, port.unit),
            _corner(size, port.unit),
        ),
        probe={"level": tuple(share * size for share in (0.4, 0.6, 0.75, 0.9))},
    )  # fmt: skip


def _dead_zone(port: Port, sizes: Sizes) -> Attached:
    size = _size(port, sizes)
    lost = "share of the small values that is lost"
    return _made(
        port, "dead_zone",
        lambda s, q, symbol: -symbol("gain") * (q - beyond(q, symbol("level"), symbol("corner"))),
        "small values of it do nothing",
        "overlap of a valve, stiction of an actuator",
        "Q = q - gain (q within +-level);  gain = 1 is a true dead zone",
        "nothing moves about zero, and all else is offset by the zone's width",
        gain="gain",
        parameters=(
            Parameter("gain", 0.0, "1", (0.0, 1.0), lost, scale=0.1),
            level_of(0.1, (2e-3, 0.9), size, port.unit),
            _corner(size, port.unit),
        ),
        probe={"level": tuple(share * size for share in (0.04, 0.1, 0.25))},
    )  # fmt: skip


def _zero(port: Port, sizes: Sizes) -> Attached:
    shift = replace(size_of(port.unit, _size(port, sizes), "shift of the zero"), name="shift")
    return _made(
        port, "zero", lambda s, q, symbol: symbol("shift"),
        "its zero is shifted",
        "sensor with an offset",
        "Q = q + shift",
        "a constant residual in all records",
        gain="shift",
        parameters=(shift,),
    )  # fmt: skip


def _drift(port: Port, sizes: Sizes) -> Attached:
    return _made(
        port, "drift", lambda s, q, symbol: symbol("size") * s.time / symbol("duration"),
        "its zero drifts with time",
        "sensor that warms up",
        "Q = q + size t/duration",
        "a residual that grows with time whatever the inputs do",
        parameters=(
            size_of(port.unit, _size(port, sizes), "drift over the duration"),
            scale_of("duration", sizes.duration, "s", "time"),
        ),
    )  # fmt: skip


def bent(part: Expression, angle: Expression) -> Expression:
    """Return cos(angle) part^2 + sin(angle) part^3: a bow at 0, an S at pi/2, and any mix."""
    return ca.cos(angle) * part**2 + ca.sin(angle) * part**3


def beyond(q: Expression, level: Expression, width: Expression) -> Expression:
    """Return by how much q is above +level or below -level, with corners rounded over a width."""
    above, below = (width * shapes.softplus((side * q - level) / width) for side in (1, -1))
    return above - below


def level_of(value: float, bounds: tuple[float, float], size: float, unit: str) -> Parameter:
    """Return the parameter of a level, from its value and bounds over the size of its signal."""
    low, high = (bound * size for bound in bounds)
    return Parameter("level", value * size, unit, (low, high), "level", scale=0.05 * size)


def _corner(size: float, unit: str) -> Parameter:
    bounds = (_SHARPEST * size, _ROUNDEST * size)
    words = "width over which the corner at the level is rounded"
    return Parameter("corner", _ROUNDED * size, unit, bounds, words, log=True, limit=True)


def _times(sizes: Sizes, what: str) -> tuple[Parameter, Parameter]:
    """Return a time that removes an effect at 0 [s], and what keeps its filter defined there."""
    floor, words = rounded(_FLOOR * sizes.sample), "smallest time of the filter, a scale only"
    return (
        Parameter("time", 0.0, "s", (0.0, 0.1 * sizes.duration), what, scale=sizes.sample),
        Parameter("floor", floor, "s", (0.0, float("inf")), words, fitted=False),
    )


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
        "a constant is missing",
        "weight, leak, offset of an input",
        "Q gains size",
        "a residual of the form of a step answer in every record",
        parameters=(at.size("constant part"),),
    )  # fmt: skip


def _loss(at: _Sum, v: str) -> Attached:
    return at_port(
        at.port, _name("loss", at.port, v),
        lambda s, symbol: -symbol("size") * getattr(s, v) / symbol("range"),
        f"it loses in proportion to {v}",
        "viscous damping, leak, cooling",
        f"Q loses size {v}/range",
        "resonances are lower, and decays faster, the same at every level",
        parameters=(at.size(f"loss at the largest {v}"), at.range(v)),
    )  # fmt: skip


def _friction(at: _Sum, v: str) -> Attached:
    size = rounded(at.sizes.signals[v])

    def law(s: Symbols, symbol: SymbolOf) -> Expression:
        state = getattr(s, v)
        return -symbol("size") * state / ca.sqrt(state**2 + symbol("width") ** 2)

    return at_port(
        at.port, _name("friction", at.port, v), law,
        "dry friction holds against the motion",
        "Coulomb's friction, smooth about rest",
        f"Q loses size {v}/sqrt({v}^2 + width^2)",
        "motion starts above a threshold only; small motions have the largest relative error",
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
        return -symbol("size") * part * shapes.smooth_magnitude(part, _STILL)

    return at_port(
        at.port, _name("drag", at.port, v), law,
        f"it loses with the square of {v}",
        "drag of a turbulent flow",
        f"Q loses size r |r|,  r = {v}/range",
        "damping that grows with the level",
        parameters=(at.size(f"loss at the largest {v}"), at.range(v)),
    )  # fmt: skip


def _curve(at: _Sum, x: str) -> Attached:
    return at_port(
        at.port, f"curve_of_{x}_in_{at.port.variable}",
        lambda s, symbol: symbol("size") * bent(getattr(s, x) / symbol("range"), symbol("angle")),
        f"it depends on {x} along a curve",
        "hardening or softening spring; first two terms beyond the straight line",
        f"Q gains size (cos(angle) r^2 + sin(angle) r^3),  r = {x}/range",
        "resonances move with the level; harmonics",
        parameters=(at.size("deviation from the line at the range's end"), ANGLE, at.range(x)),
    )  # fmt: skip


def _stop(at: _Sum, x: str) -> Attached:
    force, size = at.largest, rounded(at.sizes.signals[x])

    def law(s: Symbols, symbol: SymbolOf) -> Expression:
        excess = beyond(getattr(s, x), symbol("level"), _CORNER * symbol("range"))
        return -symbol("size") * excess / symbol("range")

    return at_port(
        at.port, f"stop_of_{x}_in_{at.port.variable}", law,
        f"a stop or an overflow holds {x} at a level",
        "contact with an elastic stop; softplus: Dugas et al., NIPS 13 (2000)",
        f"Q loses size (excess of {x} over +-level)/range",
        "flat tops at one level, and shocks or a lag where it is left",
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
        size = shapes.smooth_magnitude(w, _STILL * symbol("rate") / symbol("range"))
        power, signed = shapes.magnitude_power(z, symbol("n")), shapes.signed_power(z, symbol("n"))
        der = w * (1 - symbol("bend") * power) - symbol("loss") * size * signed
        return {"state": der}, -symbol("size") * z

    return at_port(
        at.port, f"hysteresis_of_{x}_in_{at.port.variable}", law,
        f"it depends on the way that {x} came",
        "Bouc and Wen's model of hysteresis (Wen, J. Eng. Mech. 102 (1976), 249)",
        f"Q loses size z,  z' = w (1 - bend |z|^n) - loss |w| sgn(z) |z|^n,  w = {x}'/range",
        "loops that stay open however slow the motion, and rest where it rests",
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
    states = [q.name for c in model.base for q in c.states]
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
        "it drifts: ageing, heat, wear" if x == "time" else f"it depends on {x}",
        "first two terms of its series",
        f"Q = {p} (1 + size (cos(angle) r + sin(angle) r^2)),  r = {x}/range",
        "the parameter's value changes with the level or time",
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
