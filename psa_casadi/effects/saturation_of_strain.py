"""Saturation of strain: the curve flattens at high voltage, on both branches alike."""

import casadi as ca

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.variables import Parameter


def _saturation_of_strain(s: Symbols) -> Equations:
    """Saturation of strain: the curve flattens at high voltage, on both branches alike."""
    share = 1 / ca.sqrt(1 + s.saturation_gain * (s.u / s.u_rated) ** 2) - 1
    return Equations(add={"free_force": s.k_L * s.u * share})


SATURATION_OF_STRAIN = Component(
    name="saturation_of_strain",
    description="the strain saturates as the domains that can still turn run out",
    source=(
        "saturating anhysteretic polarisation: Smith, Smart Material Systems, SIAM 2005, chapter 2;"
        " here u / sqrt(1 + g u^2) for its Langevin or tanh law"
    ),
    gain="saturation_gain",
    equation_text="f_L = k_L u / sqrt(1 + saturation_gain (u/u_rated)^2)",
    parameters=(
        Parameter(
            "saturation_gain",
            0.0,
            "1",
            (0.0, 10.0),
            "twice the share of force that is lost at rated voltage, while that is small",
            scale=0.05,
        ),
    ),
    equations=_saturation_of_strain,
    remedy=Remedy("undo_curve", "range"),
    looks_like="the curve flattens towards high voltage on both branches, at every rate",
)
