"""A hysteresis compensator: the stack's own hysteresis force, observed and taken off the command.

The observer runs eq. (8) on the voltage that it commands itself, as eq. (37) does: what leaves the
compensator is v - f_H_hat / (k_L G), and f_H_hat' follows from the voltage that this puts on the
electrodes, behind the lag T_d of amplifier, output resistance and capacitance. Both u_hat and
f_H_hat are states, so there is no algebraic loop. With the stack's own parameters the generated
force is k_L G v after the lag, without hysteresis.
"""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import voltage_scale
from psa_casadi.variables import Input, Output, Parameter, State, Values


def _hysteresis_compensator(s: Symbols) -> Equations:
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


def _command_scale(p: Values) -> float:
    return voltage_scale(p) / abs(p["drive_gain"])


def _force_scale(p: Values) -> float:
    return 0.1 * abs(p["k_L"]) * voltage_scale(p)


HYSTERESIS_COMPENSATOR = Component(
    name="hysteresis_compensator",
    description="observer of the hysteresis force, fed back to make the stack linear",
    source="Yang and Zhu 2015, section 5.1: observer (37), compensation (39) to (41)",
    equation_text=(
        "v_c = v - compensation f_H_hat / (k_L G);  T_d u_hat' + u_hat = G v_c;"
        "  f_H_hat from u_hat by the stack's own equation (8)"
    ),
    belongs_to="drive",
    needs=("linear_force", "bouc_wen"),
    equations=_hysteresis_compensator,
    parameters=(
        Parameter("drive_gain", 1.0, "1", (1e-3, 1e4), "volts at the electrodes per command"),
        Parameter(
            "drive_time", 2e-5, "s", (1e-9, 1.0), "lag from command to electrodes", "us", log=True
        ),
        Parameter("compensation", 1.0, "1", (0.0, 1.5), "share of the force that is taken off"),
        Parameter("u_rated", 150.0, "V", (1e-3, 1e5), "rated voltage span, sets nominal sizes"),
    ),
    states=(State("u", "V", "estimated voltage at the electrodes", voltage_scale),),
    inputs=(Input("command", "V", "command for a linear stack", nominal=_command_scale),),
    outputs=(
        Output("compensated_command", "V", "command that makes the stack linear", _command_scale),
        Output("hysteresis_force", "N", "estimated hysteresis force", _force_scale),
    ),
)
