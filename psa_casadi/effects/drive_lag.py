"""Drive lag: the amplifier follows its command through a lag of second order, at every amplitude.

v_d = G v / (1 + s T + shape s^2 T^2): one pole for a shape of 0, two equal ones for 1/4, the
maximally flat pair for 1/2. Beside the base's R_s C_p a single pole hardly shows.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.scales import voltage_scale
from psa_casadi.variables import Parameter, State

#: Added to the time constant [s]; keeps the filter defined at zero lag, where the drive gains 0.
_FLOOR = 1e-6


def _drive_lag(s: Symbols) -> Equations:
    """Drive lag: the amplifier follows its command through a lag of second order.

    v_d = G v / (1 + s T + shape s^2 T^2): one pole for a shape of 0, two equal ones for 1/4, the
    maximally flat pair for 1/2. Beside the base's R_s C_p a single pole hardly shows.
    """
    command, time = s.G * s.voltage, s.drive_lag_time + _FLOOR
    behind = s.drive_lag_voltage - command
    return Equations(
        der={
            "drive_lag_voltage": s.drive_lag_slope / time,
            "drive_lag_slope": -(behind + s.drive_lag_slope) / (s.drive_lag_shape * time),
        },
        add={"drive_voltage": s.drive_lag_time / time * behind},
    )


DRIVE_LAG = Component(
    name="drive_lag",
    description="the amplifier follows its command through a lag of second order",
    source=(
        "amplifier of finite bandwidth with one or two poles; Horowitz and Hill, The Art of"
        " Electronics"
    ),
    belongs_to="drive",
    gain="drive_lag_time",
    finite_step=(0.0, 5.0, 20.0, 60.0),
    equation_text=(
        "drive voltage = v_d,  drive_lag_shape T^2 v_d'' + T v_d' + v_d = G v,  T = drive_lag_time"
    ),
    parameters=(
        Parameter(
            "drive_lag_time", 0.0, "s", (0.0, 0.1), "time constant of the drive", "ms", scale=1e-4
        ),
        Parameter(
            "drive_lag_shape",
            0.25,
            "1",
            (1e-4, 2.0),
            "square of the second-order time over that of the first",
            log=True,
            limit=True,
        ),
    ),
    states=(
        State("drive_lag_voltage", "V", "command behind the lag", voltage_scale),
        State("drive_lag_slope", "V", "its rate times the time constant", voltage_scale),
    ),
    equations=_drive_lag,
    probe={"drive_lag_shape": (0.01, 0.4)},
    remedy=Remedy("better_drive", "slew"),
    looks_like=(
        "extra lag and roll-off with frequency, the same at every amplitude; the current lags too"
    ),
)
