"""The surroundings of a stack: stage, amplifiers, mechanism, controller, compensator.

Both amplifiers have a limit of the current into their load, as one of the output's rate i_max/C.
The compensator's observer runs eq. (8) on the voltage that it commands itself, as eq. (37) does:
what leaves it is v - f_H_hat / (k_L G), and f_H_hat' follows from the voltage that this puts on the
electrodes, behind the lag T_d of amplifier, output resistance and capacitance. Both u_hat and
f_H_hat are states, so there is no algebraic loop. With the stack's parameters the generated
force is k_L G v after the lag, without hysteresis.
"""

from dataclasses import replace

import casadi as ca

from psa_casadi.model.component import Equations, Expression, Symbols, component, effect
from psa_casadi.model.shapes import force_scale, hysteresis_scale, voltage_scale
from psa_casadi.model.variables import Input, Output, Parameter, State, Values


@component(
    Parameter("m_f", 0.2, "kg", (1e-6, 1e3), "mass of the stage", log=True),
    Parameter("c_f", 50.0, "N.s/m", (0.0, 1e9), "damping of the flexure"),
    Parameter("k_f", 5e6, "N/m", (0.0, 1e12), "stiffness of the flexure"),
    Parameter("k_c", 5e7, "N/m", (1.0, 1e12), "contact stiffness", log=True),
    Parameter("c_c", 500.0, "N.s/m", (0.0, 1e9), "contact damping"),
    State("x_f", "m", "position of the stage", 1e-5, display_unit="um"),
    State("v_f", "m/s", "velocity of the stage", 1e-2, display_unit="um/s"),
    Input("tip_position", "m", "position of the stack's output", 0.0, 1e-5, "um"),
    Input("tip_velocity", "m/s", "velocity of the stack's output", 0.0, 1e-2, "um/s"),
    Output("reaction_force", "N", "force of the stage on the stack", 100.0),
    Output("stage_position", "m", "position of the stage", 1e-5, "um"),
    description="guided stage (mass, damper, spring) behind a contact stiffness",
    source="Newton's second law; Yang and Zhu 2015, eq. 44 for the mechanism",
    equation_text="m_f x_f'' + c_f x_f' + k_f x_f = F,  F = k_c (x - x_f) + c_c (x' - x_f')",
)
def flexure(s: Symbols) -> Equations:
    """A flexure stage that a stack pushes on through a contact spring: a second model to couple."""
    contact = s.k_c * (s.tip_position - s.x_f) + s.c_c * (s.tip_velocity - s.v_f)
    return Equations(
        der={"x_f": s.v_f, "v_f": (contact - s.c_f * s.v_f - s.k_f * s.x_f) / s.m_f},
        out={"reaction_force": -contact, "stage_position": s.x_f},
    )


#: Even exponent of the smooth limit; the larger, the sharper the corner.
_SHARPNESS = 8


def _limited(rate: Expression, limit: Expression) -> Expression:
    """Return `rate / (1 + |rate / limit|^8)^(1/8)`: 1 % low at 0.81 limits, never beyond 1."""
    return rate / (1.0 + (rate / limit) ** _SHARPNESS) ** (1.0 / _SHARPNESS)


def _full_swing(p: Values) -> float:
    return abs(p["gain"]) * 10.0


def _most(p: Values) -> float:
    return max(abs(p["highest_output"]), abs(p["lowest_output"]))


def _amplifier_command(p: Values) -> float:
    """A command at which the output reaches the end of its range."""
    return 1.2 * _most(p) / abs(p["gain"])


def _current(p: Values) -> float:
    return p["current_limit"]


_LIMITS = (
    Parameter("current_limit", 1.0, "A", (1e-6, 1e3), "largest output current", log=True),
    Parameter(
        "load_capacitance", 1.5e-6, "F", (1e-12, 1e-2), "capacitance of the load", "uF", log=True
    ),
)


