"""Effects of the drive: what an amplifier does to its command, or cannot do."""

import casadi as ca

from psa_casadi.model.component import Equations, Remedy, Symbols, effect
from psa_casadi.model.shapes import (
    ANGLES,
    BEND_TEXT,
    bend,
    delay,
    positive,
    shape_parameters,
    share,
    softplus,
    voltage_scale,
)
from psa_casadi.model.variables import Parameter, State, Values

#: Even exponent of the smooth clip; the larger, the sharper the corner.
_SHARPNESS = 8
#: Limits that are tried, as shares of the gain's scale: so close that one of them cuts only the
#: fastest steps, and leaves the others alone.
_TRIED = tuple(0.1 * 1.5**k for k in range(15))


def _scale(p: Values) -> float:
    """One over the current of a full swing in 10 ms."""
    return 1e-2 / (p["C_p"] * abs(p["u_rated"]))


@effect(
    Parameter("inverse_current_limit", 0.0, "1/A", (0.0, 1e9), "one over the limit", scale=_scale),
    kind="lag",
    description="the amplifier delivers at most a certain current",
    source="amplifier data sheets; C_p u' = sat(i, i_max)",
    belongs_to="drive",
    finite_step=_TRIED,
    equation_text="C_p u' = i / (1 + |i/i_max|^8)^(1/8),  inverse_current_limit = 1/i_max",
    remedy=Remedy("more_current", "slew"),
    looks_like="steps become ramps; the rate of the displacement is capped at one value",
)
def current_limit(s: Symbols) -> Equations:
    """Current limit: the amplifier delivers no more than a certain current; steps become ramps."""
    # i / (1 + (g i)^m)^(1/m) without overflow for large g i
    magnitude = ca.sqrt((s.inverse_current_limit * s.drive_current) ** 2 + 1e-30)
    larger = ca.fmax(1.0, magnitude)
    norm = larger * ((1 / larger) ** _SHARPNESS + (magnitude / larger) ** _SHARPNESS) ** (
        1 / _SHARPNESS
    )
    return Equations(add={"stack_current": s.drive_current * (1 / norm - 1)})


#: Width w of the rounded corner over rated voltage.
_WIDTH = 0.005


@effect(
    share("clip_gain", (0.0, 1.0), "share of the excess voltage that is lost", 0.1),
    share("clip_level", (0.3, 1.2), "level of the clip over rated voltage", 0.1, 0.6),
    kind="curve",
    description="the amplifier's output voltage saturates at a level",
    source="output swing of amplifier data sheets; softplus: Dugas et al., NIPS 13 (2000)",
    belongs_to="drive",
    equation_text=(
        "drive voltage = G v - clip_gain w ln(1 + exp((G v - clip_level u_rated)/w)),"
        "  w = 0.005 u_rated;  clip_gain = 1 is a hard clip"
    ),
    probe={"clip_level": (0.7, 0.85, 0.95)},
    remedy=Remedy("stay_below_level", "range"),
    looks_like="the displacement has flat tops at one level of the voltage, however high it goes",
)
def voltage_saturation(s: Symbols) -> Equations:
    """Voltage saturation: the amplifier puts out no more than a certain voltage.

    What exceeds the level, softplus(d) = w ln(1 + exp(d/w)) with d = G v - clip_level u_rated, is
    taken off: d below the level it vanishes (exactly so from 37 widths w on), above it is d, and
    the corner is rounded over the width. Only the upper end clips: a stack is driven from zero
    upward.
    """
    width = _WIDTH * s.u_rated
    excess = width * softplus((s.G * s.voltage - s.clip_level * s.u_rated) / width)
    return Equations(add={"drive_voltage": -s.clip_gain * excess})


#: Added to the time constant [s]; keeps the filter defined at zero lag, where the drive gains 0.
_FLOOR = 1e-6


