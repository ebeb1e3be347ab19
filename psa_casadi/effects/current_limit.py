"""Current limit: the amplifier delivers no more than a certain current; steps become ramps."""

import casadi as ca

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.variables import Parameter, Values

#: Even exponent of the smooth clip; the larger, the sharper the corner.
_SHARPNESS = 8
#: Limits that are tried, as shares of the gain's scale: so close that one of them cuts only the
#: fastest steps, and leaves the others alone.
_TRIED = tuple(0.1 * 1.5**k for k in range(15))


def _current_limit(s: Symbols) -> Equations:
    """Current limit: the amplifier delivers no more than a certain current; steps become ramps."""
    # i / (1 + (g i)^m)^(1/m) without overflow for large g i
    magnitude = ca.sqrt((s.inverse_current_limit * s.drive_current) ** 2 + 1e-30)
    larger = ca.fmax(1.0, magnitude)
    norm = larger * ((1 / larger) ** _SHARPNESS + (magnitude / larger) ** _SHARPNESS) ** (
        1 / _SHARPNESS
    )
    return Equations(add={"stack_current": s.drive_current * (1 / norm - 1)})


def _scale(p: Values) -> float:
    """One over the current of a full swing in 10 ms."""
    return 1e-2 / (p["C_p"] * abs(p["u_rated"]))


CURRENT_LIMIT = Component(
    name="current_limit",
    description="the amplifier delivers at most a certain current",
    source="amplifier data sheets; C_p u' = sat(i, i_max)",
    belongs_to="drive",
    gain="inverse_current_limit",
    finite_step=_TRIED,
    equation_text="C_p u' = i / (1 + |i/i_max|^8)^(1/8),  inverse_current_limit = 1/i_max",
    parameters=(
        Parameter(
            "inverse_current_limit", 0.0, "1/A", (0.0, 1e9), "one over the limit", scale=_scale
        ),
    ),
    equations=_current_limit,
    remedy=Remedy("more_current", "slew"),
    looks_like="steps become ramps; the rate of the displacement is capped at one value",
)
