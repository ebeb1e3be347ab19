"""The base physics of the records, not solved as one set of differential equations.

Equations (u voltage on the stack, v command, piecewise linear between samples):

    drive       R_s C_p u' = v - u
    hysteresis  df_H = A du - r^n (beta sgn(f_H) |du| + gamma du) + delta u sgn(u') dt
                r = |f_H|/h_ref
    mechanics   five poles and a zero from force to displacement, paper eq. (10), (13)

The drive is exact on every sub-interval (one exponential). The hysteresis takes fourth-order
Runge-Kutta steps along the path of u, which is cut at every reversal of u (in closed form).
The mechanics is a sum of partial fractions, one first-order recursion for each pole, exact for a
force that is linear on each sub-interval. The elastic part k_L u goes from v to the displacement
through six poles, exact without any sub-division.

Source: H. Yang and W. Zhu 2015, eq. (4), (5), (7), (8), (9), (13). Shapes: N samples, m
sub-intervals for each sampling interval, M = m (N - 1) + 1 fine nodes. Everything starts at rest
with v(0) = 0.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tests.studies.plants.stack import ComplexArray, FloatArray, Stack

SUB_INTERVALS = 48
"""Sub-intervals of one sampling interval; four times as many change the displacement by less than
2e-5 of its range.
"""


@dataclass(frozen=True)
class DrivePath:
    """Voltage on the stack.

    time, voltage: (M,) on the fine grid [s, V]. path_time, path_voltage: (M + reversals,) the same
    with every reversal inserted. node: (M,) position of each fine node in the path.
    """

    time: FloatArray
    voltage: FloatArray
    path_time: FloatArray
    path_voltage: FloatArray
    node: np.ndarray[tuple[int, ...], np.dtype[np.intp]]


@dataclass(frozen=True)
class Run:
    """One simulation of the base: all an effect needs to add itself.

    times, command, displacement: (N,) at the samples [s, V, m]; fine_command: (M,) what drives the
    stack [V]; path: the drive; force: (M,) f_L + f_H [N]; fine_displacement: (M,) [m];
    sub_intervals: m.
    """

    stack: Stack
    times: FloatArray
    command: FloatArray
    fine_command: FloatArray
    path: DrivePath
    force: FloatArray
    fine_displacement: FloatArray
    sub_intervals: int

    @property
    def displacement(self) -> FloatArray:
        """Displacement at the samples, (N,) [m]."""
        return self.fine_displacement[:: self.sub_intervals]

    @property
    def fine_step(self) -> float:
        """Length of a sub-interval [s]."""
        return float(self.times[1] - self.times[0]) / self.sub_intervals


def simulate_base(
    stack: Stack, times: FloatArray, command: FloatArray, sub_intervals: int = SUB_INTERVALS
) -> Run:
    """Simulate the paper's model for a voltage at uniform times, (N,) [s], (N,) [V]."""
    fine_time, fine_command = refine(times, command, sub_intervals)
    return _driven(stack, times, command, fine_time, fine_command, sub_intervals)


def follow(run: Run, command: FloatArray) -> Run:
    """The same stack driven by another command on the fine grid, (M,) [V], linear in between."""
    fine_time = run.path.time
    return _driven(run.stack, run.times, run.command, fine_time, command, run.sub_intervals)


def _driven(
    stack: Stack, times: FloatArray, command: FloatArray, fine_time: FloatArray,
    fine_command: FloatArray, sub_intervals: int,
) -> Run:  # fmt: skip
    step = float(times[1] - times[0]) / sub_intervals
    path = linear_drive(stack, fine_time, fine_command, step)
    hysteresis = hysteresis_force(stack, path)
    displacement = elastic_displacement(stack, fine_command, step)
    displacement = displacement + force_to_displacement(stack, hysteresis, step)
    force = stack.k_l * path.voltage + hysteresis
    return Run(stack, times, command, fine_command, path, force, displacement, sub_intervals)


def refine(
    times: FloatArray, command: FloatArray, sub_intervals: int
) -> tuple[FloatArray, FloatArray]:
    """Put m - 1 nodes into each sampling interval, the command being linear there."""
    count = sub_intervals * (times.size - 1) + 1
    fine = np.linspace(float(times[0]), float(times[-1]), count)
    return fine, np.interp(np.arange(count) / sub_intervals, np.arange(times.size), command)


def linear_drive(stack: Stack, time: FloatArray, command: FloatArray, step: float) -> DrivePath:
    """Voltage behind the resistance: u(t + h) = exp(-h/T) u(t) + exact weights for a linear
    command.

    A reversal inside a sub-interval lies where u = v: with the command's slope q and the rate
    u'(0), exp(-s/T) = q / (q - u'(0)).
    """
    constant = stack.drive_time
    voltage = first_order(-1.0 / constant + 0j, command, step).real / constant
    rate = (command - voltage) / constant
    slope = np.diff(command) / step
    cut = np.flatnonzero((rate[:-1] * rate[1:] < 0.0) & (slope * rate[:-1] < 0.0))
    wait = -constant * np.log(slope[cut] / (slope[cut] - rate[cut]))
    return with_reversals(time, voltage, cut, wait, command[cut] + slope[cut] * wait)


