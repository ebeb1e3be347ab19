"""What a design maximises: its value for a voltage, and a function with the same gradient there.

The value involves a re-fit or a covariance, whose derivative by the voltage would need second
derivatives of the trajectories. At one voltage everything but the trajectories can be held: by the
envelope theorem the derivative of a minimum is that of the function at the minimising point, and
the derivative of a function of the information matrix is linear in that of the sensitivities.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from psa_casadi.records.record import Record


@dataclass(frozen=True, eq=False)
class Point:
    """A criterion at one voltage: its value, and a function of the voltage with its gradient."""

    value: float
    frozen: Callable[[Record], float]


class Criterion(Protocol):
    """What is maximised."""

    def at(self, record: Record) -> Point:
        """Return value and frozen function at a planned record; raises PsaError."""
        ...
