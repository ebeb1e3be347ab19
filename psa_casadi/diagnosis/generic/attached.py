"""An effect with the ports that it needs, and the parameters that most effects share."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from psa_casadi.common.errors import InputError
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
from psa_casadi.model.ports import Port, parameter_ports, ports_of, with_ports
from psa_casadi.model.shapes import ANGLES
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
    *,
    words: tuple[str, str, str, str],
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
    parameter `angle` is tried at `ANGLES`. `words` are description, source, equation and what it
    looks like; in the equation, Q denotes the port's sum and q the `signal`.
    """

    def equations(s: Symbols) -> Equations:
        result = law(s, lambda short: getattr(s, f"{name}_{short}"))
        der, term = result if isinstance(result, tuple) else ({}, result)
        return Equations(
            der={f"{name}_{short}": rate for short, rate in der.items()},
            add={port.balance: term},
        )

    description, source, text, looks = words
    what = _KIND.split(name)[0]
    angles = {p.name: ANGLES for p in parameters if p.name == "angle"}
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
        looks_like=looks,
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
