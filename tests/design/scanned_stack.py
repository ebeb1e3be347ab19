"""A stack that scans and moves quickly, on the independent reference with creep."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares, linprog

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.design.tracking.minimum_time import INTERVALS, QuickMove
from psa_casadi.design.tracking.targets import AmplifierLimits, Target
from psa_casadi.simulation.start import linear_part

_RATIOS = (1.0, 10.0, 100.0)


def creeping_displacement(
    values: Mapping[str, float], time: FloatArray, voltage: FloatArray, *, rtol: float = 1e-7
) -> FloatArray:
    """Return the displacement (n,) [m] of a voltage (n,) [V] that starts at 0 from rest."""
    result = reference.simulate(
        values, reference.from_samples(time, voltage), time,
        breakpoints=[float(t) for t in time[1:-1]], rtol=rtol,
    )  # fmt: skip
    return crept(values, time, result.displacement)


def crept(values: Mapping[str, float], time: FloatArray, x: FloatArray) -> FloatArray:
    """Return the displacement (n,) [m] with creep behind an x (n,) [m] that began at rest."""
    gain, first = values.get("creep_gain", 0.0), values.get("creep_time", 1.0)
    return np.asarray(x + gain * sum(_relaxed(time, x, first * r) for r in _RATIOS))


def _relaxed(time: FloatArray, x: FloatArray, constant: float) -> FloatArray:
    """Solve constant z' = x - z for an x that is linear between samples, from z = x."""
    z, decays = np.empty_like(x), np.exp(-np.diff(time) / constant)
    z[0] = x[0]
    for k, (h, decay) in enumerate(zip(np.diff(time), decays, strict=True)):
        slope = (x[k + 1] - x[k]) / h
        z[k + 1] = x[k + 1] - slope * constant + decay * (z[k] - x[k] + slope * constant)
    return z


def bang_bang_bound(
    p: Mapping[str, float], begin: float, end: float, low: float, high: float, n: int = 300
) -> float:
    """Return the least time [s] of the linear part from `begin` to `end` [m], `low` to `high` [V].

    The voltage is held over n intervals, so the bound is that from above, by less than two of them.
    """
    a, b = _chain(p)
    level = -np.linalg.solve(a, b)
    size = level * (high - low)
    size[3] = size[2] * np.sqrt(p["k_P"] / p["m_P"])
    size[5] = size[4] * np.sqrt(p["k_B"] / p["m_B"])
    a, b, level = a * size / size[:, None], b / size, level / size
    gain = p["k_L"] * p["G"] * (1.0 / p["k_P"] + 1.0 / p["k_B"])
    first: FloatArray = np.asarray(level * begin / gain, dtype=float)
    last: FloatArray = np.asarray(level * end / gain, dtype=float)
    short, long = 0.0, 100.0 * float(np.max(1.0 / np.abs(np.linalg.eigvals(a))))
    while long - short > 1e-3 * long:
        middle = 0.5 * (short + long)
        if _possible(a, b, (first, last), (low, high), middle / n, n):
            long = middle
        else:
            short = middle
    return long


