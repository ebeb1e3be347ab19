"""The closed loop of a positioner in plain Python: controller, amplifier, stack and stage."""

from collections.abc import Callable, Mapping
from functools import partial
from math import copysign, pi, sqrt, tan
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import odeint

from psa_casadi.common.units import FloatArray

Values = Mapping[str, float]

#: States: filter, compensator (u, f_H), amplifier, stack (7), stage (2); their usual sizes.
_SIZES = np.array([1e-5, 1e2, 1e2, 1e2, 1e2, 1e2, 1e3, 1e-5, 1e-1, 1e-5, 1e-1, 1e-5, 1e-2])


class Run(NamedTuple):
    """At the instants: stage and tip of the stack [m], command and voltage at the stack [V]."""

    time: FloatArray
    position: FloatArray
    tip: FloatArray
    command: FloatArray
    voltage: FloatArray


def hysteresis_rate(p: Values, u: float, rate: float, force: float) -> float:
    """Return f_H' [N/s] by eq. (8), a voltage below `hold_rate` held."""
    sign = rate / sqrt(rate * rate + p["hold_rate"] ** 2)
    power: float = (abs(force) / p["h_ref"]) ** p["n"]
    bend = p["beta"] * rate * sign * copysign(power, force) + p["gamma"] * rate * power
    return p["A"] * rate - bend + p["delta"] * u * sign


def _rates(parts: Mapping[str, Values]) -> Callable[..., list[float]]:
    """Return the rates of the states at a held command; without compensator it passes through."""
    k, a, s, f = (parts[n] for n in ("controller", "amplifier", "stack", "flexure"))
    c = parts.get("compensator")
    slew = a["current_limit"] / a["load_capacitance"]

    def rates(z: FloatArray, t: float, command: float) -> list[float]:
        x_a, u_c, f_c, v, u, f_H, f_out, y, v_y, x, v_x, x_f, v_f = z.tolist()
        du_c = df_c = 0.0
        if c is not None:
            command -= c["compensation"] * f_c / (c["k_L"] * c["drive_gain"])
            du_c = (c["drive_gain"] * command - u_c) / c["drive_time"]
            df_c = hysteresis_rate(c, u_c, du_c, f_c)
        inside = min(max(a["gain"] * command, a["lowest_output"]), a["highest_output"])
        dv = 2.0 * pi * a["bandwidth"] * (inside - v)
        dv /= (1.0 + (dv / slew) ** 8) ** 0.125
        du = (s["G"] * v - u) / (s["R_s"] * s["C_p"])
        elastic = s["c_P"] * v_y + s["k_P"] * y
        pull = s["c_B"] * (v_x - v_y) + s["k_B"] * (x - y)
        contact = f["k_c"] * (x - x_f) + f["c_c"] * (v_x - v_f)
        return [
            (x_f - x_a) / k["filter_time"], du_c, df_c, dv, du, hysteresis_rate(s, u, du, f_H),
            (s["k_L"] * u + f_H - f_out) / s["tau"],
            v_y, (f_out - elastic) / s["m_P"],
            v_x, (elastic - contact - pull) / s["m_B"],
            v_f, (contact - f["c_f"] * v_f - f["k_f"] * x_f) / f["m_f"],
        ]  # fmt: skip

    return rates


class Controller:
    """The sampled controller: the command for a reference and a filtered position."""

    def __init__(self, p: Values) -> None:
        self.p = p
        self.integral = self.last = 0.0
        self.errors = [0.0, 0.0]
        self.filtered = [0.0, 0.0]
        t = tan(pi * p["notch_frequency"] * p["sample_time"])
        top, below = 2.0 * p["notch_floor"] * t, 2.0 * p["notch_width"] * t
        self.b = np.array([1.0 + top + t * t, 2.0 * (t * t - 1.0), 1.0 - top + t * t])
        self.a = np.array([1.0 + below + t * t, 2.0 * (t * t - 1.0), 1.0 - below + t * t])

    def __call__(self, reference: float, position: float) -> float:
        """Return the command; the notch is the difference equation a * e = b * (r - x)."""
        p, raw = self.p, reference - position
        known = self.a[1] * self.filtered[0] + self.a[2] * self.filtered[1]
        inputs = self.b[0] * raw + self.b[1] * self.errors[0] + self.b[2] * self.errors[1]
        error = float((inputs - known) / self.a[0])
        self.errors, self.filtered = [raw, self.errors[0]], [error, self.filtered[0]]
        self.integral += 0.5 * p["integral_gain"] * p["sample_time"] * (error + self.last)
        self.last = error
        wanted = p["proportional_gain"] * error + self.integral + p["feed_forward"] * reference
        command = min(max(wanted, p["lowest_command"]), p["highest_command"])
        self.integral += p["anti_windup"] * (command - wanted)
        return command


def simulate_positioner(
    parts: Mapping[str, Values],
    reference: Callable[[float], float],
    end: float,
    period: float,
    rtol: float = 1e-8,
) -> Run:
    """Simulate from rest; `parts` are the values of the system's parts by their names.

    Without a part "compensator" the command goes to the amplifier.
    """
    rates, state = _rates(parts), np.zeros(len(_SIZES))
    control = Controller(parts["controller"])
    time: FloatArray = period * np.arange(round(end / period) + 1, dtype=np.float64)
    rows = []
    for t in time:
        command = control(reference(float(t)), float(state[0]))
        rows.append((state[11], state[9], command, state[3]))
        held = partial(rates, command=command)
        atol: Any = 1e-2 * rtol * _SIZES  # one for each state, which the stubs do not know
        state = odeint(held, state, [0.0, period], rtol=rtol, atol=atol)[1]
    return Run(time, *np.array(rows).T)
