"""Where fitted parameters lie in their ranges."""

from collections.abc import Mapping

from psa_casadi.component import Component


def inside_ranges(values: Mapping[str, float], cause: Component) -> bool:
    """Whether no parameter of a cause but its gain was pushed to the end of its range.

    One whose lower end is a limit of the law may be there.
    """
    for p in cause.parameters:
        if not p.fitted or p.name == cause.gain:
            continue
        low, high = (0.0, p.bounds[1]) if p.limit else p.bounds
        margin = 1e-3 * (high - low) if not p.log else 0.0
        value = values[p.name]
        if p.log and (value < 1.01 * low or value > high / 1.01):
            return False
        if not p.log and (value <= low + margin or value >= high - margin):
            return False
    return True
