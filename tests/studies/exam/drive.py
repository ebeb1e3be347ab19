"""Causes between the command and the voltage on the stack: amplifier, cable, leakage [V]."""

import math
from collections.abc import Callable

import numpy as np

from tests.studies.exam.linear import filtered, lagged, resonant
from tests.studies.exam.record import Floats, Run, Values

DriveCause = Callable[[Floats, Run, Values], Floats]


def _gain(command: Floats, run: Run, values: Values) -> Floats:
    """v + a_2 v^2/V + a_3 v^3/V^2, V the largest voltage."""
    largest = run.record.test.largest
    return command + values[0] * command**2 / largest + values[1] * command**3 / largest**2


def _dead_time(command: Floats, run: Run, values: Values) -> Floats:
    """The command, a time [s] later."""
    return np.interp(run.times - values[0], run.times, command)


def _lag(command: Floats, run: Run, values: Values) -> Floats:
    """Second order: frequency [Hz] and damping."""
    return resonant(command, values[0], values[1], run.step)


def _output_limit(command: Floats, run: Run, values: Values) -> Floats:
    """No more than a share of the highest voltage."""
    return np.minimum(command, values[0] * run.record.test.limits[1])


def _slew_limit(command: Floats, run: Run, values: Values) -> Floats:
    """A largest rate [V/s]."""
    most, out = values[0] * run.step, command[0]
    outs = []
    for x in command.tolist():
        out += max(-most, min(most, x - out))
        outs.append(out)
    return np.array(outs)


def _controller(reference: Floats, run: Run, values: Values) -> Floats:
    """PI controller around the stack, whose reference is recorded in place of the voltage.

    c = k_p e + integral of k_i e, e = r less a reading that comes late; the stack has R_s C_p and
    Bouc-Wen's hysteresis of n = 1. `values`: k_p, k_i [1/s], delay [s].
    """
    proportional, integral, delay = values
    late = max(1, int(delay / run.step))
    A, beta = -0.3, 0.3 / (0.05 * run.record.test.span)
    u = total = float(reference[0])
    h, readings, drive = 0.0, [u] * late, []
    for i, r in enumerate(reference.tolist()):
        error = r - readings[i]
        total += integral * run.step * error
        drive.append(total + proportional * error)
        du = (drive[-1] - u) * run.step / run.record.stack.lag
        u += du
        h += A * du - beta * abs(du) * h
        readings.append(u + h)
    return np.array(drive)


def _current_limit(command: Floats, run: Run, values: Values) -> Floats:
    """R_s C_p whose voltage changes no faster than a rate [V/s]."""
    reached = 1 - math.exp(-run.step / run.record.stack.lag)
    most, u = values[0] * run.step, command[0]
    outs = []
    for x in command.tolist():
        u += max(-most, min(most, (x - u) * reached))
        outs.append(u)
    return np.array(outs)


#: Causes of the amplifier, in the order of the signal.
AMPLIFIER: dict[str, DriveCause] = {
    "amplifier gain": _gain,
    "dead time": _dead_time,
    "amplifier lag": _lag,
    "output limit": _output_limit,
    "slew limit": _slew_limit,
    "controller": _controller,
}
#: Causes of the stack's electrical side.
ELECTRICAL = ("current limit", "leakage")


def amplified(command: Floats, run: Run) -> Floats:
    """Return the amplifier's output."""
    for name, cause in AMPLIFIER.items():
        if name in run.record.hidden:
            command = cause(command, run, run.record.hidden[name])
    return command


def stack_voltage(output: Floats, run: Run) -> Floats:
    """Return the voltage on the stack behind R_s C_p, of which a leak keeps what is fast."""
    hidden = run.record.hidden
    if "current limit" in hidden:
        u = _current_limit(output, run, hidden["current limit"])
    else:
        u = lagged(output, run.record.stack.lag, run.step)
    if "leakage" in hidden:
        (time,) = hidden["leakage"]
        u = u[0] + filtered([time, 0.0], [time, 1.0], u - u[0], run.step)
    return u
