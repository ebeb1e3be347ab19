"""The stack itself: drive, forces, hysteresis, lag, mechanics and an ideal sensor."""

from psa_casadi.model import shapes
from psa_casadi.model.component import Equations, Symbols, component
from psa_casadi.model.shapes import (
    charge_scale,
    current_scale,
    force_scale,
    stroke_scale,
    velocity_scale,
    voltage_scale,
)
from psa_casadi.model.variables import Input, Output, Parameter, State, Values


@component(
    Parameter("G", 1.0, "1", (1e-3, 1e4), "voltage gain of the amplifier"),
    Parameter(
        "R_s", 10.0, "Ohm", (1e-3, 1e7), "output resistance of amplifier and leads", log=True
    ),
    Parameter("C_p", 1.6e-6, "F", (1e-10, 1e-2), "capacitance of the stack", "uF", log=True),
    Parameter("u_rated", 150.0, "V", (1e-3, 1e5), "rated voltage span, sets nominal sizes"),
    State("u", "V", "voltage at the stack's electrodes", voltage_scale),
    Input("voltage", "V", "voltage command to the amplifier", nominal=voltage_scale),
    Output("current", "A", "current into the stack", current_scale, "mA"),
    Output("charge", "C", "charge on the stack's electrodes", charge_scale, "uC"),
    description="amplifier of gain G and output resistance R_s charging the stack (C_p)",
    source="circuit of a stack on a voltage amplifier; supplies u' to Yang and Zhu 2015, eq. 8",
    equation_text="C_p u' = i,  i = (G v - u) / R_s",
)
def drive(s: Symbols) -> Equations:
    """Drive stage: amplifier with gain and output resistance, charging the stack's capacitance."""
    return Equations(
        der={"u": s.voltage_rate},
        add={
            "drive_voltage": s.G * s.voltage,
            "drive_current": (s.drive_voltage - s.u) / s.R_s,
            "stack_current": s.drive_current,
            "stack_charge": s.C_p * s.u,
            "voltage_rate": s.stack_current / s.C_p,
        },
        out={"current": s.stack_current, "charge": s.stack_charge},
    )


def _hysteresis_scale(p: Values) -> float:
    return abs(p["h_ref"])


def _slope_scale(p: Values) -> float:
    return 0.1 * abs(p["k_L"])


def _delta_scale(p: Values) -> float:
    return 0.05 * abs(p["k_L"])


@component(
    Parameter("k_L", 10.0, "N/V", (1e-6, 1e6), "linear force per volt", log=True),
    description="force proportional to the voltage at the electrodes",
    source="Yang and Zhu 2015, eq. 7 with f_0 = 0",
    equation_text="f_L = k_L u",
)
def linear_force(s: Symbols) -> Equations:
    """Force proportional to the voltage at the electrodes."""
    return Equations(add={"free_force": s.k_L * s.u})


#: Of every form of the hysteresis, which rests while the voltage is held.
HOLD_RATE = Parameter(
    "hold_rate", 0.1, "V/s", (1e-9, 1e6), "voltage rate below which the voltage counts as held",
    fitted=False,
)  # fmt: skip


