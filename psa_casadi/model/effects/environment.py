"""Effects of the surroundings: drift, hum of the mains, temperature."""

import casadi as ca

from psa_casadi.model.component import (
    RECORD_DURATION,
    SPECTRAL_PEAKS,
    Equations,
    Remedy,
    Symbols,
    effect,
)
from psa_casadi.model.shapes import positive, reading, reading_scale, share, stroke
from psa_casadi.model.variables import Input, Parameter, State


@effect(
    Parameter(
        "drift_rate",
        0.0,
        "m/s",
        (-1e-3, 1e-3),
        "rate of the drift",
        "um/s",
        scale=reading_scale,
    ),
    share("drift_bend", (-3.0, 3.0), "change of the rate over drift_span", 0.3),
    Parameter(
        "drift_span", 10.0, "s", (1e-6, 1e9), "time over which drift_bend counts", fitted=False
    ),
    kind="time",
    description="the sensor's zero moves with time alone",
    source="zero drift of sensors: slow polynomial of time",
    belongs_to="sensor",
    equation_text="x_m gains drift_rate t (1 + drift_bend t / drift_span)",
    probe={"drift_span": RECORD_DURATION, "drift_bend": (-0.5, 0.0)},
    remedy=Remedy("zero_again", "record"),
    looks_like="the residual is a slow function of time alone, also at constant voltage",
)
def offset_drift(s: Symbols) -> Equations:
    """Offset drift: the sensor's zero moves with time alone."""
    bend = s.drift_bend * s.time / s.drift_span
    return Equations(add={"measured_displacement": s.drift_rate * s.time * (1 + bend)})


_TWO_PI = 6.283185307179586


def _part(name: str) -> State:
    return State(
        f"hum_{name}", "1", f"{name} part of the hum over its gain", 1.0, memory=True, settles=False
    )


@effect(
    reading("hum_gain", "size of the hum"),
    Parameter("hum_frequency", 50.0, "Hz", (0.05, 1e5), "frequency of the line", log=True),
    _part("cosine"),
    _part("sine"),
    kind="time",
    description="a line at one frequency in the reading, whatever the drive does",
    source="pick-up of 50 or 60 Hz mains: Morrison, Grounding and Shielding Techniques (Wiley)",
    belongs_to="environment",
    tone="hum_frequency",
    equation_text=(
        "x_m gains hum_gain (a cos(w t) + b sin(w t)),  w = 2 pi hum_frequency,"
        "  a' = b' = 0 with a separate start for each record"
    ),
    probe={"hum_frequency": SPECTRAL_PEAKS},
    remedy=Remedy("shield", "record"),
    looks_like="a narrow line in the residual's spectrum, as strong when the voltage rests",
    trial_starts=({"hum_cosine": 1.0}, {"hum_sine": 1.0}),
)
def mains_hum(s: Symbols) -> Equations:
    """Mains hum: a line at one frequency in the reading, whatever the drive does.

    The hum is an undamped oscillator w1' = w w2, w2' = -w w1 whose amplitude and phase are
    separate for each record. In the frame that turns with it w1 = a cos(w t) + b sin(w t) with
    a' = b' = 0, the exact solution. So it costs no steps, keeps its amplitude for any number of
    periods, and a line above the sampling rate shows up at its alias. a and b are memories that
    rest at any value; at the start (0, 0) there is no hum. The gain has either sign, so that one
    start serves both phases.
    """
    angle = _TWO_PI * s.hum_frequency * s.time
    hum = s.hum_cosine * ca.cos(angle) + s.hum_sine * ca.sin(angle)
    return Equations(
        der={"hum_cosine": 0.0, "hum_sine": 0.0},
        add={"measured_displacement": s.hum_gain * hum},
    )


_ROOM = 293.15


@effect(
    Parameter("expansion_gain", 0.0, "1/K", (-0.1, 0.1), "expansion over stroke", scale=1e-3),
    share(
        "temperature_gain_ratio",
        (-100.0, 100.0),
        "relative change of the gain over the expansion over stroke",
        1.0,
    ),
    positive(
        "temperature_lag",
        0.01,
        "s",
        (1e-4, 1e5),
        "time constant from the thermometer to the stack",
        limit=True,
    ),
    Parameter(
        "temperature_reference",
        _ROOM,
        "K",
        (0.0, 1000.0),
        "temperature at which nothing changes",
        scale=1.0,
        fitted=False,
    ),
    State("stack_warmer", "K", "temperature of the stack above the reference", 1.0),
    Input("temperature", "K", "temperature of the stack", start=_ROOM, nominal=300.0),
    kind="changing gain",
    description="length and gain of the stack follow its temperature",
    source="Physik Instrumente, piezo tutorial, Temperature Effects: expansion and piezo gain",
    belongs_to="environment",
    equation_text=(
        "x_m gains expansion_gain w stroke,  f_L gains temperature_gain_ratio expansion_gain w"
        " k_L u,  temperature_lag w' + w = T - temperature_reference"
    ),
    probe={"temperature_gain_ratio": (-1.0, 0.0, 1.0), "temperature_lag": (0.01, 1.0)},
    remedy=Remedy("steady_surroundings", "record"),
    looks_like="the residual follows the temperature, by an offset and in proportion to the stroke",
)
def temperature(s: Symbols) -> Equations:
    """Temperature: the stack's length and its gain follow the record's temperature column.

    The thermometer leads the stack: stack and frame follow it through a lag, of
    milliseconds where it sits on the ceramic, of minutes where it hangs in the room.

    Sizes: a stack of length L moves 1.0e-3 to 1.3e-3 L at rated voltage. Poled multilayer ceramic
    expands by -3.5e-6 L per kelvin along its length (co-fired) or +11e-6 L (glued high-voltage
    discs), a steel frame by 11e-6 L: some -0.4 to +1.4 % of the stroke per kelvin. The
    piezoelectric coefficient of soft PZT grows by one or a few tenths of a percent per kelvin. A
    kelvin is an ordinary change in a laboratory and 0.1 % of the stroke is noticeable: 1e-3 per
    kelvin is ordinary.
    """
    warmer = s.temperature - s.temperature_reference
    expansion = s.expansion_gain * s.stack_warmer
    return Equations(
        der={"stack_warmer": (warmer - s.stack_warmer) / s.temperature_lag},
        add={
            "measured_displacement": expansion * stroke(s),
            "free_force": expansion * s.temperature_gain_ratio * s.k_L * s.u,
        },
    )
