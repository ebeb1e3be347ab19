"""The stack behind a synthetic record: its parameters, and how they are drawn from a seed."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

HOLD_RATE_OVER_SPAN = 1e-3
"""hold_rate / u_rated [1/s]; far below any rate of interest."""


@dataclass(frozen=True)
class Stack:
    """Parameters of the paper's stack, SI units, in the letters of the paper (G = 1).

    r_s [Ohm], c_p_el [F] drive; u_rated [V] voltage span; k_l [N/V] linear force; a, beta, gamma
    [N/V], delta [N/(V.s)], n [1], h_ref [N] hysteresis; tau [s] lag; m_*, c_*, k_* [kg, N.s/m,
    N/m] wafers (p) and bonding layers (b).
    """

    r_s: float
    c_p_el: float
    u_rated: float
    k_l: float
    a: float
    beta: float
    gamma: float
    delta: float
    n: float
    h_ref: float
    tau: float
    m_p: float
    c_p: float
    k_p: float
    m_b: float
    c_b: float
    k_b: float

    @property
    def drive_time(self) -> float:
        """R_s C_p [s]."""
        return self.r_s * self.c_p_el

    @property
    def hold_rate(self) -> float:
        """Rate of voltage below which the hysteresis rests [V/s]."""
        return HOLD_RATE_OVER_SPAN * self.u_rated

    @property
    def compliance(self) -> float:
        """Static displacement per force, 1/k_p + 1/k_b [m/N]."""
        return 1.0 / self.k_p + 1.0 / self.k_b

    @property
    def stroke(self) -> float:
        """Linear displacement at the rated voltage [m]."""
        return self.k_l * self.u_rated * self.compliance

    def force_poles(self) -> ComplexArray:
        """Poles from force to displacement: lag, wafers, bonding layers [rad/s], paper eq. (12)."""
        wafers = np.roots([self.m_p, self.c_p, self.k_p])
        layers = np.roots([self.m_b, self.c_b, self.k_b])
        return np.concatenate(([-1.0 / self.tau + 0j], wafers, layers)).astype(np.complex128)


def draw_stack(rng: np.random.Generator) -> Stack:
    """Draw a typical stack: 60-100 V, 10-40 um, blocking force 0.6-3 kN, resonances 1-20 kHz.

    The hysteresis is 8-16 % of the stroke on the full quasi-static loop (A < 0: displacement lags
    voltage). Draws with two poles closer than 5 % are repeated, because the modal solution of
    `base.py` needs simple poles.
    """
    for stack in _draws(rng):
        poles = np.append(stack.force_poles(), -1.0 / stack.drive_time)
        distance = np.abs(poles[:, None] - poles[None, :]) + np.diag(np.full(poles.size, np.inf))
        if bool(np.all(distance > 0.05 * np.abs(poles)[:, None])):
            return stack
    raise RuntimeError("The generator of stacks ended, which it never does.")


def _draws(rng: np.random.Generator) -> Iterator[Stack]:
    while True:
        span = float(rng.uniform(60.0, 100.0))
        force = _log_uniform(rng, 600.0, 3000.0)
        stiffness = force / float(rng.uniform(10e-6, 40e-6))
        ratio = float(rng.uniform(0.05, 0.3))
        k_p, k_b = stiffness * (1.0 + ratio), stiffness * (1.0 + 1.0 / ratio)
        m_p, c_p = _mass_damping(rng, k_p)
        m_b, c_b = _mass_damping(rng, k_b)
        capacitance = float(rng.uniform(1e-6, 6e-6))
        stack = Stack(
            r_s=_log_uniform(rng, 2e-5, 1.3e-4) / capacitance,
            c_p_el=capacitance,
            u_rated=span,
            k_l=force / span,
            a=-float(rng.uniform(2.0, 4.5)) / span,
            beta=0.0,
            gamma=0.0,
            delta=0.0,
            n=float(rng.uniform(1.0, 1.8)),
            h_ref=1.0,
            tau=_log_uniform(rng, 2e-4, 2e-3),
            m_p=m_p,
            c_p=c_p,
            k_p=k_p,
            m_b=m_b,
            c_b=c_b,
            k_b=k_b,
        )
        yield _with_hysteresis(rng, stack, force * float(rng.uniform(0.08, 0.16)))


def _with_hysteresis(rng: np.random.Generator, stack: Stack, width: float) -> Stack:
    """Scale a normalised Bouc-Wen element to the loop width [N] wanted at half the span."""
    skew = float(rng.uniform(-0.4, 0.25))
    beta = -stack.a / (1.0 - skew)
    shape = replace(stack, beta=beta, gamma=skew * beta)
    scale = width / loop_width(shape)
    delta = -float(rng.uniform(0.02, 0.08)) * scale / (0.25 * stack.u_rated)
    return replace(
        shape,
        a=shape.a * scale,
        beta=beta * scale,
        gamma=skew * beta * scale,
        delta=delta,
        h_ref=scale,
    )


def loop_width(stack: Stack, steps: int = 200) -> float:
    """Width [N] at half span of the third loop 0 -> u_rated -> 0, rate-independent terms only."""
    du = stack.u_rated / steps
    force, middle = 0.0, (0.0, 0.0)
    for _ in range(3):
        up, force = _branch(stack, force, du, steps)
        down, force = _branch(stack, force, -du, steps)
        middle = (up, down)
    return middle[1] - middle[0]


def _branch(stack: Stack, force: float, du: float, steps: int) -> tuple[float, float]:
    middle = force
    for step in range(steps):
        power = (abs(force) / stack.h_ref) ** stack.n
        sign = math.copysign(1.0, force)
        force += stack.a * du - power * (stack.beta * sign * abs(du) + stack.gamma * du)
        if step == steps // 2 - 1:
            middle = force
    return middle, force


def _mass_damping(rng: np.random.Generator, stiffness: float) -> tuple[float, float]:
    """Mass [kg] and damping [N.s/m] of a resonance of 1-20 kHz with 4-150 % of critical damping."""
    omega = 2.0 * math.pi * _log_uniform(rng, 1e3, 2e4)
    ratio = _log_uniform(rng, 0.04, 1.5)
    mass = stiffness / omega**2
    return mass, 2.0 * ratio * omega * mass


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))