@effect(
    delay("drive_lag_time", "time constant of the drive"),
    positive(
        "drive_lag_shape",
        0.25,
        "1",
        (1e-4, 2.0),
        "square of the second-order time over that of the first",
        limit=True,
    ),
    State("drive_lag_voltage", "V", "command behind the lag", voltage_scale),
    State("drive_lag_slope", "V", "its rate times the time constant", voltage_scale),
    kind="lag",
    description="the amplifier follows its command through a lag of second order",
    source=(
        "amplifier of finite bandwidth with one or two poles; Horowitz and Hill, The Art of"
        " Electronics"
    ),
    belongs_to="drive",
    finite_step=(0.0, 5.0, 20.0, 60.0),
    equation_text=(
        "drive voltage = v_d,  drive_lag_shape T^2 v_d'' + T v_d' + v_d = G v,  T = drive_lag_time"
    ),
    probe={"drive_lag_shape": (0.01, 0.4)},
    remedy=Remedy("better_drive", "slew"),
    looks_like=(
        "extra lag and roll-off with frequency, the same at every amplitude; the current lags too"
    ),
)
def drive_lag(s: Symbols) -> Equations:
    """Drive lag: the amplifier follows its command through a lag of second order.

    v_d = G v / (1 + s T + shape s^2 T^2): one pole for a shape of 0, two equal ones for 1/4, the
    maximally flat pair for 1/2. A single pole hardly differs from the base's R_s C_p.
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


@effect(
    share(
        "amplifier_gain",
        (-0.2, 0.2),
        "bow and S of the amplifier's curve over the rated voltage",
        0.002,
    ),
    *shape_parameters("amplifier"),
    kind="curve",
    description="the amplifier's gain changes with its output voltage",
    source="output-dependent gain of amplifiers: Horowitz and Hill, The Art of Electronics",
    belongs_to="drive",
    equation_text=(
        "drive voltage gains amplifier_gain u_rated b(G v/u_rated),  "
        + BEND_TEXT.format("amplifier")
    ),
    needs_column=("monitor_voltage",),
    probe={"amplifier_angle": ANGLES},
    remedy=Remedy("measure_voltage", "range"),
    looks_like="the voltage at the stack over the command is one bent curve for both branches",
)
def amplifier_nonlinearity(s: Symbols) -> Equations:
    """Amplifier nonlinearity: the amplifier's gain changes with its output.

    A stack whose strain per volt changes with the voltage bends the displacement in the same way,
    but for the hysteresis, which an amplifier bends as well. A monitor of the output voltage
    separates them: the effect is looked for if there is one.
    """
    share = s.G * s.voltage / s.u_rated
    bent = s.amplifier_gain * s.u_rated * bend(share, s.amplifier_angle, s.amplifier_wave)
    return Equations(add={"drive_voltage": bent})


@effect(
    share("leak_gain", (0.0, 1.0), "share of the charge that leaks away", 0.01),
    Parameter("leak_time", 3.0, "s", (1e-3, 1e5), "time constant of the leakage", log=True),
    State("leak_voltage", "V", "part that leaks away", voltage_scale, memory=True),
    kind="relaxation",
    description="a charge drive loses charge through its stabilising resistor",
    source=(
        "charge amplifier as a high-pass: Fleming and Moheimani, Rev. Sci. Instrum. 76 (2005)"
        " 073707"
    ),
    belongs_to="drive",
    equation_text="drive voltage = G v - leak_gain z,  leak_time z' + z = G v",
    finite_step=(1.0, 100.0),  # plain leakage takes the whole charge: far from a derivative at 0
    probe={"leak_time": (0.3, 3.0, 30.0)},
    remedy=Remedy("hold_charge", "hold"),
    looks_like="droop back after every step, exponential in time; less stroke at low frequencies",
)
def charge_leakage(s: Symbols) -> Equations:
    """Charge leakage: a charge drive holds its charge only for a while.

    A charge amplifier puts a charge proportional to its command on the stack. A resistor R across
    the capacitance that sets the charge keeps its offset from drifting away, and makes it a
    high-pass of time constant R C: q' = C G v' - q/(R C). So after a step the stack droops with
    exp(-t/leak_time), and below 1/(2 pi leak_time) the gain falls to 1 - leak_gain: 0 for plain
    leakage, more where the amplifier goes over to controlling the voltage. z is the part that
    leaks: 0 after a step, G v long after it. A record may begin before it has settled, so z is a
    memory.
    """
    return Equations(
        der={"leak_voltage": (s.G * s.voltage - s.leak_voltage) / s.leak_time},
        add={"drive_voltage": -s.leak_gain * s.leak_voltage},
    )
