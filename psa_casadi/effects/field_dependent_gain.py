"""Field-dependent gain: the displacement per volt grows with the voltage.

Rayleigh's law is d(E_0) = d_0 + alpha E_0 for an amplitude E_0: strain d_0 E + alpha E_0 E, with
loops (alpha/2) (E_0^2 - E^2) around it. A drive that swings from 0 to a peak and back has its
reversals at u = 0 and at the peak, and along its first branch, from the unpolarised rest, the law
is d_0 E + alpha E |E|. The loops around this curve are the hysteresis force's business; the
bend of their middle line is what the base lacks.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.smooth import smooth_magnitude
from psa_casadi.variables import Parameter

#: Width of the smooth magnitude, over rated voltage.
_WIDTH = 1e-3


def _field_dependent_gain(s: Symbols) -> Equations:
    """Field-dependent gain: the displacement per volt grows with the voltage.

    Rayleigh's law is d(E_0) = d_0 + alpha E_0 for an amplitude E_0: strain d_0 E + alpha E_0 E,
    with loops (alpha/2) (E_0^2 - E^2) around it. A drive that swings from 0 to a peak and back has
    its reversals at u = 0 and at the peak, and along its first branch, from the unpolarised rest,
    the law is d_0 E + alpha E |E|. The loops around this curve are the hysteresis force's business;
    the bend of their middle line is what the base lacks.
    """
    share = smooth_magnitude(s.u, _WIDTH * s.u_rated) / s.u_rated
    return Equations(add={"free_force": s.k_L * s.field_gain * s.u * share})


FIELD_DEPENDENT_GAIN = Component(
    name="field_dependent_gain",
    description="the displacement per volt grows with the voltage",
    source=(
        "Rayleigh's law d = d_0 + alpha E of domain walls: Damjanovic and Demartin, J. Phys. D 29"
        " (1996) 2057"
    ),
    gain="field_gain",
    equation_text="f_L gains k_L field_gain u |u| / u_rated",
    parameters=(
        Parameter(
            "field_gain", 0.0, "1", (0.0, 2.0), "growth of the gain at rated voltage", scale=0.05
        ),
    ),
    equations=_field_dependent_gain,
    remedy=Remedy("undo_curve", "range"),
    looks_like="the gain grows in proportion to the amplitude; both branches curve upwards",
)
