"""Offset drift: the sensor's zero moves with time alone."""

from psa_casadi.component import RECORD_DURATION, Component, Equations, Remedy, Symbols
from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Parameter, Values


def _offset_drift(s: Symbols) -> Equations:
    """Offset drift: the sensor's zero moves with time alone."""
    bend = s.drift_bend * s.time / s.drift_span
    return Equations(add={"measured_displacement": s.drift_rate * s.time * (1 + bend)})


def _scale(p: Values) -> float:
    return 1e-3 * stroke_scale(p)


OFFSET_DRIFT = Component(
    name="offset_drift",
    description="the sensor's zero moves with time alone",
    source="zero drift of sensors: slow polynomial of time",
    belongs_to="sensor",
    gain="drift_rate",
    equation_text="x_m gains drift_rate t (1 + drift_bend t / drift_span)",
    parameters=(
        Parameter(
            "drift_rate", 0.0, "m/s", (-1e-3, 1e-3), "rate of the drift", "um/s", scale=_scale
        ),
        Parameter(
            "drift_bend", 0.0, "1", (-3.0, 3.0), "change of the rate over drift_span", scale=0.3
        ),
        Parameter(
            "drift_span", 10.0, "s", (1e-6, 1e9), "time over which drift_bend counts", fitted=False
        ),
    ),
    equations=_offset_drift,
    probe={"drift_span": RECORD_DURATION, "drift_bend": (-0.5, 0.0)},
    remedy=Remedy("zero_again", "record"),
    looks_like="the residual is a slow function of time alone, also at constant voltage",
)
