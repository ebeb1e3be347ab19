"""The words of every model: parameters, states, inputs and outputs, named as FMI names them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal, NamedTuple

Values = Mapping[str, float]
Nominal = float | Callable[[Values], float]


@dataclass(frozen=True)
class Parameter:
    """A constant of the model that a user may tune between steps (FMI: parameter, tunable).

    `value` is the default in SI units, `bounds` the closed interval that is physically meaningful,
    `log`: the parameter spans decades and is searched on a logarithmic scale. `scale` is the size
    of an ordinary change in SI units, where the value itself may be zero. What is not `fitted` only
    sets a scale, or chooses between two forms; records never determine it. `limit`: the lower end
    of the bounds is a limiting form (a corner that is sharp, a filter of one pole): a value there
    is as good as any other.
    """

    name: str
    value: float
    unit: str
    bounds: tuple[float, float]
    description: str
    display_unit: str | None = None
    log: bool = False
    scale: Nominal | None = None
    fitted: bool = True
    limit: bool = False

    def typical(self, values: Values) -> float:
        """Return the size of an ordinary change: `scale`, else the magnitude of the value."""
        if self.scale is not None:
            return nominal_value(self.scale, values)
        size = abs(values.get(self.name, self.value))
        return size if size > 0 else 1.0


@dataclass(frozen=True)
class State:
    """A state (FMI: local, initial exact), continuous, or discrete where a component samples it.

    A state with `memory` remembers a history that the record does not show (hysteresis, creep): its
    deviation from rest at the start of a record is unknown and is estimated; all others of a stack
    start at rest. Those of any other model are all estimated, as deviations from `start`,
    unless the start is declared known. A memory that `settles` (creep) has an equilibrium; one
    that does not (hysteresis) rests at any value.
    `nominal` is the size the state usually has, a number or a function of the parameter values.
    Exact steps hold its error against `whole`, if it is not None: a stop element is a part of
    the voltage, and shows by a share of what the voltage does.
    """

    name: str
    unit: str
    description: str
    nominal: Nominal = 1.0
    start: float = 0.0
    display_unit: str | None = None
    memory: bool = False
    settles: bool = True
    whole: Nominal | None = None


@dataclass(frozen=True)
class Input:
    """A signal that the surroundings impose (FMI: input, continuous)."""

    name: str
    unit: str
    description: str
    start: float = 0.0
    nominal: Nominal = 1.0
    display_unit: str | None = None


@dataclass(frozen=True)
class Output:
    """A signal that the model reports (FMI: output, continuous, calculated)."""

    name: str
    unit: str
    description: str
    nominal: Nominal = 1.0
    display_unit: str | None = None


#: Half the width of a 95 % interval over the standard error.
NORMAL_95 = 1.959963984540054


class Interval(NamedTuple):
    """An estimate's 95 % confidence interval, in the unit of the parameter."""

    low: float
    high: float

    @classmethod
    def of(cls, parameter: Parameter, value: float, error: float) -> "Interval":
        """Return the interval of an estimate; one on a logarithmic scale lies within a factor."""
        half = NORMAL_95 * error
        if parameter.log and value > 0.0:
            factor = math.exp(min(half / value, 50.0))
            return cls(value / factor, value * factor)
        return cls(value - half, value + half)


@dataclass(frozen=True)
class Provenance:
    """Where a model's values come from: records, package version, what was free, how sure.

    `interrupted`: they are those of a search that did not come to its end. `hold` is what inputs do
    between the samples of the records.
    """

    identified_from: tuple[tuple[str, str], ...] = ()
    package_version: str = ""
    free: tuple[str, ...] = ()
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    force_scale: str = "assumed"
    notes: tuple[str, ...] = ()
    interrupted: bool = False
    hold: Literal["linear", "zero"] = "linear"


@dataclass(frozen=True)
class Publication:
    """Who made a model, which version it is, and on what terms it is passed on; "" if not stated.

    The terms are those of the model and its values. The C code of an exported model has others.
    """

    author: str = ""
    version: str = ""
    copyright: str = ""
    license: str = ""

    @property
    def stated(self) -> dict[str, str]:
        """The texts that are not empty, by the names of the fields."""
        return {name: text for name, text in asdict(self).items() if text}


def nominal_value(nominal: Nominal, values: Values) -> float:
    """Evaluate a nominal that may be a function of the parameter values."""
    value = nominal(values) if callable(nominal) else nominal
    return float(value) if value else 1.0
