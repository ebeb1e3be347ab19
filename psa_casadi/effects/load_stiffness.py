"""Load stiffness: an elastic load or guide whose stiffness changes with displacement.

A linear load is no effect of its own: it stiffens k_B (or k) and, for the same stroke per volt,
scales k_L, so that voltage and displacement cannot tell a stack with a spring from a stiffer one.
Only a factor that depends on displacement shows: contacts and disc springs bow the curve, flexures
that stretch bend it at the end (Duffing's cubic force 20 sin(a) gain q^3 is the angle
a = atan(1/5)). Below the resonances a load and a bent sensor are the same curve over the
displacement, so that both have the same forms. A force near half of what the stack can exert levels
off: a load that softens would run away.
"""

import casadi as ca

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.effects.bend import ANGLES, BEND_TEXT, bend, shape_parameters
from psa_casadi.effects.sizes import static_stiffness, stroke
from psa_casadi.variables import Parameter

#: Force over stiffness times stroke at which it levels off.
_MOST = 0.5


def _load_stiffness(s: Symbols) -> Equations:
    """Load stiffness: an elastic load or guide whose stiffness changes with displacement.

    A linear load is no effect of its own: it stiffens k_B (or k) and, for the same stroke per volt,
    scales k_L, so that voltage and displacement cannot tell a stack with a spring from a stiffer
    one. Only a factor that depends on displacement shows: contacts and disc springs bow the curve,
    flexures that stretch bend it at the end (Duffing's cubic force 20 sin(a) gain q^3 is the angle
    a = atan(1/5)). Below the resonances a load and a bent sensor are the same curve over the
    displacement, so that both have the same forms. A force near half of what the stack can exert
    levels off: a load that softens would run away.
    """
    force = s.load_gain * bend(s.x / stroke(s), s.load_angle, s.load_wave)
    levelled = force / ca.sqrt(1 + (force / _MOST) ** 2)
    return Equations(add={"tip_force": -static_stiffness(s) * stroke(s) * levelled})


LOAD_STIFFNESS = Component(
    name="load_stiffness",
    description="an elastic load or guide whose stiffness changes with displacement",
    source="Duffing's spring; flexures that stretch: Howell 2001; contacts: Johnson 1985",
    gain="load_gain",
    equation_text=(
        "f_load gains -k_s x_s F/sqrt(1 + (2 F)^2),  F = load_gain b(x/x_s),"
        "  x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k,  " + BEND_TEXT.format("load")
    ),
    parameters=(
        Parameter(
            "load_gain",
            0.0,
            "1",
            (-0.5, 0.5),
            "bow and S of the load's force over the stack's stiffness times the stroke",
            scale=0.002,
        ),
        *shape_parameters("load"),
    ),
    equations=_load_stiffness,
    curve="displacement",
    measured_by="load_force",
    probe={"load_angle": ANGLES},
    remedy=Remedy("undo_load_curve", "range"),
    looks_like="the curve bends with displacement, however fast or by what force it got there",
)
