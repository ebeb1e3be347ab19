"""Sensors beside the one of the displacement: each is an output with a scale of its own.

They change nothing of a stack. A model has them where a record has such a column: the scale is
fitted, and a monitor stays in the exported model as an output.
"""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import stroke_scale, voltage_scale
from psa_casadi.variables import Output, Parameter, Values


def _monitor(s: Symbols) -> Equations:
    return Equations(out={"monitor_voltage": s.monitor_scale * s.u})


def _second(s: Symbols) -> Equations:
    return Equations(out={"displacement_2": s.sensor_2_scale * s.displacement})


def _gauge(s: Symbols) -> Equations:
    return Equations(out={"strain": s.strain_scale * s.displacement})


def _monitored(p: Values) -> float:
    return abs(p["monitor_scale"]) * voltage_scale(p) or 1.0


def _strained(p: Values) -> float:
    return abs(p["strain_scale"]) * stroke_scale(p) or 1e-3


MONITOR = Component(
    name="monitor",
    description="monitor of the voltage that the amplifier puts on the stack",
    source="monitor outputs of piezo amplifiers, a share of the output voltage",
    belongs_to="drive",
    equations=_monitor,
    equation_text="v_mon = monitor_scale u",
    parameters=(
        Parameter(
            "monitor_scale", 1.0, "1", (-1e6, 1e6), "monitor per volt at the stack, over the gain"
        ),
    ),
    outputs=(
        Output("monitor_voltage", "V", "voltage that the amplifier's monitor shows", _monitored),
    ),
)

SECOND_SENSOR = Component(
    name="second_sensor",
    description="a second displacement sensor, straight, with a scale of its own",
    source="definition",
    belongs_to="sensor",
    equations=_second,
    equation_text="x_2 = sensor_2_scale x",
    parameters=(
        Parameter("sensor_2_scale", 1.0, "1", (-1e6, 1e6), "second reading over displacement"),
    ),
    outputs=(
        Output(
            "displacement_2", "m", "displacement as the second sensor shows it", stroke_scale, "um"
        ),
    ),
)

STRAIN_GAUGE = Component(
    name="strain_gauge",
    description="a strain gauge on the stack, straight, with a scale of its own",
    source="definition",
    belongs_to="sensor",
    equations=_gauge,
    equation_text="strain = strain_scale x",
    parameters=(
        Parameter("strain_scale", 50.0, "1/m", (-1e9, 1e9), "strain per displacement", scale=50.0),
    ),
    outputs=(Output("strain", "1", "strain that the gauge shows", _strained),),
)
