"""Effects of the sensor: how a reading differs from the displacement."""

from math import pi

import casadi as ca

from psa_casadi.model import shapes
from psa_casadi.model.component import (
    DISPLACEMENT_PEAKS,
    DISPLACEMENT_STEPS,
    Equations,
    Expression,
    Remedy,
    Symbols,
    effect,
)
from psa_casadi.model.shapes import stroke, stroke_scale
from psa_casadi.model.variables import Parameter, State, Values

#: Smallest time constant of a section [s]; keeps it defined at zero delay.
_DELAY_FLOOR = 1e-6


def _states(index: int) -> tuple[State, State]:
    return (
        shapes.motion(f"z_d{index}", f"filtered input of section {index}"),
        shapes.motion(f"r_d{index}", "its rate times the section's delay"),
    )


@effect(
    shapes.delay("sensor_delay", "delay of the sensor"),
    *_states(1),
    *_states(2),
    kind="lag",
    description="the measured displacement arrives late by a fixed time",
    source="Pade approximation of exp(-s T), two second-order sections in series",
    belongs_to="sensor",
    finite_step=(0.0, 5.0, 20.0, 60.0),
    equation_text=(
        "x_m(t) = x(t - T), as P(s T/2)^2 with P(q) = (1 - q/2 + q^2/12)/(1 + q/2 + q^2/12)"
    ),
    remedy=Remedy("align_clocks", "slew"),
    looks_like="phase linear in frequency; the residual follows the displacement's rate",
)
def sensor_delay(s: Symbols) -> Equations:
    """Sensor delay: the measured displacement arrives late by a fixed time."""
    half = s.sensor_delay / 2
    a1, b1, first = shapes.pade_section(half, _DELAY_FLOOR, s.displacement, s.z_d1, s.r_d1)
    a2, b2, second = shapes.pade_section(half, _DELAY_FLOOR, first, s.z_d2, s.r_d2)
    return Equations(
        der={"z_d1": a1, "r_d1": b1, "z_d2": a2, "r_d2": b2},
        add={"measured_displacement": second - s.displacement},
    )


#: Added to the time constant [s]; keeps the filter defined at zero lag. What the sensor gains is
#: (1 + s floor)/(1 + s (T + floor)), the identity at T = 0.
_LAG_FLOOR = 1e-6


@effect(
    shapes.delay("sensor_lag_time", "time constant of the sensor"),
    shapes.motion("sensor_lag_displacement", "displacement behind the lag"),
    kind="lag",
    description="the sensor follows the displacement with a time constant",
    source="bandwidth of position sensors: Fleming, Sensors and Actuators A 190 (2013) 106",
    belongs_to="sensor",
    finite_step=(0.0, 5.0, 20.0, 60.0),
    equation_text="sensor_lag_time x_m' + x_m = x",
    remedy=Remedy("faster_sensor", "slew"),
    looks_like="phase of a first-order lag, which saturates at 90 degrees, and roll-off with it",
)
def sensor_lag(s: Symbols) -> Equations:
    """Sensor lag: the sensor's electronics follow the displacement with a time constant."""
    time = s.sensor_lag_time + _LAG_FLOOR
    behind = s.sensor_lag_displacement - s.displacement
    return Equations(
        der={"sensor_lag_displacement": -behind / time},
        add={"measured_displacement": s.sensor_lag_time / time * behind},
    )


@effect(
    shapes.share(
        "nonlinearity_gain",
        (-0.5, 0.5),
        "bow and S over the stroke, beyond the best straight line",
        0.002,
    ),
    *shapes.shape_parameters("nonlinearity"),
    kind="curve",
    description="the sensor's reading is a bent function of the displacement",
    source="linearity error of position sensors: Fleming, Sensors and Actuators A 190 (2013) 106",
    belongs_to="sensor",
    equation_text=(
        "x_m = x + nonlinearity_gain stroke b(x/stroke),  stroke = k_L u_rated over the static"
        " stiffness,  " + shapes.BEND_TEXT.format("nonlinearity")
    ),
    curve="displacement",
    probe={"nonlinearity_angle": shapes.ANGLES},
    remedy=Remedy("calibrate_sensor", "range"),
    looks_like="the residual is a function of the displacement alone, the same on both branches",
)
def sensor_nonlinearity(s: Symbols) -> Equations:
    """Sensor nonlinearity: the reading is a bent function of the displacement.

    A constant and a slope are the sensor's offset and its sensitivity, which a fit
    attributes to the stack; what remains of a smooth curve is a bow, an S and a W.
    """
    full = stroke(s)
    curve = shapes.bend(s.displacement / full, s.nonlinearity_angle, s.nonlinearity_wave)
    return Equations(add={"measured_displacement": s.nonlinearity_gain * full * curve})


