"""Further outputs of a stack: more sensors, and the validity of the records.

They change nothing of a stack. A model has a sensor where a record has such a column: the scale is
fitted, and a monitor stays in the exported model as an output. The validity is how far a run
leaves the ranges of the records behind a model, 0 inside.
"""

from functools import partial

import casadi as ca

from psa_casadi.model.component import Component, Equations, Expression, Symbols, component
from psa_casadi.model.shapes import stroke_scale, voltage_scale
from psa_casadi.model.variables import Output, Parameter, Values


def _monitored(p: Values) -> float:
    return abs(p["monitor_scale"]) * voltage_scale(p) or 1.0


def _strained(p: Values) -> float:
    return abs(p["strain_scale"]) * stroke_scale(p) or 1e-3


@component(
    Parameter(
        "monitor_scale", 1.0, "1", (-1e6, 1e6), "monitor per volt at the stack, over the gain"
    ),
    Output("monitor_voltage", "V", "voltage that the amplifier's monitor shows", _monitored),
    description="monitor of the voltage that the amplifier puts on the stack",
    source="monitor outputs of piezo amplifiers, a share of the output voltage",
    belongs_to="drive",
    equation_text="v_mon = monitor_scale u",
)
def monitor(s: Symbols) -> Equations:
    """Monitor of the voltage that the amplifier puts on the stack."""
    return Equations(out={"monitor_voltage": s.monitor_scale * s.u})


@component(
    Parameter("sensor_2_scale", 1.0, "1", (-1e6, 1e6), "second reading over displacement"),
    Output("displacement_2", "m", "displacement as the second sensor shows it", stroke_scale, "um"),
    description="a second displacement sensor, linear, with a separate scale",
    source="definition",
    belongs_to="sensor",
    equation_text="x_2 = sensor_2_scale x",
)
def second_sensor(s: Symbols) -> Equations:
    """A second displacement sensor, linear, with a separate scale."""
    return Equations(out={"displacement_2": s.sensor_2_scale * s.displacement})


@component(
    Parameter("strain_scale", 50.0, "1/m", (-1e9, 1e9), "strain per displacement", scale=50.0),
    Output("strain", "1", "strain that the gauge shows", _strained),
    description="a strain gauge on the stack, linear, with a separate scale",
    source="definition",
    belongs_to="sensor",
    equation_text="strain = strain_scale x",
)
def strain_gauge(s: Symbols) -> Equations:
    """A strain gauge on the stack, linear, with a separate scale."""
    return Equations(out={"strain": s.strain_scale * s.displacement})


#: This much beyond a range, over its size, is still inside: rounding and a sensor's noise.
MARGIN = 0.01
#: Name of the output.
OUTPUT = "outside_validity"


def _beyond(value: Expression, low: Expression, high: Expression) -> Expression:
    """Return by how much a value is beyond a range, over the size of the range."""
    size = ca.fmax(high - low, 1e-9)
    return ca.fmax(0.0, ca.fmax(low - value, value - high) / size - MARGIN)


def _validity(s: Symbols, *, temperature: bool) -> Equations:
    rate = s.voltage_rate / s.G
    outside = _beyond(s.voltage, s.seen_voltage_low, s.seen_voltage_high)
    outside += ca.fmax(0.0, ca.fabs(rate) / s.seen_voltage_rate - 1.0 - MARGIN)
    if temperature:
        outside += _beyond(s.temperature, s.seen_temperature_low, s.seen_temperature_high)
    return Equations(out={OUTPUT: outside})


def _limit(name: str, value: float, unit: str, bounds: tuple[float, float], what: str) -> Parameter:
    return Parameter(f"seen_{name}", value, unit, bounds, f"{what} in the records", fitted=False)


_VOLTS, _KELVINS = (-1e5, 1e5), (0.0, 1e4)
_RANGES = (
    _limit("voltage_low", 0.0, "V", _VOLTS, "lowest voltage"),
    _limit("voltage_high", 100.0, "V", _VOLTS, "highest voltage"),
    _limit("voltage_rate", 1e6, "V/s", (1e-9, 1e12), "largest rate of the voltage"),
)
_WARM = (
    _limit("temperature_low", 288.15, "K", _KELVINS, "lowest temperature"),
    _limit("temperature_high", 298.15, "K", _KELVINS, "highest temperature"),
)
_MEANING = (
    "sum of the shares by which voltage{} and rate are beyond what the records show; 0 inside"
)
_TEXT = (
    "outside_validity = beyond(v) + max(0, |u'/G| / seen_voltage_rate - 1.01){},"
    "  beyond(q) = max(0, max(seen_q_low - q, q - seen_q_high) / (seen_q_high - seen_q_low) - 0.01)"
)


def _component(name: str, *, temperature: bool) -> Component:
    meaning = _MEANING.format(", temperature" if temperature else "")
    return Component(
        name=name,
        description="distance of a run from the ranges of the model's records",
        source="definition; the ranges are those of the records",
        equations=partial(_validity, temperature=temperature),
        equation_text=_TEXT.format(" + beyond(T)" if temperature else ""),
        parameters=(*_RANGES, *(_WARM if temperature else ())),
        outputs=(Output(OUTPUT, "1", meaning),),
        needs=("drive", "temperature") if temperature else ("drive",),
    )


VALIDITY = _component("validity", temperature=False)
VALIDITY_WITH_TEMPERATURE = _component("validity_with_temperature", temperature=True)
