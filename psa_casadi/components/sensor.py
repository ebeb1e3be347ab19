"""The displacement sensor: shows the displacement, plus whatever the sensor's effects add."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Output


def _sensor(s: Symbols) -> Equations:
    """The displacement sensor: shows the displacement, plus whatever the sensor's effects add."""
    return Equations(
        add={"measured_displacement": s.displacement},
        out={"measured_displacement": s.measured_displacement},
    )


SENSOR = Component(
    name="sensor",
    description="ideal displacement sensor",
    source="definition",
    equation_text="x_m = x",
    belongs_to="sensor",
    equations=_sensor,
    outputs=(
        Output(
            "measured_displacement", "m", "displacement as the sensor shows it", stroke_scale, "um"
        ),
    ),
)
