"""Load stiffness: an elastic load or guide whose stiffness changes with displacement.

A linear load is no effect of its own: it stiffens k_B (or k) and, for the same stroke per volt,
scales k_L, so that voltage and displacement cannot tell a stack with a spring from a stiffer one.
Only a factor that depends on displacement shows: contacts and disc springs bow the curve, flexures
that stretch (Duffing's cubic force 20 gain q^3 is an angle of atan(1/5)) bend it at the end. Below
the resonances a load and a bent sensor are the same curve over the displacement, so that both have
the same forms. Far beyond the stroke the force levels off: a load that softens would run away.
"""

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.effects.bend import ANGLES, BEND_TEXT, bend, shape_parameters
from psa_casadi.effects.sizes import static_stiffness, stroke
from psa_casadi.variables import Parameter

#: Displacement over the stroke towards which q levels off.
_MOST = 1.5


def _equations(s: Symbols) -> Equations:
    curve = bend(_levelled(s.x / stroke(s)), s.load_angle, s.load_wave)
    return Equations(add={"tip_force": -s.load_gain * static_stiffness(s) * stroke(s) * curve})


def _levelled(z: Expression) -> Expression:
    return z / (1 + (z / _MOST) ** 8) ** 0.125


LOAD_STIFFNESS = Component(
    name="load_stiffness",
    description="an elastic load or guide whose stiffness changes with displacement",
    source="Duffing's spring; flexures that stretch: Howell 2001; contacts: Johnson 1985",
    gain="load_gain",
    equation_text=(
        "f_load gains -load_gain k_s x_s b(q),  q = z/(1 + (z/1.5)^8)^(1/8),  z = x/x_s,"
        "  x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k,  " + BEND_TEXT.format("load")
    ),
    parameters=(
        Parameter(
            "load_gain",
            0.0,
            "1",
            (-0.05, 0.05),
            "bow and S of the load's force over the stack's stiffness times the stroke",
            scale=0.002,
        ),
        *shape_parameters("load"),
    ),
    equations=_equations,
    curve="displacement",
    probe={"load_angle": ANGLES},
    looks_like="the curve bends with displacement, however fast or by what force it got there",
)
