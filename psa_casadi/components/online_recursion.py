"""Recursive identification of the hysteresis: what happens from one sample to the next.

The observer runs eq. (8) on the voltage (paper eq. 37), and its parameters follow the measured
displacement by recursive least squares (paper eq. 38). The paper does not say on which regressors.
Two readings exist. The *equation error* takes the derivative of the measured hysteresis force, in
which A, beta, gamma and delta are linear for a given n; it divides noise by the sampling period,
and its regressors hold the same noise, so that the estimates are biased. Here the *output error*
is taken: the predicted displacement is compared with the measured one, and the regressors are the
prediction's derivatives, which the same recursion carries along::

    f+ = f after a step from u- to u (below),   sigma_j = df/dtheta_j by its derivative
    phi, psi_j, nu: f, sigma_j and u behind the stack's lag, exact for signals linear in between
    e = K x - (k_L nu + phi + offset),   d = (psi_A ... psi_n, nu, 1) in units of the spreads
    g = P d,  s = noise^2 + d'g,  z+ = z + g e/s (at most 0.05 long),  P+ = S (P - g g'/s) S,
    S = diag(sqrt(1 + (T/memory) (1 - P_ii)))

n enters like the others: no logarithm of data, no case distinction. For parameters that enter
linearly this is recursive least squares. The force f and phi follow a change of the parameters by
their sensitivities. Forgetting stretches P in each coordinate by a share that vanishes where
P_ii reaches its start 1, so P never exceeds it: without excitation nothing winds up. While the
voltage stands (|u'| below `standstill_rate`), z and P rest.

Sources: Yang and Zhu 2015, eqs. 37, 38; L. Ljung and T. Soderstrom, "Theory and Practice of
Recursive Identification", MIT Press 1983, chapter 3 (recursive prediction error method); on
forgetting that is bounded (there by other terms): M. E. Salgado, G. C. Goodwin and R. H. Middleton,
Int. J. Control 47 (1988) 477; P by its factors: G. J. Bierman, "Factorization Methods for Discrete
Sequential Estimation", Academic Press 1977, chapter V.

The step of the force goes along the line from u- to u, along which eq. (8) has no kink: the voltage
turns at samples only. It is the L-stable one of two implicit stages, F_i = known + (1 - 1/sqrt(2))
g(F_i), of order two; as g falls with f, each stage has one root, and Newton's steps towards it
begin on its outer side. So f stays bounded when the voltage crosses the whole range between two
samples, at the same cost as ever; an explicit step would leave the floating-point numbers
(R. Alexander, SIAM J. Numer. Anal. 14 (1977) 1006).
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


#: Deviations stay within this many spreads; the bend n stays above its least value.
_FARTHEST, _LEAST_N = 3.0, 1.0
#: Largest change of z in one sample: what a reversal suddenly shows is taken in over some samples.
_LARGEST_STEP = 0.05


@dataclass(frozen=True)
class Memory:
    """What is kept between samples: z (7), the factors of P, signals and their lags.

    `factors` are 7 columns: what U has above its diagonal of ones, and D, of P = U D U'.
    `u` [V], `f` [N] and `sigma` (5) at the last sample; `nu` [V], `phi` [N], `psi` (5) behind the
    lag.
    """

    z: list[Expression]
    factors: list[list[Expression]]
    u: Expression
    f: Expression
    sigma: list[Expression]
    nu: Expression
    phi: Expression
    psi: list[Expression]


def stepped(
    c: Constants, theta: Sequence[Expression], m: Memory, u: Expression
) -> tuple[Expression, list[Expression], Expression]:
    """Return f and sigma after the voltage has gone from `m.u` to u in one period, and u'."""
    du, swept, held, rate = swept_over(c, m.u, u)
    first, last, _ = stages(c, theta, m.f, m.u, u)
    _, slope, by = slopes(c, theta, first, du, swept, held)
    rises = [(slope * s + b) / (1.0 - IMPLICIT * slope) for s, b in zip(m.sigma, by, strict=True)]
    _, slope, by = slopes(c, theta, last, du, swept, held)
    sigma = [
        (s + (1.0 - IMPLICIT) * r + IMPLICIT * b) / (1.0 - IMPLICIT * slope)
        for s, r, b in zip(m.sigma, rises, by, strict=True)
    ]
    return last, sigma, rate