def _chain(p: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """Return x' = a x + b v of u, f, y, y', x, x'."""
    drive, a = p["R_s"] * p["C_p"], np.zeros((6, 6))
    a[0, 0] = -1.0 / drive
    a[1, :2] = p["k_L"] / p["tau"], -1.0 / p["tau"]
    a[2, 3] = a[4, 5] = 1.0
    a[3, 1:4] = np.array([1.0, -p["k_P"], -p["c_P"]]) / p["m_P"]
    a[5, 2:] = np.array([p["k_P"] + p["k_B"], p["c_P"] + p["c_B"], -p["k_B"], -p["c_B"]]) / p["m_B"]
    return a, np.r_[p["G"] / drive, np.zeros(5)]


def _possible(
    a: FloatArray, b: FloatArray, ends: tuple[FloatArray, FloatArray],
    limits: tuple[float, float], h: float, n: int,
) -> bool:  # fmt: skip
    """Say whether some voltage takes the chain from one end to the other in n intervals h."""
    k = len(b)
    block = np.zeros((k + 1, k + 1))
    block[:k, :k], block[:k, k] = a * h, b * h
    power = expm(block)
    step, weights = power[:k, :k], [power[:k, k]]
    for _ in range(n - 1):
        weights.append(step @ weights[-1])
    left = ends[1] - np.linalg.matrix_power(step, n) @ ends[0]
    rows = np.hstack([np.array(weights[::-1]).T, np.eye(k), -np.eye(k)])
    bounds = [limits] * n + [(0.0, None)] * (2 * k)
    answer: Any = linprog(np.r_[np.zeros(n), np.ones(2 * k)], A_eq=rows, b_eq=left, bounds=bounds)
    return bool(answer.status == 0 and answer.fun < 1e-7)


ARCS = 6
#: Samples of a trajectory, along which creep is summed; lengths of the last arcs at the start of
#: the search over the whole move; evaluations; residual, over the move, that is a solution.
_SAMPLES, _TAIL, _EVALUATIONS, _SOLVED = 200, (0.02, 0.002), 200, 1e-6


def bang_bang_move(model: psa.Model, found: QuickMove) -> float | None:
    """Return the length [s] of the stack's bang-bang move that a design leads to.

    Between the limits, from the rest in which the design starts, of which x has crept; the search
    starts from the arcs of the design's voltage. None if it does not settle.
    """
    first = dict(zip(model.state_names, found.response.states[0].tolist(), strict=True))
    initial = {n: first[n] for n in ("u", "f_H", "f_out", "y", "v_y", "x", "v_x")}
    limits = (found.limits.min_voltage, found.limits.max_voltage)
    played, length = found.response.voltage[2 : 2 + INTERVALS], found.move_time
    span, upward = limits[1] - limits[0], found.end > found.begin
    shares = _arcs(played, limits)

    def miss(q: FloatArray) -> FloatArray:
        """Return the distances from rest at the end (8,), in percent of the move."""
        p, move, held = model.values, abs(found.end - found.begin), float(q[-1]) * span
        ends = np.cumsum(np.maximum(q[:-1] * length, 1e-12))
        time = np.unique(np.concatenate([[0.0], ends, np.linspace(0.0, ends[-1], _SAMPLES)]))

        def voltage(t: float) -> float:
            arc = min(int(np.searchsorted(ends, t, side="right")), ARCS - 1)
            return limits[int((arc % 2 == 0) == upward)]

        run = reference.simulate(
            p, voltage, time, initial=initial, breakpoints=ends[:-1].tolist(), rtol=1e-9
        )
        s = {n: float(v[-1]) for n, v in run.states.items()}
        displayed = float(crept(p, time, run.displacement)[-1])
        force, c = p["k_L"] * p["G"] * held + s["f_H"], 1.0 / p["k_P"] + 1.0 / p["k_B"]
        w_p, w_b = np.sqrt(p["k_P"] / p["m_P"]), np.sqrt(p["k_B"] / p["m_B"])
        far = [(s["f_out"] - force) * c, s["y"] - force / p["k_P"], s["x"] - force * c,
               displayed - found.end, s["v_y"] / w_p, s["v_x"] / w_b]  # fmt: skip
        return 100.0 * np.array([(s["u"] - p["G"] * held) / span, *(d / move for d in far)])

    solved = least_squares(
        miss, np.append(shares, played[-1] / span),
        bounds=(np.append(np.zeros(ARCS), limits[0] / span),
                np.append(np.full(ARCS, np.inf), limits[1] / span)),
        x_scale=np.append(np.maximum(shares, 0.01), 0.5), diff_step=[1e-5],
        xtol=1e-12, ftol=1e-12, max_nfev=_EVALUATIONS,
    )  # fmt: skip
    settled = float(np.max(np.abs(solved.fun))) < 100.0 * _SOLVED
    return float(np.sum(solved.x[:-1]) * length) if settled else None


def _arcs(voltage: FloatArray, limits: tuple[float, float]) -> FloatArray:
    """Return the shares of the first four arcs of a designed voltage, and two short ones."""
    high = voltage > 0.5 * sum(limits)
    switches = np.flatnonzero(np.diff(high.astype(int))) + 1
    edges = np.concatenate([[0], switches, [high.size]]) / high.size
    observed = np.diff(edges)[: ARCS - len(_TAIL)]
    rest = np.full(ARCS - len(_TAIL) - len(observed), _TAIL[0])
    return np.concatenate([observed, rest, _TAIL])


#: The stack carries a payload [kg], so that it rings at 1.6 kHz, and a loop 10 % of the stroke.
PAYLOAD, LOOP = 0.5, 0.8
STROKE = 10e-6
#: Samples of one line of the scan; size of the parameters' errors; parameters that are conventions.
LINE, WRONG = 250, 0.05
_CONVENTIONS = ("hold_rate", "u_rated")
LIMITS = AmplifierLimits(min_voltage=-20.0, max_voltage=120.0)


def scanner(payload: float = PAYLOAD) -> psa.Model:
    """Return the P-885.51 with a payload, creep, and a hysteresis loop 10 % of the stroke wide."""
    creep = {"creep_gain": 0.02, "creep_time": 0.01}
    model = psa.stack_model("P-885.51").with_effect(psa.EFFECTS["slow_creep"], creep).plant()
    loop = {name: LOOP * model.values[name] for name in ("A", "beta", "gamma")}
    return model.with_values({**loop, **({"m_B": payload} if payload else {})})


def scan(model: psa.Model, samples: int) -> Target:
    """Return a raster scan at a twentieth of the first resonance, 250 samples a line."""
    poles = np.linalg.eigvals(linear_part(model).a)
    ringing = np.abs(poles[np.abs(poles.imag) > 1e-6 * np.abs(poles)])
    frequency = float(np.min(ringing)) / (2.0 * np.pi) / 20.0
    lines = max(1, samples // LINE)
    time = np.linspace(0.0, lines / frequency, samples)
    return Target(time, STROKE * rounded_triangle(time * frequency, 0.2))


def rounded_triangle(phase: FloatArray, turn: float) -> FloatArray:
    """Return a triangle of period 1 from 0 to 1 and back whose turns take the share `turn`.

    Over that share of each half period the acceleration is a half sine; it starts at rest.
    """
    s = 1.0 - np.abs(1.0 - 2.0 * np.mod(phase, 1.0))  # way along the half period, 0 to 1
    half = 0.5 * turn
    near = np.minimum(s, 1.0 - s)  # way from the nearer turn
    # speed sin(pi near / turn) in the turn, 1 outside; distance is its integral
    inside = turn / np.pi * (1.0 - np.cos(np.pi * np.minimum(near, half) / turn))
    way = inside + np.maximum(near - half, 0.0)
    full = 2.0 * (turn / np.pi + 0.5 - half)
    return np.asarray(np.where(s <= 0.5, way, full - way) / full)


def wrong_values(model: psa.Model, generator: np.random.Generator) -> dict[str, float]:
    """Return the values with every parameter off by 5 %, up or down at random."""
    changed = {
        name: value * (1.0 + WRONG * generator.choice([-1.0, 1.0]))
        for name, value in model.values.items()
        if name not in _CONVENTIONS
    }
    return {**model.values, **changed}
