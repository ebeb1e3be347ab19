"""Drive lag: the amplifier follows its command with a time constant, at every amplitude alike."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.scales import voltage_scale
from psa_casadi.variables import Parameter, State

#: Added to the time constant [s]; keeps the filter defined at zero lag. What the drive gains is
#: (1 + s floor)/(1 + s (T + floor)), the identity at T = 0.
_FLOOR = 1e-6


def _equations(s: Symbols) -> Equations:
    command, time = s.G * s.voltage, s.drive_lag_time + _FLOOR
    behind = s.drive_lag_voltage - command
    return Equations(
        der={"drive_lag_voltage": -behind / time},
        add={"drive_voltage": s.drive_lag_time / time * behind},
    )


DRIVE_LAG = Component(
    name="drive_lag",
    description="the amplifier follows its command with a time constant",
    source="single-pole amplifier of finite bandwidth; Horowitz and Hill, The Art of Electronics",
    belongs_to="drive",
    gain="drive_lag_time",
    finite_step=(0.0, 5.0, 20.0, 60.0),
    equation_text="drive voltage = v_d,  drive_lag_time v_d' + v_d = G v",
    parameters=(
        Parameter(
            "drive_lag_time", 0.0, "s", (0.0, 0.1), "time constant of the drive", "ms", scale=1e-4
        ),
    ),
    states=(State("drive_lag_voltage", "V", "command behind the lag", voltage_scale),),
    equations=_equations,
    looks_like=(
        "extra lag and roll-off with frequency, the same at every amplitude; the current lags too"
    ),
)
