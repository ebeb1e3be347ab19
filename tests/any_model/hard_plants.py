"""Plants that are hard for one simulation or one table of effects, in plain NumPy and SciPy."""

from collections.abc import Mapping

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from tests.any_model.own_plants import multisine

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
        outputs=["measured"],
        parameters=[
            psa.Parameter("a", 15.0, "1", (1.0, 200.0), "g over length", log=True),
            psa.Parameter("J", 0.1, "1", (0.005, 1.0), "inertia", log=True),
            psa.Parameter("b", 0.1, "1", (1e-3, 3.0), "damping", log=True),
        ],
    )
    return model, {"time": t, "torque": torque, "measured": angle}, truth


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
    """A slide on a guide with dry friction and a slope, and no restoring force."""
    rng, t = np.random.default_rng(5), 0.01 * np.arange(1500, dtype=np.float64)
    wanted = 0.1 * np.sin(2 * np.pi * 0.35 * t) + 0.05 * np.sin(2 * np.pi * 0.9 * t + 1.0)
    force, x = np.zeros(t.size), np.zeros((t.size, 2))

    def rates(_: float, z: FloatArray, u: float) -> list[float]:
        return [z[1], (u - 100.0 * z[1] - 15.0 * np.tanh(z[1] / 2e-3) - 4.0) / 50.0]

    for k in range(t.size - 1):
        force[k] = 6e3 * (wanted[k] - x[k, 0]) - 600.0 * x[k, 1]
        step = solve_ivp(rates, (0.0, 0.01), x[k], args=(force[k],), method="LSODA", rtol=1e-8)
        x[k + 1] = step.y[:, -1]
    record = {"time": t, "force": force, "measured": x[:, 0] + 1e-5 * rng.standard_normal(t.size)}
    q, v, u, *p = (ca.SX.sym(n) for n in ("q", "v", "force", "M", "c"))
    model = psa.ode_model(
        {"x": [q, v], "u": u, "p": p, "ode": [v, (u - p[1] * v) / p[0]], "y": q},
        name="slide",
        outputs=["measured"],
        parameters=[
            psa.Parameter("M", 30.0, "1", (5.0, 500.0), "mass", log=True),
            psa.Parameter("c", 60.0, "1", (1.0, 2000.0), "viscous friction", log=True),
        ],
    )
    return model, record, {"M": 50.0, "c": 100.0}


def _log(name: str, value: float) -> psa.Parameter:
    return psa.Parameter(name, value, "1", (value / 30.0, value * 30.0), name, log=True)