@component(
    Parameter("A", -2.0, "N/V", (-1e5, 1e5), "slope of the hysteresis force", scale=_slope_scale),
    Parameter("beta", 1.0, "N/V", (-1e5, 1e5), "dissipative bend", scale=_slope_scale),
    Parameter("gamma", 0.5, "N/V", (-1e5, 1e5), "elastic bend", scale=_slope_scale),
    Parameter("delta", 0.0, "N/(V.s)", (-1e5, 1e5), "asymmetry of the paper", scale=_delta_scale),
    Parameter("n", 1.2, "1", (1.0, 4.0), "sharpness of the bend", scale=0.5),
    Parameter("h_ref", 100.0, "N", (1e-9, 1e7), "reference force that makes (|f_H|/h_ref)^n pure"),
    HOLD_RATE,
    State("f_H", "N", "hysteresis force", _hysteresis_scale, memory=True, settles=False),
    description="asymmetric Bouc-Wen hysteresis force",
    source="Yang and Zhu 2015, eq. 8, read with sgn(u') as its eqs. 28, 31 and 34 require",
    equation_text=(
        "f_H' = A u' - beta |u'| sgn(f_H) (|f_H|/h_ref)^n - gamma u' (|f_H|/h_ref)^n"
        " + delta u sgn(u')"
    ),
)
def bouc_wen(s: Symbols) -> Equations:
    """Asymmetric Bouc-Wen hysteresis force."""
    ratio = s.f_H / s.h_ref
    rate = (
        s.A * s.voltage_rate
        - s.beta * shapes.rate_magnitude(s) * shapes.signed_power(ratio, s.n)
        - s.gamma * s.voltage_rate * shapes.magnitude_power(ratio, s.n)
        + s.delta * s.u * shapes.direction(s)
    )
    return Equations(
        der={"f_H": s.hysteresis_rate},
        add={"hysteresis_rate": rate, "free_force": s.f_H},
        switches={"voltage_reversal": s.voltage_rate},
    )


@component(
    Parameter("tau", 1e-4, "s", (1e-7, 1.0), "time constant of the force", "ms", log=True),
    State("f_out", "N", "force after the lag", force_scale),
    description="first-order lag of the generated force (the paper's creep)",
    source="Yang and Zhu 2015, eq. 9 in the causal form that its eq. 13 uses",
    equation_text="tau f_out' + f_out = f_L + f_H",
)
def creep_lag(s: Symbols) -> Equations:
    """First-order lag of the generated force (the paper's creep)."""
    return Equations(der={"f_out": (s.free_force - s.f_out) / s.tau}, add={"wafer_force": s.f_out})


_LOAD = Input(
    "load_force", "N", "external force on the output mass, positive outward", 0.0, force_scale
)
_OUTPUTS = (
    Output("displacement", "m", "displacement of the stack's output", stroke_scale, "um"),
    Output("velocity", "m/s", "velocity of the stack's output", velocity_scale, "um/s"),
    Output(
        "blocked_force", "N", "force that would hold the output at zero displacement", force_scale
    ),
)


def _oscillator(suffix: str, what: str, *values: float) -> tuple[Parameter, ...]:
    """Return mass [kg], damping [N.s/m] and stiffness [N/m] of a part of a stack."""
    kinds = (
        ("m", "kg", (1e-9, 1e3), "mass"),
        ("c", "N.s/m", (1e-6, 1e9), "damping"),
        ("k", "N/m", (1.0, 1e12), "stiffness"),
    )
    return tuple(
        Parameter(letter + suffix, value, unit, bounds, f"equivalent {kind} of {what}", log=True)
        for value, (letter, unit, bounds, kind) in zip(values, kinds, strict=True)
    )


_OUTPUT_STATES = (
    State("x", "m", "displacement of the output mass", stroke_scale, display_unit="um"),
    State("v_x", "m/s", "velocity of the output mass", velocity_scale, display_unit="um/s"),
)


@component(
    *_oscillator("_P", "the wafers", 5e-3, 100.0, 1.2e8),
    *_oscillator("_B", "the bonding layers", 5e-3, 300.0, 6e8),
    State("y", "m", "displacement of the wafers", stroke_scale, display_unit="um"),
    State("v_y", "m/s", "velocity of the wafers", velocity_scale, display_unit="um/s"),
    *_OUTPUT_STATES,
    _LOAD,
    *_OUTPUTS,
    description="one-way cascade of the wafers' and the bonding layers' oscillator",
    source="Yang and Zhu 2015, eqs. 4 and 5, with an external force on the output mass",
    equation_text=(
        "m_P y'' + c_P y' + k_P y = f_out;  "
        "m_B x'' + c_B (x' - y') + k_B (x - y) = c_P y' + k_P y + f_load"
    ),
)
def cascade_mechanics(s: Symbols) -> Equations:
    """One-way cascade of the wafers' and the bonding layers' oscillator."""
    elastic = s.c_P * s.v_y + s.k_P * s.y
    pull = s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)
    return Equations(
        der={
            "y": s.v_y,
            "v_y": (s.wafer_force - elastic) / s.m_P,
            "x": s.v_x,
            "v_x": (s.transmitted_force + s.tip_force - pull) / s.m_B,
        },
        add={
            "transmitted_force": elastic,
            "tip_force": s.load_force,
            "tip_displacement": s.x,
            "displacement": s.tip_displacement,
            "blocked_force": s.transmitted_force + s.c_B * s.v_y + s.k_B * s.y,
        },
        out={"displacement": s.displacement, "blocked_force": s.blocked_force},
    )


