"""The base as one set of differential equations, to check the plants' own solution against."""

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from tests.studies.plants.stack import FloatArray, Stack


def solve_as_ode(s: Stack, times: FloatArray, command: FloatArray) -> FloatArray:
    """The contract's equations as one set of differential equations, restarted at every sample."""

    def rate(t: float, z: FloatArray) -> FloatArray:
        u, force, out, y, v_y, x, v_x = z
        du = (np.interp(t, times, command) - u) / s.drive_time
        sign = du / np.hypot(du, s.hold_rate)
        power = (abs(force) / s.h_ref) ** s.n
        hysteresis = s.a * du - power * (s.beta * du * sign * np.sign(force) + s.gamma * du)
        reaction = s.c_p * v_y + s.k_p * y
        a_x = (reaction - s.c_b * (v_x - v_y) - s.k_b * (x - y)) / s.m_b
        lag = (s.k_l * u + force - out) / s.tau
        return np.array(
            [du, hysteresis + s.delta * u * sign, lag, v_y, (out - reaction) / s.m_p, v_x, a_x]
        )

    state = np.zeros(7)
    displacement = [0.0]
    scale = np.array([1e-9, 1e-7, 1e-7, 1e-14, 1e-9, 1e-14, 1e-9])
    for start, end in pairwise(times.tolist()):
        found = solve_ivp(rate, (start, end), state, method="LSODA", rtol=1e-9, atol=scale)
        state = found.y[:, -1]
        displacement.append(float(state[5]))
    return np.asarray(displacement)
