"""A stack that is stepped sample by sample and whose parameters drift, in plain NumPy.

The paper's equations as `psa_casadi.reference` has them, but in steps: the drive by its
exponential, the hysteresis by Runge-Kutta steps of order four along the voltage, lag and mechanics
by the matrix exponential, exact for a force that is linear on a step. It shares no code with the
symbolic model: a plant to try a linearisation on.
"""

from collections.abc import Callable, Mapping
from math import copysign, exp, sqrt

import numpy as np
import scipy

from psa_casadi.units import FloatArray

Values = Mapping[str, float]

_SHAPES = ("A", "beta", "gamma", "delta", "n", "k_L")


class DriftingStack:
    """The plant: `step(command)` moves on by one period and returns the displacement [m].

    `values` are a stack's parameters in SI units; `drift(t)` gives factors at time t [s] on A,
    beta, gamma, delta, n and k_L. The command goes in a line from its last value to the new one, in
    `parts` steps. It starts at rest at 0 V.
    """

    def __init__(
        self, values: Values, period: float, drift: Callable[[float], Values] | None = None,
        parts: int = 6,
    ) -> None:  # fmt: skip
        self._p, self._drift, self._parts = dict(values), drift or (lambda _: {}), parts
        self._h = period / parts
        self._keep = exp(-self._h / (values["R_s"] * values["C_p"]))
        self._time, self._command, self._u, self._f = 0.0, 0.0, 0.0, 0.0
        self._x = np.zeros(5)
        self._free, self._old, self._new = _discrete(values, self._h)

    @property
    def voltage(self) -> float:
        """Voltage at the electrodes [V]."""
        return self._u

    @property
    def hysteresis_force(self) -> float:
        """Hysteresis force [N]."""
        return self._f

    def step(self, command: float) -> float:
        """Move on by one period, the command [V] going in a line to `command`; return x [m]."""
        slope = (self._p["G"] * command - self._command) / self._parts
        factors = self._drift(self._time)
        p = {n: self._p[n] * factors.get(n, 1.0) for n in _SHAPES}
        delay = self._p["R_s"] * self._p["C_p"] / self._h
        for _ in range(self._parts):
            behind = slope * delay
            after = self._command + slope - behind
            u = after + (self._u - self._command + behind) * self._keep
            f = self._hysteresis(p, u - self._u)
            now, then = p["k_L"] * self._u + self._f, p["k_L"] * u + f
            self._x = self._free @ self._x + self._old * now + self._new * then
            self._u, self._f, self._command = u, f, self._command + slope
        self._time += self._h * self._parts
        return float(self._x[3])

    def _hysteresis(self, p: Values, du: float) -> float:
        """Return f_H after u has moved by du in one step."""
        rate, hold, h_ref = du / self._h, self._p["hold_rate"], self._p["h_ref"]
        sign = rate / sqrt(rate * rate + hold * hold)
        free = p["A"] * du + p["delta"] * (self._u + 0.5 * du) * sign * self._h

        def change(f: float) -> float:
            power: float = (abs(f) / h_ref) ** p["n"]
            return free - power * (p["beta"] * du * sign * copysign(1.0, f) + p["gamma"] * du)

        f = self._f
        k1 = change(f)
        k2 = change(f + 0.5 * k1)
        k3 = change(f + 0.5 * k2)
        k4 = change(f + k3)
        return f + (k1 + 2.0 * (k2 + k3) + k4) / 6.0


def _discrete(p: Values, h: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the step of (f_out, y, y', x, x') for a force linear from one end to the other."""
    A = np.zeros((7, 7))
    A[0, 0], A[0, 5] = -1.0 / p["tau"], 1.0 / p["tau"]
    A[1, 2], A[3, 4] = 1.0, 1.0
    A[2, :3] = np.array([1.0, -p["k_P"], -p["c_P"]]) / p["m_P"]
    A[4, 1:5] = [p["k_P"] + p["k_B"], p["c_P"] + p["c_B"], -p["k_B"], -p["c_B"]]
    A[4] /= p["m_B"]
    A[5, 6] = 1.0 / h
    whole = scipy.linalg.expm(A * h)
    return whole[:5, :5], whole[:5, 5] - whole[:5, 6], whole[:5, 6]