@component(
    Parameter("gain", 10.0, "1", (1e-3, 1e4), "volts out per volt of command"),
    Parameter("bandwidth", 20e3, "Hz", (1e-2, 1e9), "small-signal bandwidth", "kHz", log=True),
    Parameter("lowest_output", -20.0, "V", (-1e5, 1e5), "lowest voltage", scale=100.0),
    Parameter("highest_output", 120.0, "V", (-1e5, 1e5), "highest voltage", scale=100.0),
    *_LIMITS,
    State("amplified", "V", "voltage at the output", _most),
    Input("command", "V", "command", nominal=_amplifier_command),
    Output("output_voltage", "V", "voltage at the output", _most),
    Output("load_current", "A", "current into the load", _current),
    description="voltage amplifier of finite bandwidth, output range and current",
    source=(
        "data sheets of piezo drivers: gain, small-signal bandwidth, output range, peak current;"
        " slew rate i_max / C: Fleming and Leang 2014, ch. 14"
    ),
    equation_text=(
        "v' = r / (1 + |r C / i_max|^8)^(1/8),"
        "  r = 2 pi f_b (min(max(gain command, low), high) - v)"
    ),
    belongs_to="drive",
)
def voltage_amplifier(s: Symbols) -> Equations:
    """Voltage amplifier of finite bandwidth, output range and current."""
    wanted = s.gain * s.command
    inside = ca.fmin(ca.fmax(wanted, s.lowest_output), s.highest_output)
    limit = s.current_limit / s.load_capacitance
    rate = _limited(2.0 * ca.pi * s.bandwidth * (inside - s.amplified), limit)
    return Equations(
        der={"amplified": rate},
        out={"output_voltage": s.amplified, "load_current": s.load_capacitance * rate},
        switches={
            "lowest_output_reached": wanted - s.lowest_output,
            "highest_output_reached": s.highest_output - wanted,
        },
    )


def _sensed(p: Values) -> float:
    return p["sense_capacitance"] * 10.0


@component(
    Parameter("gain", 10.0, "1", (1e-3, 1e4), "volts out per volt of command at rest"),
    Parameter("bandwidth", 3e3, "Hz", (1e-2, 1e9), "bandwidth of the loop", "kHz", log=True),
    Parameter(
        "sense_capacitance", 15e-6, "F", (1e-12, 1.0), "charge per volt of command", "uF", True
    ),
    Parameter("leak_time", 1.0, "s", (1e-4, 1e5), "time constant of the leakage", log=True),
    *_LIMITS,
    State("amplified", "V", "voltage at the output", _full_swing),
    State("bypassed_charge", "C", "charge past load and sense capacitor", _sensed, 0.0, "uC"),
    Input("command", "V", "command", nominal=10.0),
    Input("load_charge", "C", "charge on the load", nominal=1e-4, display_unit="uC"),
    Output("output_voltage", "V", "voltage at the output", _full_swing),
    Output("sensed_charge", "C", "charge on the sense capacitor", _sensed, "uC"),
    description="charge amplifier: sets the charge above its leakage corner, the voltage below it",
    source=(
        "Fleming and Moheimani, Rev. Sci. Instrum. 76 (2005) 073707: a sense capacitor C_s in"
        " series with the load, resistors R_s and R_L across both"
    ),
    equation_text=(
        "v' = limited(2 pi f_b (C_s / C) (command - q_s / C_s)),  q_s = q + z,"
        "  z' = (C_s v / gain - q_s) / tau,  tau = R_s C_s, gain = R_L / R_s"
    ),
    belongs_to="drive",
)
def charge_amplifier(s: Symbols) -> Equations:
    """Charge amplifier: sets the charge above its leakage corner, the voltage below it."""
    sensed = s.load_charge + s.bypassed_charge
    error = s.command - sensed / s.sense_capacitance
    gain = s.sense_capacitance / s.load_capacitance
    limit = s.current_limit / s.load_capacitance
    rate = _limited(2.0 * ca.pi * s.bandwidth * gain * error, limit)
    through_load = s.sense_capacitance * s.amplified / s.gain
    return Equations(
        der={"amplified": rate, "bypassed_charge": (through_load - sensed) / s.leak_time},
        out={"output_voltage": s.amplified, "sensed_charge": sensed},
    )


