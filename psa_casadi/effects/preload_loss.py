"""Preload loss: on one side of a certain displacement a spring has lost contact.

With a positive gain the output meets the spring at x_c and beyond, and below there is a gap. With a
negative one the spring, which elsewhere stiffens k_B and scales k_L unseen, leaves it there: beyond
x_c its stiffness is missing, -k max(0, x_c - x) being -k (x_c - x) - k max(0, x - x_c). The spring
that is lost was part of the stack's stiffness, so that the gain stays above -1. A guide that is
stiffer on one side of a displacement than on the other bends the curve there in the same way.
"""

import casadi as ca

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.effects.sizes import static_stiffness, stroke
from psa_casadi.variables import Parameter

#: Width over which contact builds up, over the stroke.
_WIDTH = 5e-3


def _preload_loss(s: Symbols) -> Equations:
    """Preload loss: on one side of a certain displacement a spring has lost contact.

    With a positive gain the output meets the spring at x_c and beyond, and below there is a gap.
    With a negative one the spring, which elsewhere stiffens k_B and scales k_L unseen, leaves it
    there: beyond x_c its stiffness is missing, -k max(0, x_c - x) being -k (x_c - x) - k max(0, x -
    x_c). The spring that is lost was part of the stack's stiffness, so that the gain stays above
    -1. A guide that is stiffer on one side of a displacement than on the other bends the curve
    there in the same way.
    """
    full = stroke(s)
    depth = s.x - s.contact_position * full
    pressed = 0.5 * (depth + ca.sqrt(depth**2 + (_WIDTH * full) ** 2))
    return Equations(add={"tip_force": -s.contact_gain * static_stiffness(s) * pressed})


PRELOAD_LOSS = Component(
    name="preload_loss",
    description="a spring touches, or a guide changes its stiffness, at one displacement",
    source="unilateral contact (Signorini) with an elastic load: Johnson, Contact Mechanics, 1985",
    gain="contact_gain",
    equation_text=(
        "f_load gains -contact_gain k_s max(0, x - contact_position x_s), smooth over 0.5 % of"
        " x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k"
    ),
    parameters=(
        Parameter(
            "contact_gain",
            0.0,
            "1",
            (-0.8, 10.0),
            "spring's stiffness over the stack's",
            scale=0.05,
        ),
        Parameter(
            "contact_position",
            0.4,
            "1",
            (-0.5, 1.5),
            "displacement at which contact begins, over the stroke",
            scale=0.1,
        ),
    ),
    equations=_preload_loss,
    probe={"contact_position": (0.2, 0.4, 0.65)},
    remedy=Remedy("preload", "range"),
    looks_like="the slope changes abruptly at one displacement, the same on both branches",
)
