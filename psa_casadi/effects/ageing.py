"""Ageing: the gain falls with the logarithm of time, or of the cycles that the stack has made.

Time counts from the zero of the record's clock; before it nothing ages. What went on earlier, since
the poling of the ceramic, is part of k_L. Where cycles age it, one at rated voltage counts as one
second does; which of the two it is, is not fitted but tried.
"""

import casadi as ca

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.smooth import rate_magnitude
from psa_casadi.variables import Parameter, State

#: Width of the smooth start of ageing at time 0, over ageing_time.
_WIDTH = 1e-9


def _ageing(s: Symbols) -> Equations:
    """Ageing: the gain falls with the logarithm of time, or of the cycles that the stack has made.

    Time counts from the zero of the record's clock; before it nothing ages. What went on earlier,
    since the poling of the ceramic, is part of k_L. Where cycles age it, one at rated voltage
    counts as one second does; which of the two it is, is not fitted but tried.
    """
    age = s.time + s.ageing_by_travel * (s.travel - s.time)
    ages = age / s.ageing_time
    since = 0.5 * (ages + ca.sqrt(ages**2 + _WIDTH**2))
    lost = s.ageing_gain * ca.log10(1 + since)
    travel = 0.5 * rate_magnitude(s) / s.u_rated
    return Equations(der={"travel": travel}, add={"free_force": -lost * s.k_L * s.u})


AGEING = Component(
    name="ageing",
    description="the gain falls with the logarithm of time or of the cycles made",
    source=(
        "Jaffe, Cook and Jaffe, Piezoelectric Ceramics, 1971: ageing per decade of time; Hall and"
        " Ben-Omran, J. Phys.: Condens. Matter 10 (1998) 9129: of cycles"
    ),
    gain="ageing_gain",
    equation_text=(
        "f_L gains -ageing_gain lg(1 + a/ageing_time) k_L u,  a = t from the zero of the record's"
        " clock, or N where ageing_by_travel = 1,  N' = |u'|/(2 u_rated), 1 s for each cycle"
    ),
    parameters=(
        Parameter(
            "ageing_gain", 0.0, "1", (0.0, 0.3), "share of the gain lost per decade", scale=0.01
        ),
        Parameter(
            "ageing_time", 1.0, "s", (1e-3, 1e7), "age at time 0 of the record's clock", log=True
        ),
        Parameter(
            "ageing_by_travel", 0.0, "1", (0.0, 1.0), "0: time ages, 1: cycles do", fitted=False
        ),
    ),
    states=(
        State("travel", "s", "cycles at rated voltage, 1 s each", 1.0, memory=True, settles=False),
    ),
    equations=_ageing,
    probe={"ageing_time": (0.1, 10.0), "ageing_by_travel": (0.0, 1.0)},
    remedy=Remedy("identify_again", "record"),
    looks_like="the gain falls by the same share with every decade of time, or of cycles made",
)
