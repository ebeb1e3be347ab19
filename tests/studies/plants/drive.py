"""Hidden effects before the stack: the amplifier and the voltage that it gives."""

import math
from dataclasses import replace

import numpy as np

from tests.studies.plants.base import (
    DrivePath,
    Run,
    first_order,
    follow,
    force_to_displacement,
    hysteresis_force,
    with_reversals,
)
from tests.studies.plants.effect import Draw, Parameters, hidden, of_drive
from tests.studies.plants.stack import FloatArray

MAX_PIECES = 6


def limited_drive(run: Run, slew: float) -> DrivePath:
    """Voltage on the stack when |u'| is at most `slew` [V/s]."""
    time, command = run.path.time, run.fine_command
    step, constant = run.fine_step, run.stack.drive_time
    lag = 0.0
    voltage = [float(command[0])]
    cut: list[int] = []
    wait: list[float] = []
    for index, slope in enumerate((np.diff(command) / step).tolist()):
        start = lag
        lag = _advance(lag, slope, step, slew, constant)
        if start * lag < 0.0:
            instant = _zero(start, slope, slew, constant)
            if 0.0 < instant < step:
                cut.append(index)
                wait.append(instant)
        voltage.append(float(command[index + 1]) - lag)
    places = np.asarray(cut, dtype=np.intp)
    waits = np.asarray(wait, dtype=np.float64)
    extreme = command[places] + (command[places + 1] - command[places]) / step * waits
    return with_reversals(time, np.asarray(voltage), places, waits, extreme)


def _advance(lag: float, slope: float, step: float, slew: float, constant: float) -> float:
    """v - u after `step`: pieces of lag' = slope - clip(lag / constant)."""
    edge = slew * constant
    for _ in range(MAX_PIECES):
        if step <= 0.0 or (lag == 0.0 and slope == 0.0):
            return lag
        clipped = abs(lag) > edge * (1.0 + 1e-12) or (
            abs(lag) >= edge * (1.0 - 1e-12) and slope * lag > 0.0 and abs(slope) > slew
        )
        if clipped:
            sign = math.copysign(1.0, lag)
            rate = slope - sign * slew
            leave = (sign * edge - lag) / rate if rate * sign < 0.0 else math.inf
            used = min(step, leave)
            lag += rate * used
        else:
            rest = slope * constant
            used = min(step, _enter(lag, rest, edge, constant))
            lag = rest + (lag - rest) * math.exp(-used / constant)
        step -= used
    return lag


def _enter(lag: float, rest: float, edge: float, constant: float) -> float:
    """Time after which the free lag, which tends to `rest`, reaches the edge of the clip [s]."""
    if abs(rest) <= edge:
        return math.inf
    target = math.copysign(edge, rest)
    return max(0.0, constant * math.log((rest - lag) / (rest - target)))


def _zero(lag: float, slope: float, slew: float, constant: float) -> float:
    """Time at which the lag changes sign, u = v [s]: first the clipped part, then the free one."""
    edge = slew * constant
    clipped = 0.0
    if abs(lag) > edge:
        sign = math.copysign(1.0, lag)
        clipped = (sign * edge - lag) / (slope - sign * slew)
        lag = sign * edge
    rest = slope * constant
    return clipped + constant * math.log((rest - lag) / rest)


def _limited(run: Run, gain: float) -> tuple[DrivePath, FloatArray, FloatArray]:
    """Path, force, and what the limit adds to the fine displacement, (M,) [m]."""
    path = limited_drive(run, 1.0 / gain)
    force = hysteresis_force(run.stack, path) + run.stack.k_l * path.voltage
    return path, force, force_to_displacement(run.stack, force - run.force, run.fine_step)


def _behind_limit(run: Run, _: Parameters, gain: float) -> Run:
    """The stack behind the limit; its command gives the same voltage without a limit."""
    path, force, fine = _limited(run, gain)
    edge = run.stack.drive_time / gain
    command = path.voltage + np.clip(run.fine_command - path.voltage, -edge, edge)
    moved = run.fine_displacement + fine
    return replace(run, fine_command=command, path=path, force=force, fine_displacement=moved)


