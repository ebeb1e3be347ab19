"""Plants that are hard for one simulation or one table of effects, in plain NumPy and SciPy."""

from collections.abc import Mapping

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.units import FloatArray

Table = dict[str, FloatArray]
#: A model, a record of its plant, and the plant's parameters.
Plant = tuple[psa.Model, Table, Mapping[str, float]]


def pendulum(drag: float = 0.0, seed: int = 0) -> Plant:
    """An upright pendulum that a controller holds, its torque constant over 10 ms."""
    rng, n, dt = np.random.default_rng(seed), 1600, 0.01
    truth = {"a": 9.81 / 0.4, "J": 0.05, "b": 0.02}
    t, q, angle, torque = (
        dt * np.arange(n, dtype=np.float64),
        np.array([0.1, 0.0]),
        np.zeros(n),
        np.zeros(n),
    )
    wanted = 0.4 * np.sign(np.sin(2 * np.pi * 0.3 * t)) + 0.2 * np.sin(2 * np.pi * 1.1 * t)
    for k in range(n):
        angle[k] = q[0] + 0.002 * rng.standard_normal()
        torque[k] = -3.0 * (angle[k] - wanted[k]) - 0.5 * q[1]

        def rates(_: float, z: FloatArray, u: float = float(torque[k])) -> list[float]:
            lost = truth["b"] * z[1] + drag * z[1] * abs(z[1])
            return [z[1], truth["a"] * np.sin(z[0]) + (u - lost) / truth["J"]]

        q = solve_ivp(rates, (0.0, dt), q, rtol=1e-8, atol=1e-10).y[:, -1]
    a, w, u, *p = (ca.SX.sym(n) for n in ("angle", "w", "torque", "a", "J", "b"))
    rate = p[0] * ca.sin(a) + (u - p[2] * w) / p[1]
    model = psa.ode_model(
        {"x": [a, w], "u": u, "p": p, "ode": [w, rate], "y": a},
        name="pendulum",
        outputs=["shown"],
        parameters=[
            psa.Parameter("a", 15.0, "1", (1.0, 200.0), "g over length", log=True),
            psa.Parameter("J", 0.1, "1", (0.005, 1.0), "inertia", log=True),
            psa.Parameter("b", 0.1, "1", (1e-3, 3.0), "damping", log=True),
        ],
    )
    return model, {"time": t, "torque": torque, "shown": angle}, truth


def duffing() -> Plant:
    """Chaos in two wells: Guckenheimer and Holmes 1983, section 2.2."""
    rng, t = np.random.default_rng(3), 0.05 * np.arange(2000, dtype=np.float64)
    truth = {"d": 0.3, "a": -1.0, "b": 1.0}

    def rates(s: float, z: FloatArray) -> list[float]:
        return [z[1], -0.3 * z[1] + z[0] - z[0] ** 3 + 0.5 * np.cos(1.2 * s)]

    x = solve_ivp(rates, (0.0, t[-1]), [0.5, 0.0], t_eval=t, rtol=1e-9, atol=1e-11).y[0]
    q, v, u, *p = (ca.SX.sym(n) for n in ("q", "v", "force", "d", "a", "b"))
    model = psa.ode_model(
        {"x": [q, v], "u": u, "p": p, "ode": [v, u - p[0] * v - p[1] * q - p[2] * q**3], "y": q},
        name="duffing",
        outputs=["x"],
        parameters=[
            psa.Parameter("d", 0.1, "1", (0.01, 3.0), "damping", log=True),
            psa.Parameter("a", -0.5, "1", (-5.0, 5.0), "linear stiffness"),
            psa.Parameter("b", 0.5, "1", (0.02, 10.0), "cubic stiffness", log=True),
        ],
    )
    noisy = x + 0.02 * rng.standard_normal(t.size)
    return model, {"time": t, "force": 0.5 * np.cos(1.2 * t), "x": noisy}, truth