def spring() -> psa.Model:
    """Return a mass on a spring before ageing."""
    x, v, u, k, c = (ca.SX.sym(n) for n in ("x", "v", "u", "k", "c"))
    return psa.ode_model(
        {"x": [x, v], "u": u, "p": [k, c], "ode": [v, u - k * x - c * v], "y": x},
        name="spring",
        outputs=["measured"],
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
    return {"time": t, "u": u, "measured": x + 0.002 * rng.standard_normal(t.size)}


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
    """Chaos of which one state is not measured (Lorenz, J. Atmos. Sci. 20 (1963), 130)."""
    rng, t = np.random.default_rng(4), 0.01 * np.arange(2000, dtype=np.float64)
    truth = {"s": 10.0, "r": 28.0, "b": 8.0 / 3.0}

    def rates(_: float, q: FloatArray) -> list[float]:
        return [
            truth["s"] * (q[1] - q[0]), q[0] * (truth["r"] - q[2]) - q[1],
            q[0] * q[1] - truth["b"] * q[2],
        ]  # fmt: skip

    result = solve_ivp(rates, (0.0, t[-1]), [1.0, 1.0, 20.0], t_eval=t, rtol=1e-10, atol=1e-12).y
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
    first, last = (result[k] + 0.3 * rng.standard_normal(t.size) for k in (0, 2))
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


def two_bodies() -> psa.Model:
    """Two carts with a spring and a damper between them, the first one also on a spring."""
    x1, v1, x2, v2, stretch, slip, spring, held, force = (
        ca.SX.sym(n) for n in ("x1", "v1", "x2", "v2", "stretch", "slip", "spring", "held", "force")
    )
    k, c, m1, m2 = (ca.SX.sym(n) for n in ("k", "c", "m1", "m2"))
    return psa.ode_model(
        {
            "x": [x1, v1, x2, v2], "u": force, "p": [k, c, m1, m2], "y": [x1, x2],
            "w": [stretch, slip, spring, held],
            "wdef": [x1 - x2, v1 - v2, k * stretch + c * slip, 400.0 * x1 + 2.0 * v1],
            "ode": [v1, (force - spring - held) / m1, v2, (spring - 0.5 * v2) / m2],
        },
        name="two", outputs=["y1", "y2"],
        intermediates=[
            psa.Output("stretch", "m", "stretch of the spring"),
            psa.Output("slip", "m/s", "rate of the stretch"),
            psa.Output("spring", "N", "force between the carts"),
            psa.Output("held", "N", "force of the first spring"),
        ],
        parameters=[
            psa.Parameter("k", 700.0, "N/m", (70.0, 7e3), "stiffness", log=True),
            psa.Parameter("c", 2.0, "N.s/m", (0.2, 20.0), "damping", log=True),
            psa.Parameter("m1", 1.7, "kg", (0.17, 17.0), "mass of the first", log=True),
            psa.Parameter("m2", 1.4, "kg", (0.14, 14.0), "mass of the second", log=True),
        ],
    )  # fmt: skip


def hardening() -> Plant:
    """A record of the two carts, with 900 N/m, 3 N.s/m and 1.2e6 N/m3 between 2 and 1.2 kg."""
    rng, t = np.random.default_rng(0), 2e-3 * np.arange(2000, dtype=np.float64)
    u = 20.0 * multisine(t, np.linspace(0.5, 12.0, 24, dtype=np.float64), rng)

    def rates(s: float, q: FloatArray) -> list[float]:
        d, w = q[0] - q[2], q[1] - q[3]
        spring = 900.0 * d + 1.2e6 * d**3 + 3.0 * w
        first = (np.interp(s, t, u) - spring - 2.0 * q[1] - 400.0 * q[0]) / 2.0
        return [q[1], first, q[3], (spring - 0.5 * q[3]) / 1.2]

    q = solve_ivp(rates, (0.0, t[-1]), [0.0] * 4, t_eval=t, rtol=1e-9, atol=1e-11, max_step=2e-3).y
    noise = 2e-5 * rng.standard_normal((2, len(t)))
    record = {"time": t, "force": u, "y1": q[0] + noise[0], "y2": q[2] + noise[1]}
    return two_bodies(), record, {"k": 900.0, "c": 3.0, "m1": 2.0, "m2": 1.2}


def grazing(seed: int = 0) -> Plant:
    """Prey that predators eat, fewer per head the more there are: Holling's second type.

    The model lacks h = 0.02: it has a flow eaten = a x y between the two.
    """
    rng, t = np.random.default_rng(seed), 0.05 * np.arange(2000, dtype=np.float64)
    tones = np.linspace(0.02, 0.6, 12, dtype=np.float64)
    light, harvest = 1.0 + 0.3 * multisine(t, tones, rng), 0.08 + 0.04 * multisine(t, tones, rng)

    def rates(s: float, q: FloatArray) -> list[float]:
        x, y = q
        eaten = 0.05 * x * y / (1.0 + 0.02 * x)
        grown = np.interp(s, t, light) * x * (1.0 - x / 110.0)
        return [grown - eaten, 0.25 * eaten - (0.15 + np.interp(s, t, harvest)) * y]

    q = solve_ivp(
        rates, (0.0, t[-1]), [45.0, 15.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.05
    ).y
    prey, hunters = q + np.array([[0.5], [0.15]]) * rng.standard_normal(q.shape)
    x, y, eaten, *u = (ca.SX.sym(n) for n in ("x", "y", "eaten", "light", "harvest"))
    a, e, d, k = p = [ca.SX.sym(n) for n in ("a", "e", "d", "k")]
    rate = [u[0] * x * (1 - x / k) - eaten, e * eaten - (d + u[1]) * y]
    model = psa.ode_model(
        {"x": [x, y], "u": u, "p": p, "y": [x, y], "w": eaten, "wdef": a * x * y, "ode": rate},
        name="grazing",
        outputs=["prey", "hunters"],
        states=[psa.State("x", "1", "prey", 45.0, 45.0), psa.State("y", "1", "y", 15.0, 15.0)],
        parameters=[
            psa.Parameter("a", 0.04, "1", (0.004, 0.4), "eaten per head", log=True),
            psa.Parameter("e", 0.2, "1", (0.02, 2.0), "what of it is gained", log=True),
            psa.Parameter("d", 0.2, "1", (0.02, 2.0), "losses", log=True),
            psa.Parameter("k", 90.0, "1", (20.0, 900.0), "most that live", log=True),
        ],
    )
    record = {"time": t, "light": light, "harvest": harvest, "prey": prey, "hunters": hunters}
    return model, record, {"a": 0.05, "e": 0.25, "d": 0.15, "k": 110.0}
