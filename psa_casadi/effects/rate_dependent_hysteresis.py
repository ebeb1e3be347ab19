"""Rate-dependent hysteresis: the loop's width changes with the logarithm of the voltage rate.

The hysteresis force acts c-fold, c = exp(rate_gain L) with L = lg sqrt(1 + (u'/(rate_onset
u_rated))^2), the decades above the onset, at every amplitude alike. A positive gain widens loops
and lowers the stroke as the rate rises. The rate acts at once and leaves the memory as it is: of
play operators whose thresholds grow with the rate this explains two thirds, coefficients scaled in
the equation of f_H a third, as those keep what a past rate did.
"""

import casadi as ca

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.variables import Parameter


def _equations(s: Symbols) -> Equations:
    relative = s.voltage_rate / (s.rate_onset * s.u_rated)
    decades = 0.5 * ca.log10(1 + relative**2)
    return Equations(add={"free_force": (ca.exp(s.rate_gain * decades) - 1) * s.f_H})


RATE_DEPENDENT_HYSTERESIS = Component(
    name="rate_dependent_hysteresis",
    description="loop width and stroke change with the logarithm of the voltage rate",
    source=(
        "Damjanovic, Phys. Rev. B 55 (1997) R649: logarithm of frequency; elements that grow with"
        " the rate: Ang, Khosla and Riviere, IEEE/ASME Trans. Mechatronics 12 (2007) 134"
    ),
    gain="rate_gain",
    equation_text=(
        "force gains (c - 1) f_H,  c = (1 + (u'/(rate_onset u_rated))^2)^(rate_gain/(2 ln 10))"
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
