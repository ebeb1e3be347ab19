"""The paper's model in plain NumPy and SciPy: the independent check of everything symbolic.

Written from H. Yang and W. Zhu, "A Modified Comprehensive Model for Piezoelectric Stack Actuators
and Corresponding Parameter Identification Method", 2015, in its letters and SI units (`'` is d/dt).
It knows no effects and shares no code with the symbolic model; it is for tests, not for fits::

    C_p u' = i,   i = (G v - u) / R_s                                       drive
    f_L = k_L u                                                             (7), f_0 = 0
    f_H' = A u' - beta |u'| sgn(f_H) r^n - gamma u' r^n + delta u sgn(u')   (8), r = |f_H| / h_ref
    tau f_out' + f_out = f_L + f_H                                          (9), as (13) uses it
    m_P y'' + c_P y' + k_P y = f_out                                        (4)
    m_B x'' + c_B (x' - y') + k_B (x - y) = c_P y' + k_P y + f_load         (5)
    m x'' + c x' + k x = f_out + f_load                                     (6), instead of (4), (5)

By definition the last term of (8) takes sgn(u'), as (28), (31) and (34) require, and a held voltage
leaves f_H at rest: `sgn(u') = u' / sqrt(u'^2 + hold_rate^2)`, `|u'| = u' sgn(u')`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import copysign, inf, nextafter, sqrt
from typing import Literal

import numpy as np
import scipy

from psa_casadi.common.errors import Problems
from psa_casadi.common.units import FloatArray

Signal = Callable[[float], float]
Mechanics = Literal["cascade", "single_mass"]

_STATES: dict[str, tuple[str, ...]] = {
    "cascade": ("u", "f_H", "f_out", "y", "v_y", "x", "v_x"),
    "single_mass": ("u", "f_H", "f_out", "x", "v_x"),
}
_POSITIVE = ("R_s", "C_p", "u_rated", "tau", "h_ref", "hold_rate")
_ANY_SIGN = ("G", "k_L", "A", "beta", "gamma", "delta", "n")
_MASS_SPRING = {"cascade": ("m_P", "k_P", "m_B", "k_B"), "single_mass": ("m", "k")}
_DAMPING = {"cascade": ("c_P", "c_B"), "single_mass": ("c",)}
_FAILURE = (
    "The reference integration between {:g} s and {:g} s failed. Either the voltage has a jump that"
    " is not among the breakpoints, or A, beta and gamma let f_H grow without bound; name the jump"
    " as a breakpoint or check these parameters."
)


@dataclass(frozen=True)
class Trajectory:
    """The response at the requested times; every array has the shape of `times`.

    `states` maps u [V], f_H [N], f_out [N], y [m], v_y [m/s] (cascade only), x [m], v_x [m/s]. The
    other fields are in m, m/s, A, C, N; `blocked_force` would hold the output at zero. At a jump,
    `current` belongs to `voltage(t)` as called.
    """

    times: FloatArray
    states: Mapping[str, FloatArray]
    displacement: FloatArray
    velocity: FloatArray
    current: FloatArray
    charge: FloatArray
    blocked_force: FloatArray


def simulate(
    parameters: Mapping[str, float],
    voltage: Signal,
    times: FloatArray,
    *,
    load_force: Signal | None = None,
    initial: Mapping[str, float] | None = None,
    breakpoints: Sequence[float] = (),
    mechanics: Mechanics = "cascade",
    rtol: float = 1e-10,
) -> Trajectory:
    """Integrate the model from `times[0]` and return it at `times` [s] (strictly increasing).

    `voltage` [V] and `load_force` [N] are functions of time, smooth between the `breakpoints` [s]:
    kinks and jumps belong there, and a segment uses the values just inside it. `initial` gives the
    states that do not start at 0. Parameters that the model does not have are ignored.

    LSODA is restarted at every breakpoint, at every reversal (u' = 0) and where u' leaves the band
    of a held voltage (|u'| = hold_rate). The error of a step is held below
    rtol (|state| + 0.01 size of the state at rated voltage).

    Raises InputError (parameters, states, times) and RuntimeError (the integration fails).
    """
    start = dict(initial or {})
    _check(parameters, times, start, mechanics, rtol)
    stack = _Stack(parameters, _STATES[mechanics])
    state = np.array([start.get(name, 0.0) for name in stack.names], dtype=np.float64)
    first, last = float(times[0]), float(times[-1])
    marks = sorted({first, last, *(float(b) for b in breakpoints if first < b < last)})
    columns = [state[:, None]]
    for begin, end in pairwise(marks):
        load = _inside(load_force or (lambda _: 0.0), begin, end)
        segment = _Segment(stack, _inside(voltage, begin, end), load)
        wanted = times[(times > begin) & (times <= end)]
        result, state = segment.integrate(begin, end, wanted, state, rtol)
        columns.append(result)
    return _trajectory(stack, np.array(times), np.hstack(columns), voltage)


def from_samples(times: FloatArray, values: FloatArray) -> Signal:
    """Return the line through the samples (constant outside); its kinks are breakpoints."""
    return lambda t: float(np.interp(t, times, values))


def _inside(signal: Signal, begin: float, end: float) -> Signal:
    """Return the signal as it is strictly between two breakpoints."""
    low, high = nextafter(begin, inf), nextafter(end, -inf)
    return lambda t: signal(min(max(t, low), high))


class _Stack:
    """The equations, for one set of parameters."""

    def __init__(self, p: Mapping[str, float], names: tuple[str, ...]) -> None:
        self.p = {name: float(value) for name, value in p.items()}
        self.names = names
        self.cascade = "y" in names

    def u_rate(self, v: float, u: float) -> float:
        """Return u' [V/s] of the electrodes at the command v [V]."""
        return (self.p["G"] * v - u) / (self.p["R_s"] * self.p["C_p"])

    def hysteresis_rate(self, u: float, f_H: float, u_rate: float) -> float:
        """Return f_H' [N/s], eq. (8)."""
        p = self.p
        sign = u_rate / sqrt(u_rate * u_rate + p["hold_rate"] * p["hold_rate"])
        power: float = (abs(f_H) / p["h_ref"]) ** p["n"]
        bend = p["beta"] * u_rate * sign * copysign(power, f_H) + p["gamma"] * u_rate * power
        return p["A"] * u_rate - bend + p["delta"] * u * sign

    def mechanics(self, f_out: float, load: float, motion: Sequence[float]) -> tuple[float, ...]:
        """Return the rates of (y, y', x, x') by (4) and (5), or of (x, x') by (6)."""
        p = self.p
        if not self.cascade:
            x, v_x = motion
            return v_x, (f_out + load - p["c"] * v_x - p["k"] * x) / p["m"]
        y, v_y, x, v_x = motion
        passed_on = p["c_P"] * v_y + p["k_P"] * y
        pull = p["c_B"] * (v_x - v_y) + p["k_B"] * (x - y)
        return v_y, (f_out - passed_on) / p["m_P"], v_x, (passed_on + load - pull) / p["m_B"]

    def sizes(self) -> FloatArray:
        """Return the size of each state at rated voltage [V, N, N, then m and m/s]."""
        p = self.p
        force = max(abs(p["k_L"]) * p["u_rated"], p["h_ref"])
        pairs = [("k_P", "m_P"), ("k_B", "m_B")] if self.cascade else [("k", "m")]
        stroke = force * sum(1.0 / p[k] for k, _ in pairs)
        speed = stroke * sqrt(min(p[k] / p[m] for k, m in pairs))
        return np.array([p["u_rated"], p["h_ref"], force, *[stroke, speed] * len(pairs)])


@dataclass(frozen=True)
class _Segment:
    """The stack under inputs that are smooth: the stretch between two breakpoints."""

    stack: _Stack
    voltage: Signal
    load: Signal

    def u_rate(self, t: float, s: FloatArray) -> float:
        return self.stack.u_rate(self.voltage(t), float(s[0]))

    def rates(self, t: float, s: FloatArray) -> list[float]:
        u, f_H, f_out, *motion = s.tolist()
        u_rate = self.stack.u_rate(self.voltage(t), u)
        bend = self.stack.hysteresis_rate(u, f_H, u_rate)
        lag = (self.stack.p["k_L"] * u + f_H - f_out) / self.stack.p["tau"]
        return [u_rate, bend, lag, *self.stack.mechanics(f_out, self.load(t), motion)]

    def integrate(
        self, begin: float, end: float, wanted: FloatArray, state: FloatArray, rtol: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the states at `wanted` (shape states x times) and the state at `end`."""
        columns: list[FloatArray] = []
        atol = 0.01 * rtol * self.stack.sizes()
        rate = self.u_rate(begin, state)
        side = 0 if abs(rate) <= self.stack.p["hold_rate"] else int(copysign(1, rate))
        while begin < end:
            grid, turn = np.union1d(wanted, [begin, end]), _Turn(self, side)
            solution = scipy.integrate.solve_ivp(
                self.rates, (begin, end), state, "LSODA", grid, events=turn, rtol=rtol, atol=atol
            )
            turns = solution.t_events[0] if solution.t_events else np.empty(0)
            if not (solution.success and np.isfinite(solution.y).all() and (turns > begin).all()):
                raise RuntimeError(_FAILURE.format(begin, end))
            if turns.size and solution.y_events:
                begin, state = float(turns[0]), solution.y_events[0][0]
            else:
                begin, state = end, solution.y[:, -1]
            side = 0 if side else int(copysign(1, self.u_rate(begin, state)))
            columns.append(solution.y[:, 1 : 1 + np.count_nonzero(wanted <= begin)])
            wanted = wanted[wanted > begin]
        return np.hstack(columns), state


class _Turn:
    """Stops where u' (of sign `side`) returns to 0, or a held voltage (`side` 0) starts to move."""

    terminal = True

    def __init__(self, segment: _Segment, side: int) -> None:
        self.segment, self.side = segment, side
        self.direction = -1.0 if side else 1.0

    def __call__(self, t: float, s: FloatArray) -> float:
        rate = self.segment.u_rate(t, s)
        return self.side * rate if self.side else abs(rate) - self.segment.stack.p["hold_rate"]


def _trajectory(stack: _Stack, times: FloatArray, s: FloatArray, voltage: Signal) -> Trajectory:
    p = stack.p
    states = dict(zip(stack.names, s, strict=True))
    command = np.array([voltage(float(t)) for t in times])
    blocked = states["f_out"]
    if stack.cascade:
        blocked = (p["c_P"] + p["c_B"]) * states["v_y"] + (p["k_P"] + p["k_B"]) * states["y"]
    u, x, v_x = states["u"], states["x"], states["v_x"]
    current = (p["G"] * command - u) / p["R_s"]
    return Trajectory(times, states, x, v_x, current, p["C_p"] * u, blocked)


def _check(
    p: Mapping[str, float], times: FloatArray, start: Mapping[str, float], kind: str, rtol: float
) -> None:
    problems = Problems()
    if kind not in _STATES:
        problems.add(f"The mechanics '{kind}' do not exist; use {' or '.join(_STATES)}.")
        problems.raise_if_any()
    positive = _POSITIVE + _MASS_SPRING[kind]
    missing = [name for name in positive + _DAMPING[kind] + _ANY_SIGN if name not in p]
    if missing:
        problems.add(f"The {kind} model needs values for {', '.join(missing)}; give them in SI.")
    for name in positive:
        if not 0.0 < p.get(name, 1.0) < inf:
            problems.add(f"{name} is {p[name]:g} but must be positive; check its sign and unit.")
    for name in set(start) - set(_STATES[kind]):
        known = ", ".join(_STATES[kind])
        problems.add(f"There is no state '{name}' to start from; the states are {known}.")
    if np.ndim(times) != 1 or np.size(times) < 2 or not np.all(np.diff(times) > 0.0):
        problems.add("The times do not increase strictly; give two or more, sorted, in seconds.")
    if not 1e-14 < rtol < 1e-2:
        problems.add(f"The tolerance rtol = {rtol:g} cannot be met; choose from 1e-6 to 1e-12.")
    problems.raise_if_any()
