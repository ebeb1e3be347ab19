"""Typical sizes of a stack as expressions, for both bases, and a smooth magnitude."""

import casadi as ca

from psa_casadi.component import Expression, Symbols


def static_stiffness(s: Symbols) -> Expression:
    """Return the static stiffness from free force to displacement [N/m].

    The cascade's wafers and bonding layers in series, k_P k_B / (k_P + k_B), or the single k.
    """
    if hasattr(s, "k_B"):
        return s.k_P * s.k_B / (s.k_P + s.k_B)
    return s.k


def stroke(s: Symbols) -> Expression:
    """Return the linear free stroke at rated voltage, k_L u_rated / static stiffness [m]."""
    return s.k_L * s.u_rated / static_stiffness(s)


def smooth_magnitude(value: Expression, width: Expression) -> Expression:
    """Return `|value|` as `value^2 / sqrt(value^2 + width^2)`: 0 with slope 0 at 0.

    It is 1 % below `|value|` at 7 widths. A value much smaller than the width counts as none.
    """
    return value**2 / ca.sqrt(value**2 + width**2)
