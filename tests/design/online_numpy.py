"""The online identification in plain NumPy: matrices, and derivatives by finite differences."""

from collections.abc import Mapping

import numpy as np

from psa_casadi.units import FloatArray

#: Parameters that the identification tracks, in its order.
TRACKED = ("A", "beta", "gamma", "delta", "n", "k_L", "offset")


class NumpyIdentification:
    """The recursion of the component, written from its equations: `step(u, x)`.

    `estimates` (7,) are A, beta, gamma, delta, n, k_L and offset in SI units, `f` [N] the force.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        v = self.v = dict(values)
        self.start = np.array([*(v[n] for n in TRACKED[:-1]), 0.0])
        bend, least = abs(v["beta"]) + abs(v["gamma"]) + 0.02 * v["k_L"], 0.02 * v["k_L"]
        size = [abs(v["A"]) + least, bend, bend, abs(v["delta"]) + least, 1.0, v["k_L"]]
        self.spread = v["spread"] * np.array([*size, 0.1 * v["k_L"] * v["u_rated"]])
        self.z, self.P = np.zeros(7), np.eye(7)
        self.s_f, self.s_l = np.zeros(5), np.zeros(5)
        self.last = self.f = self.lag_u = self.lag_f = 0.0

    @property
    def estimates(self) -> FloatArray:
        return np.asarray(self.start + self.spread * self.z, dtype=np.float64)

    def after(self, f: float, theta: FloatArray, u: float) -> float:
        """Return f_H after one step of Alexander's method from the last voltage to u."""
        v, T = self.v, self.v["period"]
        A, beta, gamma, delta, n = theta[:5]
        du = u - self.last
        sign = (du / T) / np.hypot(du / T, v["hold_rate"])

        def change(f: float) -> float:
            r = abs(f / v["h_ref"]) ** n
            free = A * du + delta * 0.5 * (u + self.last) * sign * T
            return float(free - (beta * du * sign * np.sign(f) + gamma * du) * r)

        share = 1.0 - 0.5**0.5

        def stage(known: float) -> float:
            at = known
            for _ in range(50):  # converges: the steps of these records are small
                at = known + share * change(at)
            return at

        return stage(f + (1.0 - share) * change(stage(f)))

    def slopes(self, theta: FloatArray, u: float) -> tuple[float, FloatArray]:
        """Return the derivatives of `after` by f and by A, beta, gamma, delta, n."""
        by = np.zeros(5)
        for j in range(5):
            step = np.zeros(7)
            step[j] = 1e-5 * self.spread[j]
            up, down = self.after(self.f, theta + step, u), self.after(self.f, theta - step, u)
            by[j] = (up - down) / (2.0 * step[j])
        h = 1e-5 * self.v["h_ref"]
        up, down = self.after(self.f + h, theta, u), self.after(self.f - h, theta, u)
        return (up - down) / (2.0 * h), by

    def step(self, u: float, x: float) -> None:
        """Take one sample."""
        v, T, theta = self.v, self.v["period"], self.estimates
        keep = np.exp(-T / v["lag"])
        held = (1.0 - keep) * v["lag"] / T
        old, new = held - keep, 1.0 - held
        by_f, by = self.slopes(theta, u)
        f, s_f = self.after(self.f, theta, u), by_f * self.s_f + by
        self.lag_u = keep * self.lag_u + old * self.last + new * u
        self.lag_f = keep * self.lag_f + old * self.f + new * f
        self.s_l = keep * self.s_l + old * self.s_f + new * s_f
        moving = abs(u - self.last) / T > v["standstill_rate"]
        self.last, self.f, self.s_f = u, f, s_f
        if moving:
            error = v["stiffness"] * x - (theta[5] * self.lag_u + self.lag_f + theta[6])
            self.correct(error)

    def correct(self, error: float) -> None:
        """Recursive least squares on the prediction, with forgetting bounded by the start."""
        v = self.v
        d = self.spread * np.array([*self.s_l, self.lag_u, 1.0])
        g = self.P @ d
        scale = d @ g + (v["noise"] * v["stiffness"]) ** 2
        step = g * error / scale
        step *= min(1.0, 0.05 / max(float(np.linalg.norm(step)), 1e-300))
        P = self.P - np.outer(g, g) / scale
        stretch = np.sqrt(1.0 + v["period"] / v["memory"] * (1.0 - np.diag(P)))
        self.P, self.z = P * np.outer(stretch, stretch), self.z + step
        self.f += float(self.s_f @ (self.spread * step)[:5])
        self.lag_f += float(self.s_l @ (self.spread * step)[:5])