def _wave(s: Symbols, angle: Expression) -> Expression:
    second = s.ripple_second_cosine * ca.cos(2 * angle) + s.ripple_second_sine * ca.sin(2 * angle)
    return ca.sin(angle + s.ripple_phase) + second


def _second(name: str) -> Parameter:
    return shapes.share(
        f"ripple_second_{name}", (-20.0, 20.0), f"{name} of half the period, over the ripple", 0.3
    )


@effect(
    shapes.reading("ripple_gain", "size of the ripple"),
    Parameter(
        "ripple_period", 2e-6, "m", (1e-9, 1e-2), "displacement of one period", "um", log=True
    ),
    Parameter(
        "ripple_phase", 0.0, "rad", (-4.0 * pi, 4.0 * pi), "phase at displacement 0", scale=0.3
    ),
    _second("cosine"),
    _second("sine"),
    kind="curve",
    description="an error of the reading that repeats with the displacement",
    source=(
        "quadrature errors of encoders and interferometers: Heydemann, Applied Optics 20 (1981)"
        " 3382"
    ),
    belongs_to="sensor",
    equation_text=(
        "x_m = x + ripple_gain (w(2 pi x/ripple_period) - w(0)),  w(a) = sin(a + ripple_phase)"
        " + second_cosine cos(2 a) + second_sine sin(2 a)"
    ),
    probe={"ripple_period": DISPLACEMENT_PEAKS, "ripple_phase": (0.0, 0.5 * pi)},
    remedy=Remedy("calibrate_sensor", "range"),
    looks_like="the residual repeats many times over the displacement, the same on both branches",
)
def sensor_ripple(s: Symbols) -> Equations:
    """Sensor ripple: an error of the reading that repeats with the displacement.

    A grating, a fringe or a pitch repeats with the period L. Offsets of its two signals make an
    error of that period, unequal amplitudes and a phase that is not 90 degrees one of half of it.
    """
    wave = _wave(s, 2 * pi * s.displacement / s.ripple_period)
    return Equations(add={"measured_displacement": s.ripple_gain * (wave - _wave(s, ca.SX(0)))})


def _place_scale(p: Values) -> float:
    return 1e-2 * stroke_scale(p)


@effect(
    shapes.reading("jump_gain", "size of the jump"),
    Parameter(
        "jump_place", 5e-6, "m", (-1e-2, 1e-2), "displacement of it", "um", scale=_place_scale
    ),
    shapes.positive(
        "jump_width", 0.01, "1", (1e-6, 0.05), "half its rise over the stroke", limit=True
    ),
    kind="curve",
    description="the reading jumps where the displacement passes one place",
    source=(
        "wide or missing code of a converter (IEEE Std 1241), stitching error of a scale: a static"
        " step of the reading"
    ),
    belongs_to="sensor",
    equation_text=(
        "x_m = x + jump_gain/2 (tanh((x - jump_place)/w) + tanh(jump_place/w)),"
        "  w = jump_width x_s,  x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k"
    ),
    probe={"jump_place": DISPLACEMENT_STEPS, "jump_width": (0.003, 0.03)},
    remedy=Remedy("calibrate_sensor", "range"),
    looks_like="the residual jumps at one displacement, the same on both branches",
)
def sensor_jump(s: Symbols) -> Equations:
    """Sensor jump: the reading jumps where the displacement passes one place, on both branches.

    It is narrow: a wide one would be a bent sensor. A reading that stays off after a jump, as of an
    interferometer that has lost a count, is not this.
    """
    width = s.jump_width * stroke(s)

    def side(x: Expression) -> Expression:
        return ca.tanh((x - s.jump_place) / width)

    jump = 0.5 * s.jump_gain * (side(s.displacement) - side(ca.SX(0)))
    return Equations(add={"measured_displacement": jump})