def with_reversals(
    time: FloatArray,
    voltage: FloatArray,
    cut: np.ndarray[tuple[int, ...], np.dtype[np.intp]],
    wait: FloatArray,
    extreme: FloatArray,
) -> DrivePath:
    """Insert the reversals that lie `wait` [s] after the fine nodes `cut`, at the voltages
    `extreme` [V].
    """
    node = np.arange(time.size) + np.searchsorted(cut, np.arange(time.size), side="left")
    path_time = np.insert(time, cut + 1, time[cut] + wait)
    path_voltage = np.insert(voltage, cut + 1, extreme)
    return DrivePath(time, voltage, path_time, path_voltage, node)


def hysteresis_force(stack: Stack, path: DrivePath, branch: float = 0.0) -> FloatArray:
    """Hysteresis force of Bouc and Wen at the fine nodes, (M,) [N]; fourth-order Runge-Kutta steps
    along the path.

    branch [N/V]: a further loss - branch r^n |du| that has one sign on both branches; 0 in the
    paper's model.
    """
    du = np.diff(path.path_voltage)
    dt = np.maximum(np.diff(path.path_time), 1e-300)
    rate = du / dt
    sign = rate / np.hypot(rate, stack.hold_rate)
    middle = 0.5 * (path.path_voltage[1:] + path.path_voltage[:-1])
    free = stack.a * du + stack.delta * middle * sign * dt
    back = stack.gamma * du
    loss = stack.beta * du * sign
    both = branch * du * sign
    force, inverse, n = 0.0, 1.0 / stack.h_ref, stack.n
    out = [0.0]
    ups, downs = (back + both + loss).tolist(), (back + both - loss).tolist()
    for add, up, down in zip(free.tolist(), ups, downs, strict=True):
        if add != 0.0:
            k1 = add - (abs(force) * inverse) ** n * (up if force > 0.0 else down)
            half = force + 0.5 * k1
            k2 = add - (abs(half) * inverse) ** n * (up if half > 0.0 else down)
            half = force + 0.5 * k2
            k3 = add - (abs(half) * inverse) ** n * (up if half > 0.0 else down)
            half = force + k3
            k4 = add - (abs(half) * inverse) ** n * (up if half > 0.0 else down)
            force += (k1 + 2.0 * (k2 + k3) + k4) / 6.0
        out.append(force)
    return np.asarray(out)[path.node]


def elastic_displacement(stack: Stack, command: FloatArray, step: float) -> FloatArray:
    """Displacement of k_L u alone, from the command through drive, lag and mechanics, (M,) [m]."""
    poles = np.append(stack.force_poles(), -1.0 / stack.drive_time)
    gain = stack.k_l / stack.drive_time * _numerator_scale(stack)
    return modal_sum(poles, _numerator(stack, poles) * gain, command, step)


def force_to_displacement(stack: Stack, force: FloatArray, step: float) -> FloatArray:
    """Displacement of a force that is linear on each sub-interval, through lag and mechanics, (M,)
    [m].
    """
    poles = stack.force_poles()
    return modal_sum(poles, _numerator(stack, poles) * _numerator_scale(stack), force, step)


def _numerator(stack: Stack, poles: ComplexArray) -> ComplexArray:
    return (stack.c_b + stack.c_p) * poles + (stack.k_b + stack.k_p)


def _numerator_scale(stack: Stack) -> float:
    return 1.0 / (stack.tau * stack.m_p * stack.m_b)


def modal_sum(
    poles: ComplexArray, numerator: ComplexArray, x: FloatArray, step: float
) -> FloatArray:
    """Response of numerator(s) / prod(s - p_i) by partial fractions; conjugate poles are taken
    once.
    """
    total = np.zeros(x.size)
    for index, pole in enumerate(poles):
        if pole.imag < 0.0:
            continue
        residue = numerator[index] / np.prod(pole - np.delete(poles, index))
        total += (1.0 if pole.imag == 0.0 else 2.0) * (residue * first_order(pole, x, step)).real
    return total


def first_order(pole: complex, x: FloatArray, step: float) -> ComplexArray:
    """Solve z' = pole z + x from rest, exactly for x linear on each step, (M,)."""
    ph = complex(pole) * step
    growth = np.exp(ph)
    new = (growth - 1.0 - ph) / (ph * complex(pole))
    old = (growth - 1.0) / complex(pole) - new
    driven = lfilter([new, old], [1.0, -growth], x.astype(np.complex128))
    z = np.asarray(driven, dtype=np.complex128)
    if x[0] != 0.0:
        z = z - new * x[0] * growth ** np.arange(x.size)
    return z
