"""Reciprocal coupling: the wafers feel the bonding layers too, as Newton's third law demands.

Stable for every gain g from 0 to 1 + m_B/m_P: with q = 1 - g + g^2 the characteristic polynomial is
m_P m_B s^4 + (m_P c_B + m_B (c_P + g c_B)) s^3 + (m_P k_B + m_B (k_P + g k_B) + q c_P c_B) s^2
+ q (c_P k_B + k_P c_B) s + q k_P k_B, and Hurwitz' determinant is a sum of positive terms.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.scales import stroke_scale, velocity_scale
from psa_casadi.variables import Parameter, State

#: Gains to try, over 0.25: a fit from near 0 does not find a truth near 1, since the static gain
#: k_L (1 + (1 - g) k_P/k_B) / (k_P (1 - g + g^2)) has a ridge between the two.
_STEPS = (0.0, 2.0, 4.0)


def _reciprocal_coupling(s: Symbols) -> Equations:
    """Reciprocal coupling: the wafers feel the bonding layers too, as Newton's third law demands.

    Stable for every gain g from 0 to 1 + m_B/m_P: with q = 1 - g + g^2 the characteristic
    polynomial is m_P m_B s^4 + (m_P c_B + m_B (c_P + g c_B)) s^3 + (m_P k_B + m_B (k_P + g k_B) + q
    c_P c_B) s^2 + q (c_P k_B + k_P c_B) s + q k_P k_B, and Hurwitz' determinant is a sum of
    positive terms.
    """
    g = s.reciprocal_gain
    pull = s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)
    held = s.c_B * s.v_x + s.k_B * s.x + (s.c_P + g * s.c_B) * s.v_r + (s.k_P + g * s.k_B) * s.y_r
    blocked = (s.c_B + (1 - g) * s.c_P) * s.v_r + (s.k_B + (1 - g) * s.k_P) * s.y_r
    return Equations(
        der={"y_r": s.v_r, "v_r": -held / s.m_P},
        add={
            "wafer_force": g * pull,
            "transmitted_force": -g * (s.c_P * s.v_y + s.k_P * s.y),
            "blocked_force": g * blocked,
        },
    )


RECIPROCAL_COUPLING = Component(
    name="reciprocal_coupling",
    description="the bonding layers push back on the wafers: two masses with action and reaction",
    source="Newton's third law, whose reaction Yang and Zhu 2015, eqs. 4 and 5, leave out",
    needs=("cascade_mechanics",),
    gain="reciprocal_gain",
    finite_step=_STEPS,
    equation_text=(
        "m_P y'' + c_P y' + k_P y = f_out + g F,  F = c_B (x' - y') + k_B (x - y);  "
        "m_B x'' + F = (1 - g) (c_P y' + k_P y) + f_load,  g = reciprocal_gain: 0 the paper's"
        " cascade, 1 Newton;  y + g y_r is y with the output held at zero, for the blocked force"
    ),
    parameters=(
        Parameter(
            "reciprocal_gain",
            0.0,
            "1",
            (0.0, 1.2),
            "share of the reaction: 0 the paper's cascade, 1 Newton; more only in error",
            scale=0.25,
        ),
    ),
    states=(
        State(
            "y_r",
            "m",
            "change of y from holding the output at zero, over the gain",
            stroke_scale,
            display_unit="um",
        ),
        State("v_r", "m/s", "its rate", velocity_scale, display_unit="um/s"),
    ),
    equations=_reciprocal_coupling,
    remedy=Remedy("extended_model", "resonance"),
    looks_like="the resonances and the zero between them do not fit the one-way cascade",
)
