"""What the amplifier can do: limits of voltage, voltage rate and current."""

from dataclasses import dataclass
from math import inf

from psa_casadi.errors import Problems


@dataclass(frozen=True)
class AmplifierLimits:
    """Bounds of the voltage command [V], of its rate [V/s], and of the stack's current [A].

    Raises InputError if no voltage can obey them.
    """

    min_voltage: float = -inf
    max_voltage: float = inf
    max_rate: float = inf
    max_current: float = inf

    def __post_init__(self) -> None:
        problems = Problems()
        if not self.min_voltage < self.max_voltage:
            problems.add(
                f"The lowest voltage, {self.min_voltage:g} V, is not below the highest,"
                f" {self.max_voltage:g} V; correct one of them."
            )
        for name, value, unit in (
            ("rate", self.max_rate, "V/s"),
            ("current", self.max_current, "A"),
        ):
            if not value > 0.0:
                problems.add(f"The largest {name} is {value:g} {unit}; give a positive one.")
        problems.raise_if_any()
