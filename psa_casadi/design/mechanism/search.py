"""The search for a mechanism: a nonlinear programme with exact derivatives, from several starts.

All in units of the stack: time 1/w0 (`Mechanics.frequency`), stiffness `K = D(0)/M(0)`. The
unknowns are mass, damping and stiffness (mu, chi, kappa) and, in logarithms, the natural frequency
w_i and damping ratio z_i of every pair of mechanical poles, tied to the mechanism by

    D + M H = lead * prod_i (s^2 + 2 z_i w_i s + w_i^2)

so that a pair that turns from complex to real has no kink, and an unstable loop does not exist. One
more unknown is the frequency w_b below which |X/F| stays above -3 dB of its static value. IPOPT
takes the derivatives from CasADi. A goal that the limits do not allow is missed by as little as
possible: its shortfall, in logarithms, is an unknown with a steep cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from math import isfinite, log, sqrt
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.design.mechanism.loop import (
    ComplexArray,
    Mechanics,
    Mounting,
    mechanical_poles,
)
from psa_casadi.interruption import raise_if_stopped
from psa_casadi.units import FloatArray


def product(a: Any, b: Any) -> Any:
    """Product of two polynomials in CasADi, highest power first."""
    a, b = ca.vertcat(a), ca.vertcat(b)
    terms = [0.0] * (a.numel() + b.numel() - 1)
    for i in range(a.numel()):
        for k in range(b.numel()):
            terms[i + k] = terms[i + k] + a[i] * b[k]
    return ca.vertcat(*terms)


def total(a: Any, b: Any) -> Any:
    """Sum of two polynomials in CasADi, highest power first."""
    size = max(a.numel(), b.numel())
    return ca.vertcat(*[0.0] * (size - a.numel()), a) + ca.vertcat(*[0.0] * (size - b.numel()), b)


def log_square(polynomial: Any, w: Any) -> Any:
    """Return ln |p(i w)|^2 of a polynomial, highest power first."""
    real, imaginary = 0.0, 0.0
    for k in range(polynomial.numel()):
        real, imaginary = -w * imaginary + polynomial[k], w * real
    return ca.log(real * real + imaginary * imaginary)


#: Steps of the answer: the step size doubles from phase to phase.
_PHASES, _STEPS = 14, 10


@dataclass(frozen=True)
class Loop:
    """A mounted stack in units of time 1/w0 and stiffness K, as expressions.

    `h` (3,) mass, damping, stiffness; `w`, `z` (pairs,) natural frequencies and damping ratios;
    `static` is 1 + kappa; `ahead` the numerator's s coefficient over its constant; `lag`, `drive`.
    """

    h: Any
    w: Any
    z: Any
    static: Any
    ahead: float
    lag: float
    drive: float


def force_history(loop: Loop) -> list[Any]:
    """Return the mechanism's force over k_L u_rated K N(0)/D(0) at every step.

    The chain drive, lag, pairs of poles is stepped with the method of Radau (order 3, L-stable):
    `z+ = (1 - 2/3 hA + h^2 A^2/6)^-1 (1 + hA/3) z`, z measured from its final value.
    """
    A, last = _chain(loop)
    size = A.shape[0]
    pairs = loop.w.numel()
    final = ca.vertcat(1.0, 1.0, *[1.0, 0.0] * pairs)
    away = -final
    rows = [ca.DM.zeros(1, size)]
    rows[0][last] = 1.0
    derivatives = [ca.MX(rows[0])]
    for _ in range(3):
        derivatives.append(derivatives[-1] @ A)
    mu, chi, kappa = loop.h[0], loop.h[1], loop.h[2]
    read = sum(
        weight * (derivatives[k] + loop.ahead * derivatives[k + 1])
        for k, weight in enumerate((kappa, chi, mu))
    )
    slowest = max(loop.lag, loop.drive)
    h = 60.0 * slowest / (_STEPS * (2.0**_PHASES - 1.0))
    history = []
    unit = ca.DM.eye(size)
    for _ in range(_PHASES):
        step = ca.solve(unit - 2.0 / 3.0 * h * A + h * h / 6.0 * (A @ A), unit + h / 3.0 * A)
        for _ in range(_STEPS):
            away = step @ away
            history.append((kappa + read @ away) / loop.static)
        h *= 2.0
    return history


def _chain(loop: Loop) -> tuple[Any, int]:
    """Return the matrix of drive, lag and pairs of poles in a row, and the place of the last."""
    pairs = loop.w.numel()
    size = 2 + 2 * pairs
    A = ca.MX.zeros(size, size)
    A[0, 0] = -1.0 / loop.drive
    A[1, 0], A[1, 1] = 1.0 / loop.lag, -1.0 / loop.lag
    source = 1
    for i in range(pairs):
        at = 2 + 2 * i
        w, z = loop.w[i], loop.z[i]
        A[at, at + 1] = 1.0
        A[at + 1, source], A[at + 1, at], A[at + 1, at + 1] = w * w, -w * w, -2.0 * z * w
        source = at
    return A, source


#: Parts of w_b at which |X/F| is held above -3 dB, and the cost of a shortfall.
_PARTS = np.linspace(0.05, 1.0, 20)
_STEEP = 100.0
#: The force is held below this share of its limit, since it is looked at in steps.
_MARGIN = 0.998
#: Cost of mass, damping and stiffness: of two equal designs the smaller one.
_SMALL = 1e-7
_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 300},
}


@dataclass(frozen=True)
class Wish:
    """What is wanted, SI: least damping ratio, least bandwidth [Hz], or pairs of poles.

    `pairs` are (natural frequency [rad/s], damping ratio). `stroke_loss` is the largest share,
    `force` [N] the largest force in the mechanism, `mass` [kg] and `damping` [N.s/m] the ranges.
    """

    damping: float | None
    bandwidth: float | None
    pairs: tuple[tuple[float, float], ...]
    stroke_loss: float
    force: float | None
    mass: tuple[float, float]
    damper: tuple[float, float]


@dataclass(frozen=True)
class Candidate:
    """What one start led to: the mechanism, its cost, and whether the search ended well."""

    mounting: Mounting
    cost: float
    converged: bool


def search(mechanics: Mechanics, wish: Wish, starts: int, seed: int = 0) -> list[Candidate]:
    """Search from several starts, and return what each led to, best first."""
    draw = np.random.default_rng(seed)
    pairs = (len(mechanics.denominator) - 1) // 2
    found = []
    for order in _assignments(len(wish.pairs), pairs):
        problem = _Problem(mechanics, wish, order)
        found += [problem.solve(draw) for _ in range(starts)]
    return sorted(found, key=lambda c: (not c.converged, c.cost))


def _assignments(wanted: int, pairs: int) -> Sequence[tuple[int, ...]]:
    """Which pair of the stack's poles each wanted pair may become."""
    return list(permutations(range(pairs), wanted))


