"""A bent curve over the displacement, of a size and a form that a fit can turn without a stop.

    b(q) = cos(a) B(q) + sin(a) S(q) + w W(q)

    B = 6 q^2,  S = 20 q^3 - 30 q^2,  W = 70 q^4 - 140 q^3 + 90 q^2

are the second to fourth Legendre polynomials on 0 <= q <= 1 without constant and slope, which a
fit of the stack takes for its own (offset and sensitivity, a linear load). So a is the angle
between a bow (0) and an S about the middle (pi/2), and any cubic is a size and an angle: ratios
of coefficients would have to pass through infinity on the way from one sign to the other.
"""

from math import pi

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.variables import Parameter

#: Angles from which fits start; sizes of either sign make the circle whole.
ANGLES = (0.0, 0.25 * pi, 0.5 * pi, 0.75 * pi)
#: How the reports write the curve.
BEND_TEXT = (
    "b(q) = cos({0}_angle) 6 q^2 + sin({0}_angle) (20 q^3 - 30 q^2)"
    " + {0}_wave (70 q^4 - 140 q^3 + 90 q^2)"
)


def bend(q: Expression, angle: Expression, wave: Expression) -> Expression:
    """Return b(q) [1] for a displacement over the stroke, the angle [rad] and the W part [1]."""
    bow, s, w = 6 * q**2, q**2 * (20 * q - 30), q**2 * (70 * q**2 - 140 * q + 90)
    return ca.cos(angle) * bow + ca.sin(angle) * s + wave * w


def shape_parameters(prefix: str) -> tuple[Parameter, Parameter]:
    """Return the two parameters of the curve's form, `prefix`_angle and `prefix`_wave."""
    return (
        Parameter(
            f"{prefix}_angle",
            0.0,
            "rad",
            (-2.0 * pi, 2.0 * pi),
            "form of the bend: 0 a bow, pi/2 an S about half the stroke",
            scale=0.3,
        ),
        Parameter(
            f"{prefix}_wave", 0.0, "1", (-20.0, 20.0), "quartic (W) part over bow and S", scale=0.1
        ),
    )
