"""Parameters and states that effects have alike."""

from typing import Any

from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Nominal, Parameter, State


def share(
    name: str, bounds: tuple[float, float], description: str, scale: Nominal, value: float = 0.0
) -> Parameter:
    """Return a parameter without a dimension; `scale` is the size of an ordinary change."""
    return Parameter(name, value, "1", bounds, description, scale=scale)


def positive(
    name: str,
    value: float,
    unit: str,
    bounds: tuple[float, float],
    description: str,
    *,
    limit: bool = False,
) -> Parameter:
    """Return a parameter that spans decades; `limit` as in `Parameter`."""
    return Parameter(name, value, unit, bounds, description, log=True, limit=limit)


def form(name: str, description: str) -> Parameter:
    """Return what chooses between two forms, 0 and 1; it is tried and not fitted."""
    return Parameter(name, 0.0, "1", (0.0, 1.0), description, fitted=False)


def motion(name: str, description: str, scale: Nominal = stroke_scale, **more: Any) -> State:
    """Return a displacement as a state; `more` as in `State`."""
    return State(name, "m", description, scale, display_unit="um", **more)
