"""The hysteresis force from one sample of the voltage to the next, in bounded constant cost.

The step goes along the line from u- to u, along which eq. (8) has no kink: the voltage turns at
samples only. It is the L-stable one of two implicit stages, F_i = known + (1 - 1/sqrt(2)) g(F_i),
of order two; as g falls with f, each stage has one root, and Newton's steps towards it begin on its
outer side. So f stays bounded when the voltage crosses the whole range between two samples, at the
same cost as ever; an explicit step would leave the floating-point numbers.

Sources: Yang and Zhu 2015, eqs. 8 and 37 to 41; R. Alexander, SIAM J. Numer. Anal. 14 (1977) 1006.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from psa_casadi.component import Expression

#: Parameters that are tracked, in the order of z, and the unit of each.
TRACKED = {
    "A": "N/V", "beta": "N/V", "gamma": "N/V", "delta": "N/(V.s)", "n": "1",
    "k_L": "N/V", "offset": "N",
}  # fmt: skip
COUNT = len(TRACKED)
SHAPES = 5
#: A parameter of the hysteresis is at least of this size, as a share of k_L, to change by shares.
_LEAST_SIZE = 0.02
#: The slope of force over voltage is taken as no smaller than this share of k_L.
_LEAST_SLOPE = 0.2
#: Implicit share of a stage of the force's step, and Newton steps towards it.
IMPLICIT, _NEWTON = 1.0 - math.sqrt(0.5), 2
#: Newton steps towards the voltage of a wanted force.
_OUTER = 3


@dataclass(frozen=True)
class Constants:
    """What does not change from sample to sample: spreads (7), lag weights, noise [N], ...

    `forget` is T/memory; `keep`, `old`, `new` step the lag.
    """

    start: tuple[Expression, ...]
    spread: tuple[Expression, ...]
    h_ref: Expression
    hold_rate: Expression
    stiffness: Expression
    period: Expression
    keep: Expression
    old: Expression
    new: Expression
    noise_square: Expression
    forget: Expression
    standstill_rate: Expression


def constants(p: Mapping[str, Expression]) -> Constants:
    """Return the constants from parameters in SI units (`online_identification` lists them)."""
    k, share, T = p["k_L"], p["spread"], p["period"]
    bend, least = ca.fabs(p["beta"]) + ca.fabs(p["gamma"]), _LEAST_SIZE * k
    sizes = (
        ca.fabs(p["A"]) + least, bend + least, bend + least, ca.fabs(p["delta"]) + least,
        1.0, k, 0.1 * k * p["u_rated"],
    )  # fmt: skip
    keep = ca.exp(-T / p["lag"])
    held = (1.0 - keep) * p["lag"] / T
    return Constants(
        start=(p["A"], p["beta"], p["gamma"], p["delta"], p["n"], k, 0.0),
        spread=tuple(share * size for size in sizes),
        h_ref=p["h_ref"],
        hold_rate=p["hold_rate"],
        stiffness=p["stiffness"],
        period=T,
        keep=keep,
        old=held - keep,
        new=1.0 - held,
        noise_square=(p["noise"] * p["stiffness"]) ** 2,
        forget=T / p["memory"],
        standstill_rate=p["standstill_rate"],
    )


def estimates(c: Constants, z: Sequence[Expression]) -> list[Expression]:
    """Return A, beta, gamma, delta, n, k_L, offset in SI units."""
    return [a + s * d for a, s, d in zip(c.start, c.spread, z, strict=True)]


def slopes(
    c: Constants, theta: Sequence[Expression], f: Expression, du: Expression, swept: Expression,
    held: Expression,
) -> tuple[Expression, Expression, list[Expression]]:  # fmt: skip
    """Return the change of f over du at f, its derivative by f, and by A, beta, gamma, delta, n.

    `swept` is |du| and `held` the integral of u sgn(u'), both with the smooth sign.
    """
    A, beta, gamma, delta, n = theta[:SHAPES]
    ratio = f / c.h_ref
    square = ratio * ratio + 1e-24
    bare = square ** (0.5 * (n - 1.0))  # |ratio|^(n-1)
    signed, power = ratio * bare, square * bare / ca.sqrt(square)
    bend = beta * swept * signed + gamma * du * power
    slope = -n * (beta * swept * bare + gamma * du * signed / ca.sqrt(square)) / c.h_ref
    by = [du, -swept * signed, -du * power, held, -0.5 * ca.log(square) * bend]
    return A * du - bend + delta * held, slope, by


def swept_over(
    c: Constants, last: Expression, u: Expression
) -> tuple[Expression, Expression, Expression, Expression]:
    """Return du [V], |du|, the integral of u sgn(u') over a period [V s], and u' [V/s]."""
    du = u - last
    rate = du / c.period
    sign = rate / ca.sqrt(rate * rate + c.hold_rate * c.hold_rate)
    return du, du * sign, 0.5 * (u + last) * sign * c.period, rate


def stages(
    c: Constants, theta: Sequence[Expression], f: Expression, last: Expression, u: Expression
) -> tuple[Expression, Expression, Expression]:
    """Return the two stages of the step of f, of which the second is its end, and df/du there.

    The derivative is that before the last Newton step towards each stage.
    """
    du, swept, held, _ = swept_over(c, last, u)
    free = theta[0] * du + theta[3] * held

    def solved(known: Expression) -> tuple[Expression, Expression, Expression]:
        """Return the stage F = known + IMPLICIT g(F), from the outer side of the root, g_F, g_u."""
        farthest = ca.fmax(_largest_force(c, theta), ca.fabs(f)) + ca.fabs(theta[3] * held)
        stage = ca.fmax(ca.fmin(known + IMPLICIT * free, farthest), -farthest)
        slope = by_u = ca.SX(0)
        for _ in range(_NEWTON):
            change, slope, _ = slopes(c, theta, stage, du, swept, held)
            by_u = ca.if_else(ca.fabs(du) > 0.0, (change - theta[3] * held) / du, theta[0])
            stage -= (stage - known - IMPLICIT * change) / (1.0 - IMPLICIT * slope)
        return stage, slope, by_u

    first, slope, by_u = solved(f)
    rise = (slope * IMPLICIT * by_u) / (1.0 - IMPLICIT * slope) + by_u
    end, slope, by_u = solved(f + (1.0 - IMPLICIT) / IMPLICIT * (first - f))
    return first, end, ((1.0 - IMPLICIT) * rise + IMPLICIT * by_u) / (1.0 - IMPLICIT * slope)


def _largest_force(c: Constants, theta: Sequence[Expression]) -> Expression:
    """Return the size of f [N] at which it bends no further, the larger one of both directions."""
    A, beta, gamma, _, n = theta[:SHAPES]
    sizes = ca.fabs(beta) + ca.fabs(gamma)
    least = ca.fmax(beta - ca.fabs(gamma), 1e-3 * sizes + 1e-12)
    return c.h_ref * (ca.fabs(A) / least + 1e-24) ** (1.0 / n)


def force_after(
    c: Constants, theta: Sequence[Expression], f: Expression, last: Expression, u: Expression
) -> Expression:
    """Return the hysteresis force [N] after the voltage has gone from `last` to u in one period."""
    return stages(c, theta, f, last, u)[1]


def linearising_voltage(
    c: Constants, theta: Sequence[Expression], f: Expression, last: Expression, guess: Expression,
    force: Expression,
) -> Expression:  # fmt: skip
    """Return the next voltage u [V] at which k_L u + f_H(u) is the wanted force [N] (eqs. 39-41).

    The paper subtracts the observed force of the moment; here it is that of the next instant, so
    that no sample is lost. From `guess`, Newton's steps, which are enough for a jump across the
    range: the slope only grows along the way from a turn.
    """
    u = guess
    for _ in range(_OUTER):
        _, end, by_u = stages(c, theta, f, last, u)
        slope = ca.fmax(theta[5] + by_u, _LEAST_SLOPE * theta[5])
        u -= (theta[5] * u + end - force) / slope
    return u
