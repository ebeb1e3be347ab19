"""Sensor delay: the measured displacement arrives late by a fixed time."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Parameter, State

#: Smallest time constant of the chain [s]; keeps it defined at zero delay.
_FLOOR = 1e-6


def _equations(s: Symbols) -> Equations:
    # each section delays by half: (1 - sT/4)/(1 + sT/4), written so that T = 0 is the identity
    section = s.sensor_delay / 4 + _FLOOR
    share = s.sensor_delay / 2 / section
    first = s.displacement - share * (s.displacement - s.z_d1)
    total = first - share * (first - s.z_d2)
    return Equations(
        der={"z_d1": (s.displacement - s.z_d1) / section, "z_d2": (first - s.z_d2) / section},
        add={"measured_displacement": total - s.displacement},
    )


SENSOR_DELAY = Component(
    name="sensor_delay",
    description="the measured displacement arrives late by a fixed time",
    source="Pade approximation of exp(-s T), two first-order sections in series",
    belongs_to="sensor",
    gain="sensor_delay",
    equation_text="x_m(t) = x(t - T), as ((1 - s T/4)/(1 + s T/4))^2",
    parameters=(
        Parameter("sensor_delay", 0.0, "s", (0.0, 0.1), "delay of the sensor", "ms", scale=1e-4),
    ),
    states=(
        State("z_d1", "m", "first section of the delay", stroke_scale, display_unit="um"),
        State("z_d2", "m", "second section of the delay", stroke_scale, display_unit="um"),
    ),
    equations=_equations,
    looks_like="phase linear in frequency; the residual follows the displacement's rate",
)
