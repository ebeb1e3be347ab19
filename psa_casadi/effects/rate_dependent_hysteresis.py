"""Rate-dependent hysteresis: the loop's width changes with the logarithm of the voltage rate.

At one rate the hysteresis force is c times that of the base, c = exp(rate_gain L) with
L = lg sqrt(1 + (u'/(rate_onset u_rated))^2), the decades above the onset: with f = c h and
h' = A u' - (bends at h), the slope A grows by c and the bends by c^(1-n), at every amplitude alike.
A positive gain widens loops and lowers the stroke as the rate rises. Bends scaled alone would
leave the width of a full loop as it is. Both factors are positive at any rate and gain, so that the
bends never turn into a runaway.
"""

import casadi as ca

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.smooth import magnitude_power, rate_magnitude, signed_power
from psa_casadi.variables import Parameter


def _equations(s: Symbols) -> Equations:
    relative = s.voltage_rate / (s.rate_onset * s.u_rated)
    decades = 0.5 * ca.log10(1 + relative**2)
    growth = s.rate_gain * decades
    ratio = s.f_H / s.h_ref
    bends = s.beta * rate_magnitude(s) * signed_power(ratio, s.n)
    bends += s.gamma * s.voltage_rate * magnitude_power(ratio, s.n)
    slope = (ca.exp(growth) - 1) * s.A * s.voltage_rate
    return Equations(add={"hysteresis_rate": slope + (1 - ca.exp((1 - s.n) * growth)) * bends})


RATE_DEPENDENT_HYSTERESIS = Component(
    name="rate_dependent_hysteresis",
    description="loop width and stroke change with the logarithm of the voltage rate",
    source=(
        "Damjanovic, Phys. Rev. B 55 (1997) R649: logarithm of frequency; elements that grow with"
        " the rate: Ang, Khosla and Riviere, IEEE/ASME Trans. Mechatronics 12 (2007) 134"
    ),
    gain="rate_gain",
    equation_text=(
        "f_H' gains (c - 1) A u' + (1 - c^(1-n)) (beta |u'| sgn(f_H) r^n + gamma u' r^n),"
        "  c = (1 + (u'/(rate_onset u_rated))^2)^(rate_gain/(2 ln 10)),  r = |f_H|/h_ref"
    ),
    parameters=(
        Parameter(
            "rate_gain",
            0.0,
            "1",
            (-0.5, 0.5),
            "growth of the loop's width per decade of voltage rate",
            scale=0.05,
        ),
        Parameter(
            "rate_onset",
            1.0,
            "1/s",
            (1e-3, 1e3),
            "rate over rated voltage, below which the loop no longer changes",
            log=True,
        ),
    ),
    equations=_equations,
    probe={"rate_onset": (0.1, 3.0)},
    looks_like="loops grow wider, or narrower, by the same share with every decade of rate",
)
