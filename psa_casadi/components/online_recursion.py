"""Recursive identification of the hysteresis: what happens from one sample to the next.

The observer runs eq. (8) on the voltage (paper eq. 37), and its parameters follow the measured
displacement by recursive least squares (paper eq. 38). The paper does not say on which regressors.
Two readings exist. The *equation error* takes the derivative of the measured hysteresis force, in
which A, beta, gamma and delta are linear for a given n; it divides noise by the sampling period,
and its regressors hold the same noise, so that the estimates are biased. Here the *output error*
is taken: the predicted displacement is compared with the measured one, and the regressors are the
prediction's derivatives, which the same recursion carries along::

    f+ = f after a step from u- to u (`hysteresis_step`),   sigma_j = df/dtheta_j by its derivative
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
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from psa_casadi.component import Expression
from psa_casadi.components.hysteresis_step import (
    IMPLICIT,
    Constants,
    estimates,
    slopes,
    stages,
    swept_over,
)

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
