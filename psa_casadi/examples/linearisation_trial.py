"""A linearisation tried out: a stack driven plainly, by feed-forward, and by tracked feed-forward.

The plant is `DriftingStack`, which shares no code with what drives it.

A stack that is stepped sample by sample and whose parameters drift, in plain NumPy.

The paper's equations as `psa_casadi.reference` has them, but in steps: the drive by its
exponential, the hysteresis by Runge-Kutta steps of order four along the voltage, lag and mechanics
by the matrix exponential, exact for a force that is linear on a step. It shares no code with the
symbolic model: a plant to try a linearisation on.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import copysign, exp, sqrt

import numpy as np
import scipy

from psa_casadi import online
from psa_casadi.common.units import FloatArray
from psa_casadi.model.compose import Model

Values = Mapping[str, float]

Drift = Callable[[float], Values]
#: Parameters that drift, and that are tracked.
TRACKED = ("A", "beta", "gamma", "delta", "n", "k_L")


class DriftingStack:
    """The plant: `step(command)` moves on by one period and returns the displacement [m].

    `values` are a stack's parameters in SI units; `drift(t)` gives factors at time t [s] on A,
    beta, gamma, delta, n and k_L. The command goes in a line from its last value to the new one, in
    `parts` steps. It starts at rest at 0 V.
    """

    def __init__(
        self, values: Values, period: float, drift: Drift | None = None,
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
        p = {n: self._p[n] * factors.get(n, 1.0) for n in TRACKED}
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


#: Share of the stroke that the sensor's noise has (rms).
NOISE = 1e-4
#: The rms error of sensor and model that the identification assumes, as a share of the stroke.
ERROR = 1e-3


@dataclass(frozen=True)
class Drive:
    """A run: times [s], wanted voltage of a linear stack [V], voltage [V], displacement [m].

    `linear` [m] is what the plant does on the wanted voltage without its hysteresis force.
    """

    time: FloatArray
    wanted: FloatArray
    voltage: FloatArray
    displacement: FloatArray
    linear: FloatArray
    estimate: online.Estimate | None = None

    def errors(self, part: slice = slice(None)) -> FloatArray:
        """Return the distance from the line through (linear, displacement) best for a part [m]."""
        table = np.column_stack([self.linear, np.ones_like(self.linear)])
        best = np.linalg.lstsq(table[part], self.displacement[part], rcond=None)[0]
        off: FloatArray = self.displacement - table @ best
        return off

    def nonlinearity(self, part: slice = slice(None)) -> float:
        """Return the largest of the `errors` in a part as a share of the displacement's range."""
        return float(np.abs(self.errors(part)[part]).max() / np.ptp(self.displacement[part]))


def wanted_voltage(time: FloatArray, span: float, frequency: float = 5.0) -> FloatArray:
    """Return a scan [V] from 0, at a frequency [Hz], whose depth changes so that loops nest."""
    depth = 0.7 + 0.3 * np.cos(2.0 * np.pi * 0.18 * frequency * time)
    wave: FloatArray = 0.5 * span * depth * (1.0 - np.cos(2.0 * np.pi * frequency * time))
    return wave


def off_values(model: Model, share: float, seed: int) -> Model:
    """Return the model with each tracked parameter off by `share`, up or down at random."""
    draw = np.random.default_rng(seed)
    p = model.values
    changed = {n: p[n] * (1.0 + share * draw.choice([-1.0, 1.0])) for n in TRACKED}
    return model.with_values(changed | {"n": max(1.0, changed["n"])})


def ageing(model: Model, duration: float, loss: float = 0.1, growth: float = 0.3) -> Drift:
    """Return factors of a stack that ages: less force per volt, more hysteresis, a new bend.

    Both go with the logarithm of time, as depolarisation does: by `loss` and `growth` at the end.
    """

    def factors(t: float) -> Values:
        share = float(np.log1p(20.0 * t / duration) / np.log(21.0))
        more = 1.0 + growth * share
        bend = 1.0 + (0.5 * growth * share) / model.values["n"]
        shapes = dict.fromkeys(("A", "beta", "gamma", "delta"), more)
        return {**shapes, "n": bend, "k_L": 1.0 - loss * share}

    return factors


def driven(
    plant: Model, control: str, known: Model, time: FloatArray, *, drift: Drift | None = None,
    memory: float = 1.0, frequency: float = 5.0,
) -> Drive:  # fmt: skip
    """Drive a plant on `wanted_voltage`: plainly ("none"), by "feed-forward" or "tracked".

    `known` is the model that the controller has; its memory [s] is for "tracked" only. The sensor
    has noise.
    """
    p, period = plant.values, float(time[1] - time[0])
    wanted = wanted_voltage(time, p["u_rated"], frequency)
    stroke = abs(p["k_L"]) * p["u_rated"] * (1.0 / p["k_P"] + 1.0 / p["k_B"])
    error = NOISE * stroke * np.random.default_rng(0).normal(size=time.size)
    stack = DriftingStack(p, period, drift)
    estimate = None
    voltage, moved = np.zeros(time.size), np.zeros(time.size)
    if control == "tracked":
        tuned = online.identifier_for(known, period, noise=ERROR * stroke, memory=memory)
        adaptive = online.AdaptiveFeedForward(tuned.values)
        x = 0.0
        for k in range(time.size):
            voltage[k] = adaptive.step_voltage(
                float(wanted[k]), x + float(error[k - 1] if k else 0.0)
            )
            moved[k] = x = stack.step(float(voltage[k]))
        estimate = adaptive.estimate
    else:
        plain = online.FeedForward(online.stack_values(known, period))
        step = plain.step_voltage if control == "feed-forward" else float
        voltage[:] = [step(w) for w in wanted.tolist()]
        moved[:] = [stack.step(u) for u in voltage.tolist()]
    bare = DriftingStack({**p, "A": 0.0, "beta": 0.0, "gamma": 0.0, "delta": 0.0}, period)
    linear = np.array([bare.step(w) for w in wanted.tolist()])
    return Drive(time, wanted, voltage, moved, linear, estimate)
