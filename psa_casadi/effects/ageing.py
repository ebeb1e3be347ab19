"""Ageing: the gain falls with the logarithm of time, whatever the drive does.

Time counts from the zero of the record's clock; before it nothing ages. What went on earlier, since
the poling of the ceramic, is part of k_L.
"""

import casadi as ca

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.variables import Parameter

#: Width of the smooth start of ageing at time 0, over ageing_time.
_WIDTH = 1e-9


def _equations(s: Symbols) -> Equations:
    ages = s.time / s.ageing_time
    since = 0.5 * (ages + ca.sqrt(ages**2 + _WIDTH**2))
    lost = s.ageing_gain * ca.log10(1 + since)
    return Equations(add={"free_force": -lost * s.k_L * s.u})


AGEING = Component(
    name="ageing",
    description="the gain falls with the logarithm of time, whatever the drive does",
    source="Jaffe, Cook and Jaffe, Piezoelectric Ceramics, 1971: ageing per decade of time",
    gain="ageing_gain",
    equation_text=(
        "f_L gains -ageing_gain lg(1 + t/ageing_time) k_L u,  t from the zero of the record's clock"
    ),
    parameters=(
        Parameter(
            "ageing_gain", 0.0, "1", (0.0, 0.3), "share of the gain lost per decade", scale=0.01
        ),
        Parameter(
            "ageing_time", 1.0, "s", (1e-3, 1e7), "age at time 0 of the record's clock", log=True
        ),
    ),
    equations=_equations,
    probe={"ageing_time": (0.1, 10.0)},
    looks_like="the gain falls by the same share with every decade of time since the start",
)
