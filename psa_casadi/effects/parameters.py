"""Parameters that effects have alike: 0 where nothing is, or over decades."""

from psa_casadi.variables import Nominal, Parameter


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
