"""Drive stage: amplifier with gain and output resistance, charging the stack's capacitance."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import charge_scale, current_scale, voltage_scale
from psa_casadi.variables import Input, Output, Parameter, State


def _drive(s: Symbols) -> Equations:
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


DRIVE = Component(
    name="drive",
    description="amplifier of gain G and output resistance R_s charging the stack (C_p)",
    source="circuit of a stack on a voltage amplifier; supplies u' to Yang and Zhu 2015, eq. 8",
    equations=_drive,
    equation_text="C_p u' = i,  i = (G v - u) / R_s",
    parameters=(
        Parameter("G", 1.0, "1", (1e-3, 1e4), "voltage gain of the amplifier"),
        Parameter(
            "R_s", 10.0, "Ohm", (1e-3, 1e7), "output resistance of amplifier and leads", log=True
        ),
        Parameter("C_p", 1.6e-6, "F", (1e-10, 1e-2), "capacitance of the stack", "uF", log=True),
        Parameter("u_rated", 150.0, "V", (1e-3, 1e5), "rated voltage span, sets nominal sizes"),
    ),
    states=(State("u", "V", "voltage at the stack's electrodes", voltage_scale),),
    inputs=(Input("voltage", "V", "voltage command to the amplifier", nominal=voltage_scale),),
    outputs=(
        Output("current", "A", "current into the stack", current_scale, "mA"),
        Output("charge", "C", "charge on the stack's electrodes", charge_scale, "uC"),
    ),
)