class _Problem:
    """The programme for one assignment of wanted pairs to pairs of poles."""

    def __init__(self, mechanics: Mechanics, wish: Wish, order: tuple[int, ...]) -> None:
        self.mechanics, self.wish, self.order = mechanics, wish, order
        self.w0 = mechanics.frequency
        self.K = float(mechanics.denominator[-1] / mechanics.path[-1])
        self.count = (len(mechanics.denominator) - 1) // 2
        n, d, m = (
            self._scaled(p) for p in (mechanics.numerator, mechanics.denominator, mechanics.path)
        )
        self.h, self.lw, self.lz = (
            ca.MX.sym("h", 3),
            *(ca.MX.sym(name, self.count) for name in ("w", "z")),
        )
        self.b, self.least, self.short = ca.MX.sym("b"), ca.MX.sym("least"), ca.MX.sym("short")
        self.closed = total(ca.MX(ca.DM(d)), product(ca.MX(ca.DM(m)), self.h))
        self.n = n
        self.equal: list[Any] = []
        self.positive: list[Any] = []
        self._tie()
        self._band()
        self._force()
        cost = self._cost()
        x = ca.vertcat(self.h, self.lw, self.lz, self.b, self.least, self.short)
        g = ca.vertcat(*self.equal, *self.positive)
        self.free = sum(e.numel() for e in self.equal), sum(e.numel() for e in self.positive)
        programme: dict[str, Any] = {"x": x, "f": cost, "g": g}
        self.solver = ca.nlpsol("mechanism", "ipopt", programme, _OPTIONS)

    def _scaled(self, polynomial: FloatArray) -> FloatArray:
        powers = np.arange(len(polynomial) - 1, -1, -1)
        return np.asarray(polynomial * self.w0**powers / polynomial[-1])

    def _tie(self) -> None:
        """The closed polynomial's coefficients are those of the product of pairs."""
        pairs = self.closed[0]
        for i in range(self.count):
            w, z = ca.exp(self.lw[i]), ca.exp(self.lz[i])
            pairs = product(pairs, ca.vertcat(1.0, 2.0 * z * w, w * w))
        self.equal.append(pairs[1:] / self.closed[1:] - 1.0)

    def _band(self) -> None:
        """|N/(D + M H)| over its static value is above 1/sqrt(2) up to w_b."""
        for part in _PARTS:
            w = part * ca.exp(self.b)
            above = log_square(ca.MX(ca.DM(self.n)), w) - log_square(self.closed, w)
            self.positive.append(above + 2.0 * ca.log(self.closed[-1]) + log(2.0))

    def _force(self) -> None:
        """|m x'' + c x' + k x| stays below the limit in the answer to a step of rated voltage."""
        if self.wish.force is None:
            return
        limit = (
            _MARGIN * self.wish.force / (self.mechanics.force * self.K / self.mechanics.stiffness)
        )
        loop = Loop(
            h=self.h, w=ca.exp(self.lw), z=ca.exp(self.lz), static=self.closed[-1],
            ahead=float(self.n[0] / self.n[1]), lag=self.mechanics.lag * self.w0,
            drive=self.mechanics.drive * self.w0,
        )  # fmt: skip
        for force in force_history(loop):
            self.positive += [limit - force, limit + force]

    def _cost(self) -> Any:
        wish, lz = self.wish, self.lz
        cost = _STEEP * self.short + _SMALL * ca.sum1(self.h)
        if wish.pairs:
            for (w, z), i in zip(wish.pairs, self.order, strict=True):
                cost += (self.lw[i] - log(w / self.w0)) ** 2 + (lz[i] - log(z)) ** 2
            return cost
        if wish.damping is not None:
            self.positive.append(lz - log(wish.damping) + self.short)
        else:
            self.positive.append(lz - self.least)
            cost -= self.least
        if wish.bandwidth is not None:
            wanted = log(2.0 * np.pi * wish.bandwidth / self.w0)
            self.positive.append(self.b - wanted + self.short)
        else:
            cost -= self.b
        return cost

    def solve(self, draw: np.random.Generator) -> Candidate:
        """Search from one random start."""
        wish, unit = self.wish, (self.K / self.w0**2, self.K / self.w0, self.K)
        low = [wish.mass[0] / unit[0], wish.damper[0] / unit[1], 0.0]
        most = wish.stroke_loss / (1.0 - wish.stroke_loss)
        high = [wish.mass[1] / unit[0], wish.damper[1] / unit[1], most]
        sizes = (*np.exp(draw.uniform(log(1e-2), log(30.0), 2)), most * draw.uniform(0.05, 0.95))
        start = np.clip(sizes, low, high)
        mounting = Mounting(*(float(s * u) for s, u in zip(start, unit, strict=True)))
        w, z = _pairs_of(mechanical_poles(self.mechanics, mounting) / self.w0)
        x0 = [*start, *np.log(w), *np.log(z), min(np.log(w).min(), 3.0), min(0.0, log(min(z))), 0.0]
        few = [-25.0] * self.count, [25.0] * self.count
        found = self.solver(
            x0=x0,
            lbx=[*low, *few[0], *[log(1e-4)] * self.count, -25.0, -12.0, 0.0],
            ubx=[*high, *few[1], *[log(1e5)] * self.count, 25.0, 0.0, 50.0],
            lbg=[0.0] * sum(self.free),
            ubg=[0.0] * self.free[0] + [np.inf] * self.free[1],
        )
        raise_if_stopped()  # which the solver takes for a failure
        h = np.clip(np.array(found["x"]).ravel()[:3], low, high)
        cost = float(found["f"])
        ended = bool(self.solver.stats()["success"]) and isfinite(cost)
        values = (float(a * u) for a, u in zip(h, unit, strict=True))
        return Candidate(Mounting(*values), cost, ended)


def _pairs_of(poles: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return natural frequencies and damping ratios of poles paired off; unstable ones are damped.

    Complex poles are paired with their conjugates, real ones with their neighbours in size.
    """
    upper = [p for p in poles if p.imag > 1e-9 * abs(p)]
    real = sorted(p.real for p in poles if abs(p.imag) <= 1e-9 * abs(p))
    w = [abs(p) for p in upper] + [
        sqrt(abs(a * b)) for a, b in zip(real[::2], real[1::2], strict=True)
    ]
    sums = [-2.0 * p.real for p in upper]
    sums += [-(a + b) for a, b in zip(real[::2], real[1::2], strict=True)]
    z = [max(s / (2.0 * size), 1e-3) for s, size in zip(sums, w, strict=True)]
    order = np.argsort(w)
    return np.array(w)[order], np.array(z)[order]