def _acceleration(s: Symbols) -> Expression:
    """Acceleration of the output mass [m/s^2]."""
    return (s.transmitted_force + s.tip_force - _pull(s)) / s.m_B


def _pull(s: Symbols) -> Expression:
    """Force of the bonding layers on the wafers [N]."""
    return s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)


def _on_tip(s: Symbols) -> Equations:
    mass, held = s.mounted * s.m_m, s.mounted * (s.c_m * s.v_x + s.k_m * s.x)
    others = s.transmitted_force + s.load_force - _pull(s)
    return Equations(add={"tip_force": -(mass * others + s.m_B * held) / (s.m_B + mass)})


_MECHANISM = (
    Parameter("m_m", 0.05, "kg", (0.0, 1e3), "mass of the mechanism", "g", scale=0.01),
    Parameter("c_m", 100.0, "N.s/m", (0.0, 1e9), "damping of the mechanism"),
    Parameter("k_m", 5e6, "N/m", (0.0, 1e12), "stiffness of the mechanism"),
)
_MOUNTED = Parameter(
    "mounted", 0.0, "1", (0.0, 1.0), "share of the mechanism that is there: 0 the free stack",
    scale=1.0,
)  # fmt: skip


@component(
    *_MECHANISM,
    State("heat", "J", "energy that the damper has turned into heat", 1e-3),
    Input("tip_position", "m", "position of the stack's output", 0.0, 1e-5, "um"),
    Input("tip_velocity", "m/s", "velocity of the stack's output", 0.0, 1e-2, "um/s"),
    Input("tip_acceleration", "m/s2", "acceleration of the stack's output", 0.0, 1e2),
    Output("reaction_force", "N", "force of the mechanism on the stack", 100.0),
    Output("dissipated_energy", "J", "energy that the damper has turned into heat", 1e-3),
    description="elastic mechanism that holds a stack under prestress: mass, damper, spring",
    source="Yang and Zhu 2015, eq. 44",
    equation_text="F = -(m x'' + c x' + k x);  W' = c x'^2",
)
def prestress_mechanism(s: Symbols) -> Equations:
    """Elastic mechanism that holds a stack under prestress: mass, damper, spring."""
    force = s.m_m * s.tip_acceleration + s.c_m * s.tip_velocity + s.k_m * s.tip_position
    return Equations(
        der={"heat": s.c_m * s.tip_velocity**2},
        out={"reaction_force": -force, "dissipated_energy": s.heat},
    )


@component(
    Input("prestress_force", "N", "force of the mechanism on the stack", nominal=force_scale),
    Output("tip_velocity", "m/s", "velocity of the output mass", 1e-2, "um/s"),
    Output("tip_acceleration", "m/s2", "acceleration of the output mass", 1e2),
    description="where a prestress mechanism acts: its force comes in, the tip's motion goes out",
    source="Yang and Zhu 2015, eq. 45 and figure 12: the mechanism is feedback around G_P",
    equation_text="f_out + F acts on the wafers;  x', x'' of the output go out",
    needs=("cascade_mechanics",),
)
def prestress_port(s: Symbols) -> Equations:
    """Where a prestress mechanism acts: its force comes in, the tip's motion goes out."""
    return Equations(
        add={"wafer_force": s.prestress_force},
        out={"tip_velocity": s.v_x, "tip_acceleration": _acceleration(s)},
    )


@effect(
    _MOUNTED,
    *_MECHANISM,
    description="prestress mechanism around a stack, whose force acts on the wafers",
    source="Yang and Zhu 2015, eq. 45: the mechanism is feedback around the stack's mechanics",
    equation_text="f_out - (m x'' + c x' + k x) acts on the wafers",
    needs=("cascade_mechanics",),
    looks_like="more damping, resonances elsewhere, and a share of the stroke that is lost",
)
def prestress_on_wafers(s: Symbols) -> Equations:
    """Prestress mechanism around a stack, whose force acts on the wafers."""
    force = s.m_m * _acceleration(s) + s.c_m * s.v_x + s.k_m * s.x
    return Equations(add={"wafer_force": -s.mounted * force})


