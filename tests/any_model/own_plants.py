"""Plants that are no stacks, in plain NumPy and SciPy, in which tests hide a cause.

None shares code or form with the effects of the package: friction is a hyperbolic tangent, the
hysteresis has the published benchmark's form and units, an overflow is a branch.
"""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from psa_casadi.common.units import FloatArray
from psa_casadi.records.signals import Signals

Rates = Callable[[float, Any], list[float]]


def _solved(
    rates: Rates,
    t: FloatArray,
    start: list[float],
    most: float,
    method: Literal["LSODA", "RK45"] = "LSODA",
) -> FloatArray:
    """Return the states (nx, n) at the times."""
    result = solve_ivp(
        rates, (0.0, t[-1]), start, t_eval=t, rtol=1e-8, atol=1e-10, max_step=most, method=method
    )
    assert result.success
    return np.asarray(result.y)


def multisine(t: FloatArray, frequencies: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a sum of cosines of random phases (n,), of standard deviation 1."""
    phases = rng.uniform(0.0, 2.0 * np.pi, len(frequencies))
    total = np.cos(2.0 * np.pi * np.outer(t, frequencies) + phases).sum(axis=1)
    return np.asarray(total / total.std())


def bouc_wen(seed: int, noise: float = 8e-6) -> Signals:
    """The Bouc-Wen benchmark (Noel and Schoukens 2016): 2 kg, 5e4 N/m, and its hysteretic force.

    z' = alpha v - beta (gamma |v| z + delta v |z|); force [N], position [m], 750 Hz.
    """
    rng, t = np.random.default_rng(seed), np.arange(3000, dtype=np.float64) / 750.0
    u = (
        50.0
        * multisine(t, np.arange(5.0, 150.0, 0.5, dtype=np.float64), rng)
        * np.minimum(1.0, t / 0.2)
    )

    def rates(s: float, q: Any) -> list[float]:
        y, v, z = q
        force = np.interp(s, t, u)
        loop = 5e4 * v - 1e3 * (0.8 * abs(v) * z - 1.1 * v * abs(z))
        return [v, (force - 5e4 * y - 10.0 * v - z) / 2.0, loop]

    y = _solved(rates, t, [0.0, 0.0, 0.0], 1.0 / 750.0)[0]
    measured = y + noise * rng.standard_normal(len(t))
    return Signals(name="multisine", time=t, columns={"force": u, "position": measured})


def motor(seed: int, friction: float = 0.012, noise: float = 1.0, inertia: float = 3e-5) -> Signals:
    """A DC motor with dry friction [N.m] at its shaft: voltage, speed [rad/s] and current [A].

    `noise` is over that of ordinary sensors, `inertia` in kg.m2.
    """
    rng, t = np.random.default_rng(seed), np.arange(3000, dtype=np.float64) * 1e-3
    tones = ((6.0, 1.1, 0.0), (4.0, 3.7, 1.0), (2.0, 0.4, 0.0))
    u = sum(a * np.sin(2.0 * np.pi * f * t + p) for a, f, p in tones)

    def rates(s: float, q: Any) -> list[float]:
        i, w = q
        torque = 0.05 * i - 2e-5 * w - friction * np.tanh(w / 0.2)
        return [(np.interp(s, t, u) - 1.2 * i - 0.05 * w) / 2e-3, torque / inertia]

    i, w = _solved(rates, t, [0.0, 0.0], 1e-3)
    columns = {
        "voltage": u,
        "w": w + noise * 0.3 * rng.standard_normal(len(t)),
        "i": i + noise * 0.005 * rng.standard_normal(len(t)),
    }
    return Signals(name="drive", time=t, columns=columns)


def tanks(seed: int, hidden: str) -> Signals:
    """Two tanks in cascade: `hidden` is an "overflow" of the upper one, or a bent "sensor"."""
    rng, t = np.random.default_rng(seed), np.arange(2000, dtype=np.float64)
    u = np.clip(3.0 + 1.2 * multisine(t, np.linspace(5e-4, 0.01, 14), rng), 0.3, None)

    def rates(s: float, q: Any) -> list[float]:
        upper, lower = np.maximum(q, 0.0)
        through, inflow = 0.03 * np.sqrt(upper), 0.0065 * np.interp(s, t, u)
        full = hidden == "overflow" and upper > 0.62 and inflow > through
        return [0.0 if full else inflow - through, through - 0.028 * np.sqrt(lower)]

    level = _solved(rates, t, [0.3, 0.4], 0.5, "RK45")[1]  # it chatters at the brim
    displayed = level + 0.12 * level**2 if hidden == "sensor" else level
    displayed = displayed + 0.002 * rng.standard_normal(len(t))
    return Signals(name=hidden, time=t, columns={"pump": u, "level": displayed})


def breathing(seed: int) -> Signals:
    """An oscillator of 2 kg whose stiffness swings by a fifth, 3 times a second, of itself."""
    rng, t = np.random.default_rng(seed), np.arange(1500, dtype=np.float64) / 750.0
    tones = np.arange(5.0, 150.0, 0.5, dtype=np.float64)
    u = 50.0 * multisine(t, tones, rng) * np.minimum(1.0, t / 0.2)

    def rates(s: float, q: Any) -> list[float]:
        y, v = q
        stiffness = 5e4 + 1e4 * np.sin(2.0 * np.pi * 3.0 * s)
        return [v, (np.interp(s, t, u) - stiffness * y - 10.0 * v) / 2.0]

    y = _solved(rates, t, [0.0, 0.0], 1.0 / 750.0)[0]
    measured = y + 8e-6 * rng.standard_normal(len(t))
    return Signals(name="breathing", time=t, columns={"force": u, "position": measured})


def pair(seed: int) -> Signals:
    """Two coupled oscillators, two forces, two positions."""
    rng, t = np.random.default_rng(seed), np.arange(3000, dtype=np.float64) * 0.02
    tones = np.linspace(0.2, 4.0, 15)
    f1, f2 = (11.0 * multisine(t, tones, rng) for _ in range(2))

    def rates(s: float, q: Any) -> list[float]:
        x, v, z, w = q
        return [
            v, np.interp(s, t, f1) - 100.0 * x - 25.0 * (x - z) - 0.8 * v,
            w, np.interp(s, t, f2) - 100.0 * z - 25.0 * (z - x) - 0.8 * w,
        ]  # fmt: skip

    q = _solved(rates, t, [0.0] * 4, 0.02)
    e = 0.004 * rng.standard_normal((2, len(t)))
    columns = {"f1": f1, "f2": f2, "y1": q[0] + e[0], "y2": q[2] + e[1]}
    return Signals(name="pair", time=t, columns=columns)


def cylinder(seed: int) -> list[Signals]:
    """Three records of a hydraulic cylinder whose valve does nothing within 0.6 V.

    p' = (Kq w - A v - leak p)/C,  m v' = A p - b v - ks x,  x' = v; w is u less 0.6 V. The noise is
    0.2 % of each record's range.
    """
    t = np.arange(4000, dtype=np.float64) * 0.005
    tones = ((0.3, 0.7, 1.1, 1.9, 3.1), np.random.default_rng(seed).uniform(0.0, 6.28, 5))
    way = np.random.default_rng(seed + 1).uniform(-4.0, 4.0, 27)
    driven = (
        3.0 * np.sin(np.pi * t) + 1.2 * np.sin(4.6 * np.pi * t + 1.0),
        sum(1.2 * np.sin(2.0 * np.pi * f * t + p) for f, p in zip(*tones, strict=True)),
        np.interp(t, 0.8 * np.arange(27), way),
    )
    return [_cylinder(seed + 2 + k, t, np.asarray(u), k + 1) for k, u in enumerate(driven)]


def _cylinder(seed: int, t: FloatArray, u: FloatArray, number: int) -> Signals:
    rng = np.random.default_rng(seed)

    def rates(s: float, q: Any) -> list[float]:
        p, v, x = q
        volt = float(np.interp(s, t, u))
        flow = 4.2e-5 * np.sign(volt) * max(abs(volt) - 0.6, 0.0)
        force = 1.2e-3 * p - 880.0 * v - 4.1e4 * x
        return [(flow - 1.2e-3 * v - 3e-12 * p) / 2.1e-13, force / 85.0, v]

    p, _, x = _solved(rates, t, [0.0, 0.0, 0.0], 0.005)
    true = {"position": x, "pressure": p}
    table = {n: y + 2e-3 * np.ptp(y) * rng.standard_normal(len(t)) for n, y in true.items()}
    return Signals(name=f"cylinder_{number}", time=t, columns={"u": u, **table})


def oven(seed: int) -> Signals:
    """An oven above its room [K], heated in held steps [W]; the air's sensor lags by 25 s."""
    rng, step = np.random.default_rng(seed), 2.0
    power = np.repeat(rng.choice([0.0, 150.0, 300.0, 500.0, 700.0], 30), 50)
    rates = np.array(
        [[-14.0 / 2100, 14.0 / 2100, 0, 1 / 2100], [14.0 / 380, -19.2 / 380, 0, 0],
         [0, 1 / 25, -1 / 25, 0], [0, 0, 0, 0]]
    )  # fmt: skip
    kept, state, rows = expm(rates * step), np.zeros(3), []
    for heat in power:
        rows.append(state)
        state = (kept @ np.array([*state, heat]))[:3]
    wall, _, air = np.array(rows).T
    e = 0.05 * rng.standard_normal((2, len(power)))
    columns = {"heater": power, "wall": wall + e[0], "air": air + e[1]}
    time = step * np.arange(len(power), dtype=np.float64)
    return Signals(name="oven", time=time, columns=columns, hold="zero")
