"""The force in a prestress mechanism during a step of voltage, as CasADi expressions."""

from dataclasses import dataclass
from typing import Any

import casadi as ca

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