@hidden("1/s", "s/V", (1e-5, 1e-3), driven=_behind_limit)
def current_limit(run: Run, _: Parameters, gain: float) -> FloatArray:
    """An amplifier that cannot deliver more than a certain current: |u'| is clipped hard.

        u' = max(-s, min(s, (v - u)/(R_s C_p))),   s = i_max/C_p

    Each sub-interval is solved piece by piece (exponential while free, straight line while
    clipped), with the instants of entering and leaving the clip and of every reversal in
    closed form. Hysteresis, lag and mechanics are those of the base. Source: the data sheet
    of any piezo amplifier (10-300 mA). Not the project's form: the clip is hard, not
    smoothed, and solved by events.

    gain is 1/s [s/V], so that 0 means no limit.
    """
    return _limited(run, gain)[2][:: run.sub_intervals]


@of_drive("g", "1", (1e-3, 0.4))
def voltage_saturation(run: Run, _: Parameters, gain: float) -> Run:
    """An amplifier whose supply is too low: the command is clipped hard before the drive.

        v -> min(v, v_max),   v_max = (1 - g) max(v)

    The clipped command goes through drive, hysteresis and mechanics again. Source: data
    sheets. Not the project's form: a corner, not a smooth limit, and before the drive.

    g is the share of the highest command that is cut.
    """
    return follow(run, np.minimum(run.fine_command, (1.0 - gain) * float(run.command.max())))


@of_drive("T", "s", (2e-5, 4e-3), refit=True, drawn=lambda d: {"zeta": d.uniform(0.7, 0.95)})
def drive_lag(run: Run, p: Parameters, gain: float) -> Run:
    """An amplifier of second order between command and drive.

        T^2 v_f'' + 2 zeta T v_f' + v_f = v

    by one complex pole p = (-zeta + i sqrt(1 - zeta^2))/T, exact for a command that is
    linear between samples: v_f = Im z/(T sqrt(1 - zeta^2)), z' = p z + v. The filtered
    command goes through drive, hysteresis and mechanics again. g = T. A single pole would
    do for the physics, but no record shows it: a larger R_s C_p takes it over to within a
    tenth of the noise. Source: error amplifier and output filter of any piezo amplifier
    with a capacitive load; bandwidth 40 Hz to 8 kHz in data sheets. Not the project's form:
    one complex pair, no further state in the balance of the drive.
    """
    damped = math.sqrt(1.0 - p["zeta"] ** 2)
    pole = complex(-p["zeta"], damped) / gain
    passed = first_order(pole, run.fine_command, run.fine_step).imag / (gain * damped)
    return follow(run, passed)


def _leak(d: Draw) -> dict[str, float]:
    """T [s] between 2 and 40 % of the record's length."""
    return {"t": d.length * math.exp(d.uniform(math.log(0.02), math.log(0.4)))}


@of_drive("g", "1", (5e-4, 0.9), drawn=_leak)
def charge_leakage(run: Run, p: Parameters, gain: float) -> Run:
    """Charge that leaks away: the voltage on the stack droops behind a first-order high-pass.

        v -> v - g w,   T w' + w = v

    g: share of the charge that leaks in the end; T = R C of insulation and coupling
    capacitor. Exact for a command that is linear between samples; the result goes through
    drive, hysteresis and mechanics again. Source: charge amplifiers, e.g. A. J. Fleming and
    S. O. R. Moheimani, "A grounded-load charge amplifier for reducing hysteresis in
    piezoelectric tube scanners", Rev. Sci. Instrum. 76 (2005) 073707. Not the project's
    form: a mix of the command with its low-pass, no balance of charge.
    """
    droop = first_order(-1.0 / p["t"] + 0j, run.fine_command, run.fine_step).real / p["t"]
    return follow(run, run.fine_command - gain * droop)