@component(
    *_oscillator("", "the stack", 1e-2, 200.0, 1e8),
    *_OUTPUT_STATES,
    _LOAD,
    *_OUTPUTS,
    description="one equivalent mass, spring and damper for the whole stack",
    source="Yang and Zhu 2015, eq. 6 (the simplified comprehensive model)",
    equation_text="m x'' + c x' + k x = f_out + f_load",
)
def single_mass(s: Symbols) -> Equations:
    """One equivalent mass, spring and damper for the whole stack."""
    return Equations(
        der={
            "x": s.v_x,
            "v_x": (s.wafer_force + s.tip_force - s.c * s.v_x - s.k * s.x) / s.m,
        },
        add={
            "tip_force": s.load_force,
            "tip_displacement": s.x,
            "displacement": s.tip_displacement,
            "blocked_force": s.wafer_force,
        },
        out={"displacement": s.displacement, "blocked_force": s.blocked_force},
    )


@component(
    Output("measured_displacement", "m", "displacement as the sensor shows it", stroke_scale, "um"),
    description="ideal displacement sensor",
    source="definition",
    equation_text="x_m = x",
    belongs_to="sensor",
)
def sensor(s: Symbols) -> Equations:
    """Ideal displacement sensor."""
    return Equations(
        add={"measured_displacement": s.displacement},
        out={"measured_displacement": s.measured_displacement},
    )


#: Thresholds over the rated voltage: from a hundredth of it to beyond the widest loop, evenly in
#: their logarithms, a factor of two apart.
_THRESHOLDS = tuple(0.0125 * 2.0**i for i in range(8))
#: Cosines over the elements that the weights of plays, of their squares and cubes are made of.
_COUNTS = (5, 3, 3)


@component(
    *shapes.spectrum_parameters("", _COUNTS, (-0.03,)),
    HOLD_RATE,
    *shapes.stop_states("z_", [f"{r:g} of the rated voltage" for r in _THRESHOLDS]),
    description="hysteresis force as a spectrum of elements, symmetric or not",
    source=(
        "generalised Prandtl-Ishlinskii: plays, their squares and cubes (Al Janaideh, Rakheja and"
        " Su, IEEE/ASME Trans. Mechatronics 16 (2011) 734), as stops in smooth Bouc-Wen form"
    ),
    equation_text=(
        "f_H = k_L sum_i z_i (a_i + b_i (2 u - z_i)/u_rated"
        " + c_i (3 u^2 - 3 u z_i + z_i^2)/u_rated^2),  "
        "z_i' = u' - (|u'| sgn(z_i) + u')/2 (|z_i|/r_i)^4,  r_i = u_rated 2^(i-1)/80,  "
        "a_i = sum_k play_k cos(pi k (i - 1/2)/8),  b_i and c_i of square_k and cube_k likewise"
    ),
)
def memory_spectrum(s: Symbols) -> Equations:
    """The hysteresis as a spectrum of elements, in place of Bouc-Wen's."""
    elements, rates = shapes.stop_rates(
        s, "z_", [threshold * s.u_rated for threshold in _THRESHOLDS]
    )
    return Equations(
        der=rates,
        add={"free_force": s.k_L * shapes.spectrum_force(s, "", elements, _COUNTS)},
        switches={"voltage_reversal": s.voltage_rate},
    )
