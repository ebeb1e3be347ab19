"""Sensor nonlinearity: the reading is a bent function of the displacement.

A constant and a slope are the sensor's offset and its sensitivity, which a fit takes for the
stack's own; what remains of a smooth curve is its quadratic, its cubic and its quartic part. With
the quadratic alone it is a bow; with nonlinearity_cubic = -2/3 it is an S about the middle of the
stroke; an S about another place needs the quartic too.
"""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.effects.sizes import stroke
from psa_casadi.variables import Parameter


def _equations(s: Symbols) -> Equations:
    full = stroke(s)
    q = s.displacement / full
    bend = q**2 * (1 + s.nonlinearity_cubic * q + s.nonlinearity_quartic * q**2)
    return Equations(add={"measured_displacement": s.nonlinearity_gain * full * bend})


SENSOR_NONLINEARITY = Component(
    name="sensor_nonlinearity",
    description="the sensor's reading is a bent function of the displacement",
    source="linearity error of position sensors: Fleming, Sensors and Actuators A 190 (2013) 106",
    belongs_to="sensor",
    gain="nonlinearity_gain",
    equation_text=(
        "x_m = x + nonlinearity_gain stroke (q^2 + nonlinearity_cubic q^3 + nonlinearity_quartic"
        " q^4),  q = x/stroke,  stroke = k_L u_rated over the static stiffness"
    ),
    parameters=(
        Parameter(
            "nonlinearity_gain", 0.0, "1", (-0.5, 0.5), "quadratic part over stroke", scale=0.01
        ),
        Parameter(
            "nonlinearity_cubic", 0.0, "1", (-10.0, 10.0), "cubic over quadratic part", scale=0.5
        ),
        Parameter(
            "nonlinearity_quartic", 0.0, "1", (-10.0, 10.0), "quartic over quadratic", scale=0.5
        ),
    ),
    equations=_equations,
    probe={"nonlinearity_cubic": (-0.7, 0.0)},
    looks_like="the residual is a function of the displacement alone, the same on both branches",
)
