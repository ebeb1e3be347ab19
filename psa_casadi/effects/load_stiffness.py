"""Load stiffness: an elastic load that hardens with displacement.

A linear load is no effect of its own: it stiffens k_B (or k) and, for the same stroke per volt,
scales k_L, so that voltage and displacement cannot tell a stack with a spring from a stiffer one.
Only a factor that depends on displacement shows. A load that softens is left out:
beyond some displacement it would run away. Below the resonances a load and a bent sensor are the
same curve over the displacement, so that both need as many shapes: cubic and quintic forces here.
"""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.effects.sizes import static_stiffness, stroke
from psa_casadi.variables import Parameter


def _equations(s: Symbols) -> Equations:
    square = (s.x / stroke(s)) ** 2
    force = static_stiffness(s) * s.x * square * (1 + s.load_quintic * square)
    return Equations(add={"tip_force": -s.load_hardening * force})


LOAD_STIFFNESS = Component(
    name="load_stiffness",
    description="an elastic load that grows stiffer with displacement",
    source="Duffing's hardening spring; flexures that stretch as they bend: Howell 2001",
    gain="load_hardening",
    equation_text=(
        "f_load gains -load_hardening k_s x q^2 (1 + load_quintic q^2),  q = x/x_s,"
        "  x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k"
    ),
    parameters=(
        Parameter(
            "load_hardening",
            0.0,
            "1",
            (0.0, 5.0),
            "load's secant stiffness at full stroke over the stack's",
            scale=0.05,
        ),
        Parameter(
            "load_quintic",
            0.0,
            "1",
            (-0.5, 20.0),
            "quintic over cubic part at full stroke",
            scale=0.5,
        ),
    ),
    equations=_equations,
    looks_like="the curve flattens with displacement, however fast or by what force it got there",
)
