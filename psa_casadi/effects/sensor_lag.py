"""Sensor lag: the sensor's electronics follow the displacement with a time constant."""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Parameter, State

#: Added to the time constant [s]; keeps the filter defined at zero lag. What the sensor gains is
#: (1 + s floor)/(1 + s (T + floor)), the identity at T = 0.
_FLOOR = 1e-6


def _sensor_lag(s: Symbols) -> Equations:
    """Sensor lag: the sensor's electronics follow the displacement with a time constant."""
    time = s.sensor_lag_time + _FLOOR
    behind = s.sensor_lag_displacement - s.displacement
    return Equations(
        der={"sensor_lag_displacement": -behind / time},
        add={"measured_displacement": s.sensor_lag_time / time * behind},
    )


SENSOR_LAG = Component(
    name="sensor_lag",
    description="the sensor follows the displacement with a time constant",
    source="bandwidth of position sensors: Fleming, Sensors and Actuators A 190 (2013) 106",
    belongs_to="sensor",
    gain="sensor_lag_time",
    finite_step=(0.0, 5.0, 20.0, 60.0),
    equation_text="sensor_lag_time x_m' + x_m = x",
    parameters=(
        Parameter(
            "sensor_lag_time", 0.0, "s", (0.0, 0.1), "time constant of the sensor", "ms", scale=1e-4
        ),
    ),
    states=(
        State(
            "sensor_lag_displacement",
            "m",
            "displacement behind the lag",
            stroke_scale,
            display_unit="um",
        ),
    ),
    equations=_sensor_lag,
    remedy=Remedy("faster_sensor", "slew"),
    looks_like="phase of a first-order lag, which saturates at 90 degrees, and roll-off with it",
)
