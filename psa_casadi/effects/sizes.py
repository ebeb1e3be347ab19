"""Typical sizes of a stack as expressions, for both bases."""

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
