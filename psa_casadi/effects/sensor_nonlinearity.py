"""Sensor nonlinearity: the reading is a bent function of the displacement.

A constant and a slope are the sensor's offset and its sensitivity, which a fit takes for the
stack's own; what remains of a smooth curve is a bow, an S and a W.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.effects.bend import ANGLES, BEND_TEXT, bend, shape_parameters
from psa_casadi.effects.sizes import stroke
from psa_casadi.variables import Parameter


def _sensor_nonlinearity(s: Symbols) -> Equations:
    """Sensor nonlinearity: the reading is a bent function of the displacement.

    A constant and a slope are the sensor's offset and its sensitivity, which a fit takes for the
    stack's own; what remains of a smooth curve is a bow, an S and a W.
    """
    full = stroke(s)
    curve = bend(s.displacement / full, s.nonlinearity_angle, s.nonlinearity_wave)
    return Equations(add={"measured_displacement": s.nonlinearity_gain * full * curve})


SENSOR_NONLINEARITY = Component(
    name="sensor_nonlinearity",
    description="the sensor's reading is a bent function of the displacement",
    source="linearity error of position sensors: Fleming, Sensors and Actuators A 190 (2013) 106",
    belongs_to="sensor",
    gain="nonlinearity_gain",
    equation_text=(
        "x_m = x + nonlinearity_gain stroke b(x/stroke),  stroke = k_L u_rated over the static"
        " stiffness,  " + BEND_TEXT.format("nonlinearity")
    ),
    parameters=(
        Parameter(
            "nonlinearity_gain",
            0.0,
            "1",
            (-0.5, 0.5),
            "bow and S over the stroke, beyond the best straight line",
            scale=0.002,
        ),
        *shape_parameters("nonlinearity"),
    ),
    equations=_sensor_nonlinearity,
    curve="displacement",
    probe={"nonlinearity_angle": ANGLES},
    remedy=Remedy("calibrate_sensor", "range"),
    looks_like="the residual is a function of the displacement alone, the same on both branches",
)