PRESTRESS_ON_TIP = replace(
    prestress_on_wafers,
    name="prestress_on_tip",
    description="prestress mechanism that pushes on the output mass of a stack",
    equation_text="(m_B + m) x'' = F - c x' - k x,  F: all else that acts on the output mass",
    equations=_on_tip,
)
#: A mechanism around a stack in one model: its force acts at the key.
PRESTRESS_MOUNTS = {"wafers": prestress_on_wafers, "tip": PRESTRESS_ON_TIP}


#: Largest half angle of the notch in one period [rad]: just below that of the Nyquist frequency.
_HALF_ANGLE = 1.5


def _notch(s: Symbols, error: Expression) -> tuple[Expression, Expression, Expression]:
    """Return the filtered error and the two memories after the instant.

    (s^2 + 2 d_z w s + w^2) / (s^2 + 2 d_p w s + w^2) by Tustin's rule, exact at w, as a biquad in
    the transposed second direct form.
    """
    half = ca.fmin(ca.pi * s.notch_frequency * s.sample_time, _HALF_ANGLE)
    t = ca.tan(half)
    leading = 1.0 + 2.0 * s.notch_width * t + t**2
    b_0 = (1.0 + 2.0 * s.notch_floor * t + t**2) / leading
    both_1 = 2.0 * (t**2 - 1.0) / leading
    b_2 = (1.0 - 2.0 * s.notch_floor * t + t**2) / leading
    a_2 = (1.0 - 2.0 * s.notch_width * t + t**2) / leading
    filtered = b_0 * error + s.notch_first
    first = both_1 * (error - filtered) + s.notch_second
    return filtered, first, b_2 * error - a_2 * filtered


def _span(p: Values) -> float:
    return max(abs(p["highest_command"]), abs(p["lowest_command"]))