def slide() -> Plant:
    """A slide on a guide with dry friction and a slope, of which nothing pulls it back."""
    rng, t = np.random.default_rng(5), 0.01 * np.arange(1500, dtype=np.float64)
    wanted = 0.1 * np.sin(2 * np.pi * 0.35 * t) + 0.05 * np.sin(2 * np.pi * 0.9 * t + 1.0)
    force, x = np.zeros(t.size), np.zeros((t.size, 2))

    def rates(_: float, z: FloatArray, u: float) -> list[float]:
        return [z[1], (u - 100.0 * z[1] - 15.0 * np.tanh(z[1] / 2e-3) - 4.0) / 50.0]

    for k in range(t.size - 1):
        force[k] = 6e3 * (wanted[k] - x[k, 0]) - 600.0 * x[k, 1]
        step = solve_ivp(rates, (0.0, 0.01), x[k], args=(force[k],), method="LSODA", rtol=1e-8)
        x[k + 1] = step.y[:, -1]
    record = {"time": t, "force": force, "shown": x[:, 0] + 1e-5 * rng.standard_normal(t.size)}
    q, v, u, *p = (ca.SX.sym(n) for n in ("q", "v", "force", "M", "c"))
    model = psa.ode_model(
        {"x": [q, v], "u": u, "p": p, "ode": [v, (u - p[1] * v) / p[0]], "y": q},
        name="slide",
        outputs=["shown"],
        parameters=[
            psa.Parameter("M", 30.0, "1", (5.0, 500.0), "mass", log=True),
            psa.Parameter("c", 60.0, "1", (1.0, 2000.0), "viscous friction", log=True),
        ],
    )
    return model, record, {"M": 50.0, "c": 100.0}


def _log(name: str, value: float) -> psa.Parameter:
    return psa.Parameter(name, value, "1", (value / 30.0, value * 30.0), name, log=True)


def spring() -> psa.Model:
    """Return a mass on a spring, as it was when new."""
    x, v, u, k, c = (ca.SX.sym(n) for n in ("x", "v", "u", "k", "c"))
    return psa.ode_model(
        {"x": [x, v], "u": u, "p": [k, c], "ode": [v, u - k * x - c * v], "y": x},
        name="spring",
        outputs=["shown"],
        parameters=[_log("k", 50.0), _log("c", 0.5)],
    )


