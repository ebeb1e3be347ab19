"""An effect with the ports that it needs, and the parameters that most effects have alike."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from psa_casadi.component import Component, Equations, Expression, Remedy, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Port, with_ports
from psa_casadi.variables import Parameter, State

#: An ordinary size of an effect over what it acts on, and the largest that a fit may reach.
ORDINARY, LARGEST = 0.03, 10.0


#: What ends the kind of an effect in its name; the kind is the code of its remedy, too.
_KIND = re.compile("_(?:of|in)_")
#: Returns a parameter or a state of an effect by its short name.
Own = Callable[[str], Expression]
#: The equations of an effect: (symbols, its own by short name) -> derivatives, term.
Law = Callable[[Symbols, Own], tuple[dict[str, Expression], Expression]]


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
    gain: str,
    words: tuple[str, str, str, str],
    parameters: tuple[Parameter, ...],
    states: tuple[State, ...] = (),
    probe: Mapping[str, tuple[float, ...]] | None = None,
    finite_step: tuple[float, ...] = (),
    belongs_to: str = "plant",
    signal: str = "q",
    reads: tuple[Port, ...] = (),
) -> Attached:
    """Return an effect that adds a term to a port's sum; its parameters begin with its name.

    `words` are description, source, equation and what it looks like; in the equation, Q stands for
    the port's sum and q for the `signal`.
    """

    def equations(s: Symbols) -> Equations:
        der, term = law(s, lambda short: getattr(s, f"{name}_{short}"))
        return Equations(
            der={f"{name}_{short}": rate for short, rate in der.items()},
            add={port.balance: term},
        )

    description, source, text, looks = words
    component = Component(
        name=name,
        description=f"{port.words}: {description}",
        source=source,
        equations=equations,
        parameters=parameters,
        states=states,
        gain=f"{name}_{gain}",
        probe={f"{name}_{short}": grid for short, grid in (probe or {}).items()},
        finite_step=finite_step,
        equation_text=text.replace("Q", port.balance).replace("q", signal),
        looks_like=looks,
        belongs_to=belongs_to,
        remedy=Remedy(_KIND.split(name)[0], "record"),
    )
    return Attached(component, port, reads)


def extended(base: Model, effects: Iterable[Attached]) -> Model:
    """Return a model with effects, their gains 0, and sums at the ports that they need."""
    chosen = list(effects)
    ports = frozenset(p for e in chosen for p in e.ports)
    opened = with_ports(base, ports) if ports else base
    return opened.with_components((*opened.components, *(e.component for e in chosen)))


def scale_of(name: str, value: float, unit: str, what: str) -> Parameter:
    """Return the parameter of a size that is not fitted: the equations divide by it."""
    words = f"largest {what} in the records, a scale only"
    return Parameter(name, rounded(value), unit, (0.0, float("inf")), words, fitted=False)


def rounded(size: float) -> float:
    """Return the size of a signal with two digits: no more is known of how large it can be."""
    return float(f"{size:.2g}")


def gain_of(name: str, unit: str, size: float, what: str, *, positive: bool = False) -> Parameter:
    """Return the parameter that removes an effect at 0, in the unit of what it adds to."""
    most = LARGEST * size
    low = 0.0 if positive else -most
    return Parameter(name, 0.0, unit, (low, most), what, scale=ORDINARY * size)


def plain_gain(name: str, what: str) -> Parameter:
    """Return a gain from 0 (absent) to 1 (in full)."""
    return Parameter(name, 0.0, "1", (0.0, 1.0), what, scale=0.1)


def time_of(name: str, sample: float, duration: float, what: str) -> Parameter:
    """Return a time that removes an effect at 0 [s]; an ordinary one is a sampling interval."""
    return Parameter(name, 0.0, "s", (0.0, 0.1 * duration), what, scale=sample)


#: Steps of a time, in sampling intervals, at which lags and delays are looked for.
TIME_STEPS = (0.0, 5.0, 20.0, 60.0)