@component(
    Parameter("sample_time", 5e-5, "s", (1e-7, 10.0), "period of the controller", "us"),
    Parameter(
        "filter_time", 1.6e-5, "s", (1e-9, 10.0), "lag of the anti-aliasing filter", "us", True
    ),
    Parameter("proportional_gain", 1e4, "V/m", (0.0, 1e12), "command per error", scale=1e4),
    Parameter("integral_gain", 1e8, "V/(m.s)", (0.0, 1e15), "command rate per error", scale=1e8),
    Parameter("feed_forward", 0.0, "V/m", (-1e12, 1e12), "command per reference", scale=1e5),
    Parameter("notch_frequency", 2000.0, "Hz", (1e-3, 1e7), "frequency that the notch takes out"),
    Parameter("notch_floor", 0.5, "1", (0.0, 10.0), "damping ratio of the notch's zeros"),
    Parameter("notch_width", 0.5, "1", (1e-3, 10.0), "damping ratio of the notch's poles"),
    Parameter("lowest_command", -2.0, "V", (-1e5, 1e5), "smallest command", scale=10.0),
    Parameter("highest_command", 12.0, "V", (-1e5, 1e5), "largest command", scale=10.0),
    Parameter("anti_windup", 1.0, "1", (0.0, 1.0), "share of the excess that leaves the integral"),
    State("filtered_position", "m", "position behind the filter", 1e-5, 0.0, "um"),
    Input("reference", "m", "position that is wanted", nominal=1e-5, display_unit="um"),
    Input("position", "m", "position that is measured", nominal=1e-5, display_unit="um"),
    Output("command", "V", "command to the amplifier", _span),
    description=(
        "sampled position controller: anti-aliasing filter, notch, PI by Tustin's rule,"
        " feed-forward, saturation with back-calculated integral"
    ),
    source=(
        "Astrom and Wittenmark, Computer-Controlled Systems, 3rd ed., ch. 8 (PI, Tustin's rule,"
        " anti-windup by tracking); notches for positioners: Fleming and Leang, Design, Modeling"
        " and Control of Nanopositioning Systems, 2014"
    ),
    equation_text=(
        "filter_time x_a' + x_a = x;  every sample_time: e = N (r - x_a);"
        "  I+ = I + (K_i T / 2) (e + e_last);"
        "  w = K_p e + I+ + K_f r;  v = min(max(w, low), high);  I = I+ + anti_windup (v - w);"
        "  N = (s^2 + 2 floor w_n s + w_n^2) / (s^2 + 2 width w_n s + w_n^2), Tustin at w_n"
    ),
    belongs_to="drive",
    sample_period="sample_time",
    sampled=(
        State("notch_first", "m", "first memory of the notch", 1e-5, 0.0, "um"),
        State("notch_second", "m", "second memory of the notch", 1e-5, 0.0, "um"),
        State("last_error", "m", "filtered error of the last instant", 1e-5, 0.0, "um"),
        State("integral", "V", "integral of the filtered error", _span),
        State("held_command", "V", "command held until the next instant", _span),
    ),
)
def position_controller(s: Symbols) -> Equations:
    """PI with a notch, feed-forward, saturation and anti-windup, in steps of the sample time."""
    error, first, second = _notch(s, s.reference - s.filtered_position)
    integral = s.integral + 0.5 * s.integral_gain * s.sample_time * (error + s.last_error)
    wanted = s.proportional_gain * error + integral + s.feed_forward * s.reference
    held = ca.fmin(ca.fmax(wanted, s.lowest_command), s.highest_command)
    return Equations(
        der={"filtered_position": (s.position - s.filtered_position) / s.filter_time},
        next={
            "notch_first": first,
            "notch_second": second,
            "last_error": error,
            "integral": integral + s.anti_windup * (held - wanted),
            "held_command": held,
        },
        out={"command": s.held_command},
    )


def _command_scale(p: Values) -> float:
    return voltage_scale(p) / abs(p["drive_gain"])


@component(
    Parameter("drive_gain", 1.0, "1", (1e-3, 1e4), "volts at the electrodes per command"),
    Parameter(
        "drive_time", 2e-5, "s", (1e-9, 1.0), "lag from command to electrodes", "us", log=True
    ),
    Parameter("compensation", 1.0, "1", (0.0, 1.5), "share of the force that is taken off"),
    Parameter("u_rated", 150.0, "V", (1e-3, 1e5), "rated voltage span, sets nominal sizes"),
    State("u", "V", "estimated voltage at the electrodes", voltage_scale),
    Input("command", "V", "command for a linear stack", nominal=_command_scale),
    Output("compensated_command", "V", "command that makes the stack linear", _command_scale),
    Output("hysteresis_force", "N", "estimated hysteresis force", hysteresis_scale),
    description="observer of the hysteresis force, fed back to make the stack linear",
    source="Yang and Zhu 2015, section 5.1: observer (37), compensation (39) to (41)",
    equation_text=(
        "v_c = v - compensation f_H_hat / (k_L G);  T_d u_hat' + u_hat = G v_c;"
        "  f_H_hat from u_hat by the stack's equation (8)"
    ),
    belongs_to="drive",
    needs=("linear_force", "bouc_wen"),
)
def hysteresis_compensator(s: Symbols) -> Equations:
    """`free_force - k_L u` is what `bouc_wen` and its extensions add to the linear force."""
    excess = s.free_force - s.k_L * s.u
    return Equations(
        der={"u": s.voltage_rate},
        add={
            "drive_voltage": s.drive_gain * s.command - s.compensation * excess / s.k_L,
            "voltage_rate": (s.drive_voltage - s.u) / s.drive_time,
        },
        out={"compensated_command": s.drive_voltage / s.drive_gain, "hysteresis_force": excess},
    )
