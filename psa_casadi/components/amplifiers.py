"""Amplifiers in front of a stack: one that sets a voltage, one that sets a charge.

Both have a limit of the current into their load, as a limit of the output's rate, i_max / C_load.
"""

import casadi as ca

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.variables import Input, Output, Parameter, State, Values

#: Even exponent of the smooth limit; the larger, the sharper the corner.
_SHARPNESS = 8


def _limited(rate: Expression, limit: Expression) -> Expression:
    """Return `rate / (1 + |rate / limit|^8)^(1/8)`: 1 % low at 0.81 limits, never beyond 1."""
    return rate / (1.0 + (rate / limit) ** _SHARPNESS) ** (1.0 / _SHARPNESS)


def _full_swing(p: Values) -> float:
    return abs(p["gain"]) * 10.0


def _most(p: Values) -> float:
    return max(abs(p["highest_output"]), abs(p["lowest_output"]))


def _command(p: Values) -> float:
    """A command at which the output reaches the end of its range."""
    return 1.2 * _most(p) / abs(p["gain"])


def _current(p: Values) -> float:
    return p["current_limit"]


def _voltage_amplifier(s: Symbols) -> Equations:
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


_LIMITS = (
    Parameter("current_limit", 1.0, "A", (1e-6, 1e3), "largest output current", log=True),
    Parameter(
        "load_capacitance", 1.5e-6, "F", (1e-12, 1e-2), "capacitance of the load", "uF", log=True
    ),
)

VOLTAGE_AMPLIFIER = Component(
    name="voltage_amplifier",
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
    equations=_voltage_amplifier,
    parameters=(
        Parameter("gain", 10.0, "1", (1e-3, 1e4), "volts out per volt of command"),
        Parameter("bandwidth", 20e3, "Hz", (1e-2, 1e9), "small-signal bandwidth", "kHz", log=True),
        Parameter("lowest_output", -20.0, "V", (-1e5, 1e5), "lowest voltage", scale=100.0),
        Parameter("highest_output", 120.0, "V", (-1e5, 1e5), "highest voltage", scale=100.0),
        *_LIMITS,
    ),
    states=(State("amplified", "V", "voltage at the output", _most),),
    inputs=(Input("command", "V", "command", nominal=_command),),
    outputs=(
        Output("output_voltage", "V", "voltage at the output", _most),
        Output("load_current", "A", "current into the load", _current),
    ),
)


def _charge_amplifier(s: Symbols) -> Equations:
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


def _sensed(p: Values) -> float:
    return p["sense_capacitance"] * 10.0


CHARGE_AMPLIFIER = Component(
    name="charge_amplifier",
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
    equations=_charge_amplifier,
    parameters=(
        Parameter("gain", 10.0, "1", (1e-3, 1e4), "volts out per volt of command at rest"),
        Parameter("bandwidth", 3e3, "Hz", (1e-2, 1e9), "bandwidth of the loop", "kHz", log=True),
        Parameter(
            "sense_capacitance",
            15e-6,
            "F",
            (1e-12, 1.0),
            "charge per volt of command",
            "uF",
            log=True,
        ),
        Parameter("leak_time", 1.0, "s", (1e-4, 1e5), "time constant of the leakage", log=True),
        *_LIMITS,
    ),
    states=(
        State("amplified", "V", "voltage at the output", _full_swing),
        State("bypassed_charge", "C", "charge past load and sense capacitor", _sensed, 0.0, "uC"),
    ),
    inputs=(
        Input("command", "V", "command", nominal=10.0),
        Input("load_charge", "C", "charge on the load", nominal=1e-4, display_unit="uC"),
    ),
    outputs=(
        Output("output_voltage", "V", "voltage at the output", _full_swing),
        Output("sensed_charge", "C", "charge on the sense capacitor", _sensed, "uC"),
    ),
)
