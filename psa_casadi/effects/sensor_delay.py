"""Sensor delay: the measured displacement arrives late by a fixed time."""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.scales import stroke_scale
from psa_casadi.smooth import pade_section
from psa_casadi.variables import Parameter, State

#: Smallest time constant of a section [s]; keeps it defined at zero delay.
_FLOOR = 1e-6


def _sensor_delay(s: Symbols) -> Equations:
    """Sensor delay: the measured displacement arrives late by a fixed time."""
    half = s.sensor_delay / 2
    a1, b1, first = pade_section(half, _FLOOR, s.displacement, s.z_d1, s.r_d1)
    a2, b2, second = pade_section(half, _FLOOR, first, s.z_d2, s.r_d2)
    return Equations(
        der={"z_d1": a1, "r_d1": b1, "z_d2": a2, "r_d2": b2},
        add={"measured_displacement": second - s.displacement},
    )


def _states(index: int) -> tuple[State, State]:
    return (
        State(
            f"z_d{index}",
            "m",
            f"filtered input of section {index}",
            stroke_scale,
            display_unit="um",
        ),
        State(
            f"r_d{index}",
            "m",
            "its rate times the section's delay",
            stroke_scale,
            display_unit="um",
        ),
    )


SENSOR_DELAY = Component(
    name="sensor_delay",
    description="the measured displacement arrives late by a fixed time",
    source="Pade approximation of exp(-s T), two second-order sections in series",
    belongs_to="sensor",
    gain="sensor_delay",
    finite_step=(0.0, 5.0, 20.0, 60.0),
    equation_text=(
        "x_m(t) = x(t - T), as P(s T/2)^2 with P(q) = (1 - q/2 + q^2/12)/(1 + q/2 + q^2/12)"
    ),
    parameters=(
        Parameter("sensor_delay", 0.0, "s", (0.0, 0.1), "delay of the sensor", "ms", scale=1e-4),
    ),
    states=(*_states(1), *_states(2)),
    equations=_sensor_delay,
    remedy=Remedy("align_clocks", "slew"),
    looks_like="phase linear in frequency; the residual follows the displacement's rate",
)
