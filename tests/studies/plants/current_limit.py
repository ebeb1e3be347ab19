"""An amplifier that cannot deliver more than a certain current: |u'| is clipped hard.

    u' = max(-s, min(s, (v - u)/(R_s C_p))),   s = i_max/C_p

Each sub-interval is solved piece by piece (exponential while free, straight line while clipped),
with the instants of entering and leaving the clip and of every reversal in closed form.
Hysteresis, lag and mechanics are those of the base. Source: the data sheet of any piezo amplifier
(10-300 mA). Not the project's form: the clip is hard, not smoothed, and solved by events.
"""

import math
from dataclasses import replace

import numpy as np

from tests.studies.plants.base import (
    DrivePath,
    Run,
    force_to_displacement,
    hysteresis_force,
    with_reversals,
)
from tests.studies.plants.effect import HiddenEffect, Parameters
from tests.studies.plants.stack import FloatArray

MAX_PIECES = 6


def draw(rng: np.random.Generator, run: Run) -> dict[str, float]:
    """A hard clip has no secondary parameters."""
    del rng, run
    return {}


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


def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
    """Limited minus unlimited displacement; gain is 1/s [s/V], so that 0 means no limit."""
    del parameters
    if gain == 0.0:
        return np.zeros_like(run.times)
    path = limited_drive(run, 1.0 / gain)
    force = hysteresis_force(run.stack, path) + run.stack.k_l * path.voltage
    fine = force_to_displacement(run.stack, force - run.force, run.fine_step)
    return fine[:: run.sub_intervals]


def driven(run: Run, parameters: Parameters, gain: float) -> Run:
    """The stack behind the limit; its command is what would drive it so without one."""
    del parameters
    path, constant = limited_drive(run, 1.0 / gain), run.stack.drive_time
    force = hysteresis_force(run.stack, path) + run.stack.k_l * path.voltage
    fine = force_to_displacement(run.stack, force - run.force, run.fine_step)
    edge = constant / gain
    command = path.voltage + np.clip(run.fine_command - path.voltage, -edge, edge)
    moved = run.fine_displacement + fine
    return replace(run, fine_command=command, path=path, force=force, fine_displacement=moved)


CURRENT_LIMIT = HiddenEffect(
    "current_limit", "1/s", "s/V", draw, contribution, (1e-5, 1e-3), linear=False, driven=driven
)