def advance(c: Constants, m: Memory, u: Expression, x: Expression) -> Memory:
    """Return the memory after a sample of voltage u [V] and displacement x [m]."""
    theta = estimates(c, m.z)
    f, sigma, rate = stepped(c, theta, m, u)
    nu = c.keep * m.nu + c.old * m.u + c.new * u
    phi = c.keep * m.phi + c.old * m.f + c.new * f
    psi = [
        c.keep * was + c.old * before + c.new * now
        for was, before, now in zip(m.psi, m.sigma, sigma, strict=True)
    ]
    d = [s * v for s, v in zip(c.spread, (*psi, nu, 1.0), strict=True)]
    error = c.stiffness * x - (theta[5] * nu + phi + theta[6])
    gate = rate * rate > c.standstill_rate * c.standstill_rate
    z, factors = correct(c, m, d, error, gate)
    moved = [s * (b - a) for s, a, b in zip(c.spread, m.z, z, strict=True)]
    f = f + sum(s * v for s, v in zip(sigma, moved, strict=False))
    phi = phi + sum(s * v for s, v in zip(psi, moved, strict=False))
    return Memory(z, factors, u, f, sigma, nu, phi, psi)


def correct(
    c: Constants, m: Memory, d: Sequence[Expression], error: Expression, gate: Expression
) -> tuple[list[Expression], list[list[Expression]]]:
    """Return z and the factors of P after an error [N] with regressors d, where `gate` is 1, not 0.

    Bierman's update: the factors keep P positive and its small directions, which the difference of
    the covariances would lose, in single precision within a second.
    """
    variance = c.noise_square
    g: list[Expression] = []
    new: list[list[Expression]] = []
    for j, (*above, own) in enumerate(m.factors):
        f = gate * (sum((u * b for u, b in zip(above, d, strict=False)), d[j]))
        v, before = own * f, variance
        variance += f * v
        new.append(
            [
                *(u - f / before * k for u, k in zip(above, g, strict=True)),
                own * (before / variance),
            ]
        )
        g = [*(k + u * v for k, u in zip(g, above, strict=True)), v]
    step = error / variance
    size = ca.fabs(step) * ca.sqrt(sum(b * b for b in g))
    step = step * _LARGEST_STEP / ca.fmax(size, _LARGEST_STEP)
    z = bounded(c, [a + step * b for a, b in zip(m.z, g, strict=True)])
    stretch = [ca.sqrt(1.0 + gate * c.forget * (1.0 - p)) for p in variances(new)]
    return z, [
        [*(u * stretch[i] / stretch[j] for i, u in enumerate(above)), own * stretch[j] ** 2]
        for j, (*above, own) in enumerate(new)
    ]


def variances(factors: Sequence[Sequence[Expression]]) -> list[Expression]:
    """Return the diagonal of P from its factors."""
    return [
        column[-1] + sum(factors[j][i] ** 2 * factors[j][-1] for j in range(i + 1, len(factors)))
        for i, column in enumerate(factors)
    ]


def bounded(c: Constants, z: Sequence[Expression]) -> list[Expression]:
    """Return z within its bounds: n >= 1; beta, beta +- gamma a tenth of their starts or more.

    Beyond, the force of eq. (8) would grow without bound.
    """
    z = [ca.fmax(ca.fmin(v, _FARTHEST), -_FARTHEST) for v in z]
    z[4] = ca.fmax(z[4], (_LEAST_N - c.start[4]) / c.spread[4])
    z[1] = ca.fmax(z[1], -0.9 * c.start[1] / c.spread[1])
    beta, gamma = c.start[1] + c.spread[1] * z[1], c.start[2]
    least, apart = c.start[1] + gamma, c.start[1] - gamma
    z[2] = ca.fmax(z[2], (ca.fmin(0.1 * least, 2.0 * least) - beta - gamma) / c.spread[2])
    z[2] = ca.fmin(z[2], (beta - 0.1 * apart - gamma) / c.spread[2])
    return z