def aged(seed: int) -> Table:
    """Return a record of a spring that softens by 15 %, ever slower."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(3000, dtype=np.float64)
    phases = rng.uniform(0.0, 2 * np.pi, 37)
    u = np.cos(2 * np.pi * np.outer(t, np.arange(0.3, 4.0, 0.1)) + phases).sum(axis=1)

    def rates(s: float, q: FloatArray) -> list[float]:
        soft = 1.0 - 0.15 * (1.0 - np.exp(-s / 12.0))
        return [q[1], np.interp(s, t, u) - 60.0 * soft * q[0] - 0.8 * q[1]]

    x = solve_ivp(rates, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.01).y[0]
    return {"time": t, "u": u, "shown": x + 0.002 * rng.standard_normal(t.size)}


def battery() -> tuple[psa.Model, Table]:
    """A resistance over the charge, charged and discharged three times: the charge is no clock."""
    rng, n = np.random.default_rng(0), 3600
    i = 2.5 * np.sign(np.sin(2 * np.pi * np.arange(n) / 1200.0)) + np.repeat(
        rng.choice([-1.0, 0.0, 1.0], n // 40), 40
    )
    soc, rc = 1.0 - np.concatenate([[0.0], np.cumsum(i)[:-1]]) / 2800.0, np.zeros(n)
    for k in range(n - 1):
        rc[k + 1] = rc[k] * np.exp(-1.0 / 40.0) + 0.02 * (1.0 - np.exp(-1.0 / 40.0)) * i[k]
    resistance = 0.05 * (1.0 + 1.2 * (1.0 - soc) ** 2)
    volt = 3.2 + 0.9 * soc - rc - resistance * i + 1e-3 * rng.standard_normal(n)
    s, v, u, r0, r1, c1 = (ca.SX.sym(m) for m in ("soc", "v1", "i", "R0", "R1", "C1"))
    model = psa.ode_model(
        {
            "x": [s, v], "u": u, "p": [r0, r1, c1], "y": 3.2 + 0.9 * s - v - r0 * u,
            "ode": [-u / 2800.0, (u - v / r1) / c1],
        },
        name="battery",
        states=[psa.State("soc", "1", "charge", 1.0, 1.0), psa.State("v1", "1", "slow part", 0.1)],
        outputs=["volt"],
        parameters=[_log("R0", 0.03), _log("R1", 0.03), _log("C1", 1000.0)],
    )  # fmt: skip
    return model, {"time": np.arange(n, dtype=np.float64), "i": i, "volt": volt}


def lorenz() -> Plant:
    """Chaos of which one state is not shown (Lorenz, J. Atmos. Sci. 20 (1963), 130)."""
    rng, t = np.random.default_rng(4), 0.01 * np.arange(2000, dtype=np.float64)
    truth = {"s": 10.0, "r": 28.0, "b": 8.0 / 3.0}

    def rates(_: float, q: FloatArray) -> list[float]:
        return [
            truth["s"] * (q[1] - q[0]), q[0] * (truth["r"] - q[2]) - q[1],
            q[0] * q[1] - truth["b"] * q[2],
        ]  # fmt: skip

    found = solve_ivp(rates, (0.0, t[-1]), [1.0, 1.0, 20.0], t_eval=t, rtol=1e-10, atol=1e-12).y
    x, y, z, *p = (ca.SX.sym(n) for n in ("x", "y", "z", "s", "r", "b"))
    model = psa.ode_model(
        {
            "x": [x, y, z], "p": p, "y": [x, z],
            "ode": [p[0] * (y - x), x * (p[1] - z) - y, x * y - p[2] * z],
        },
        name="lorenz",
        outputs=["first", "last"],
        parameters=[_log("s", 7.0), _log("r", 20.0), _log("b", 2.0)],
    )  # fmt: skip
    first, last = (found[k] + 0.3 * rng.standard_normal(t.size) for k in (0, 2))
    return model, {"time": t, "first": first, "last": last}, truth


def levitated() -> Plant:
    """A ball under a magnet whose controller holds the current; its force falls with the gap."""
    rng, n, dt = np.random.default_rng(3), 2000, 0.002
    t, q = dt * np.arange(n, dtype=np.float64), np.array([0.01, 0.0])
    gap, current, rest = np.zeros(n), np.zeros(n), 0.01 * np.sqrt(9.81 / 0.0025)
    steps = 0.0012 * np.sign(np.sin(2 * np.pi * 1.3 * t)) * np.minimum(1.0, t / 0.2)
    wanted = 0.01 + steps + 0.0006 * np.sin(2 * np.pi * 4.0 * t)
    for k in range(n):
        gap[k], current[k] = q[0], rest * (1.0 + 180.0 * (q[0] - wanted[k]) + 4.0 * q[1])

        def rates(_: float, z: FloatArray, i: float = float(current[k])) -> list[float]:
            return [z[1], 9.81 - 0.0025 * i**2 / z[0] ** 2]

        q = solve_ivp(rates, (0.0, dt), q, rtol=1e-9, atol=1e-12).y[:, -1]
    x, v, i, c = (ca.SX.sym(m) for m in ("x", "v", "i", "c"))
    model = psa.ode_model(
        {"x": [x, v], "u": i, "p": [c], "ode": [v, 9.81 - c * i * i / x**2], "y": x},
        name="levitated",
        states=[psa.State("x", "m", "gap", 0.01, 0.01), psa.State("v", "m/s", "speed", 0.1)],
        outputs=["gap"],
        parameters=[_log("c", 0.002)],
    )
    record = {"time": t, "i": current, "gap": gap + 5e-6 * rng.standard_normal(n)}
    return model, record, {"c": 0.0025}
