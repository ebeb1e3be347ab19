"""Voltage saturation: the amplifier puts out no more than a certain voltage.

What exceeds the level, softplus(d) = w ln(1 + exp(d/w)) with d = G v - clip_level u_rated, is taken
off: d below the level it vanishes (exactly so from 37 widths w on), above it is d, and the corner
is rounded over the width. Only the upper end clips: a stack is driven from zero upward.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.smooth import softplus
from psa_casadi.variables import Parameter

#: Width w of the rounded corner over rated voltage.
_WIDTH = 0.005


def _voltage_saturation(s: Symbols) -> Equations:
    """Voltage saturation: the amplifier puts out no more than a certain voltage.

    What exceeds the level, softplus(d) = w ln(1 + exp(d/w)) with d = G v - clip_level u_rated, is
    taken off: d below the level it vanishes (exactly so from 37 widths w on), above it is d, and
    the corner is rounded over the width. Only the upper end clips: a stack is driven from zero
    upward.
    """
    width = _WIDTH * s.u_rated
    excess = width * softplus((s.G * s.voltage - s.clip_level * s.u_rated) / width)
    return Equations(add={"drive_voltage": -s.clip_gain * excess})


VOLTAGE_SATURATION = Component(
    name="voltage_saturation",
    description="the amplifier's output voltage saturates at a level",
    source="output swing of amplifier data sheets; softplus: Dugas et al., NIPS 13 (2000)",
    belongs_to="drive",
    gain="clip_gain",
    equation_text=(
        "drive voltage = G v - clip_gain w ln(1 + exp((G v - clip_level u_rated)/w)),"
        "  w = 0.005 u_rated;  clip_gain = 1 is a hard clip"
    ),
    parameters=(
        Parameter(
            "clip_gain", 0.0, "1", (0.0, 1.0), "share of the excess voltage that is lost", scale=0.1
        ),
        Parameter(
            "clip_level", 0.6, "1", (0.3, 1.2), "level of the clip over rated voltage", scale=0.1
        ),
    ),
    equations=_voltage_saturation,
    probe={"clip_level": (0.7, 0.85, 0.95)},
    remedy=Remedy("stay_below_level", "range"),
    looks_like="the displacement has flat tops at one level of the voltage, however high it goes",
)
