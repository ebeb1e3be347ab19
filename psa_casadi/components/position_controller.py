"""A sampled position controller: notch, PI, feed-forward, saturation with anti-windup."""

import casadi as ca

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.variables import Input, Output, Parameter, State, Values

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


def _position_controller(s: Symbols) -> Equations:
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


def _span(p: Values) -> float:
    return max(abs(p["highest_command"]), abs(p["lowest_command"]))


POSITION_CONTROLLER = Component(
    name="position_controller",
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
    equations=_position_controller,
    sample_period="sample_time",
    parameters=(
        Parameter("sample_time", 5e-5, "s", (1e-7, 10.0), "period of the controller", "us"),
        Parameter(
            "filter_time",
            1.6e-5,
            "s",
            (1e-9, 10.0),
            "lag of the anti-aliasing filter",
            "us",
            log=True,
        ),
        Parameter("proportional_gain", 1e4, "V/m", (0.0, 1e12), "command per error", scale=1e4),
        Parameter(
            "integral_gain", 1e8, "V/(m.s)", (0.0, 1e15), "command rate per error", scale=1e8
        ),
        Parameter("feed_forward", 0.0, "V/m", (-1e12, 1e12), "command per reference", scale=1e5),
        Parameter(
            "notch_frequency", 2000.0, "Hz", (1e-3, 1e7), "frequency that the notch takes out"
        ),
        Parameter("notch_floor", 0.5, "1", (0.0, 10.0), "damping ratio of the notch's zeros"),
        Parameter("notch_width", 0.5, "1", (1e-3, 10.0), "damping ratio of the notch's poles"),
        Parameter("lowest_command", -2.0, "V", (-1e5, 1e5), "smallest command", scale=10.0),
        Parameter("highest_command", 12.0, "V", (-1e5, 1e5), "largest command", scale=10.0),
        Parameter(
            "anti_windup", 1.0, "1", (0.0, 1.0), "share of the excess that leaves the integral"
        ),
    ),
    states=(
        State("filtered_position", "m", "position behind the filter", 1e-5, display_unit="um"),
    ),
    sampled=(
        State("notch_first", "m", "first memory of the notch", 1e-5, display_unit="um"),
        State("notch_second", "m", "second memory of the notch", 1e-5, display_unit="um"),
        State("last_error", "m", "filtered error of the last instant", 1e-5, display_unit="um"),
        State("integral", "V", "integral of the filtered error", _span),
        State("held_command", "V", "command held until the next instant", _span),
    ),
    inputs=(
        Input("reference", "m", "position that is wanted", nominal=1e-5, display_unit="um"),
        Input("position", "m", "position that is measured", nominal=1e-5, display_unit="um"),
    ),
    outputs=(Output("command", "V", "command to the amplifier", _span),),
)
