"""Typical sizes of the signals of a stack, from its parameter values; used as nominals."""

from math import sqrt

from psa_casadi.model.component import Expression, Symbols
from psa_casadi.model.variables import Values


def voltage_scale(p: Values) -> float:
    """Rated voltage span `u_rated` [V]."""
    return abs(p["u_rated"])


def stop_scale(p: Values) -> float:
    """Usual size of a stop element of the hysteresis, a tenth of the rated voltage [V]."""
    return 0.1 * voltage_scale(p)


def force_scale(p: Values) -> float:
    """Force at rated voltage, `k_L u_rated` [N]."""
    return abs(p["k_L"]) * voltage_scale(p)


def hysteresis_scale(p: Values) -> float:
    """Usual size of a hysteresis force, a tenth of the force at rated voltage [N]."""
    return 0.1 * abs(p["k_L"]) * abs(p["u_rated"])


def stiffness_scale(p: Values) -> float:
    """Series stiffness of wafers and bonding layers, or the single stiffness [N/m]."""
    if "k_B" in p:
        return p["k_P"] * p["k_B"] / (p["k_P"] + p["k_B"])
    return p["k"]


def stroke_scale(p: Values) -> float:
    """Free stroke at rated voltage [m]."""
    return force_scale(p) / stiffness_scale(p)


def reading_scale(p: Values) -> float:
    """An ordinary error of a reading, a thousandth of the stroke [m]."""
    return 1e-3 * stroke_scale(p)


def velocity_scale(p: Values) -> float:
    """Stroke times the lowest natural angular frequency [m/s]."""
    if "k_B" in p:
        omega = min(sqrt(p["k_P"] / p["m_P"]), sqrt(p["k_B"] / p["m_B"]))
    else:
        omega = sqrt(p["k"] / p["m"])
    return stroke_scale(p) * omega


def current_scale(p: Values) -> float:
    """Charging current at one rated voltage span per millisecond [A]."""
    return p["C_p"] * voltage_scale(p) / 1e-3


def charge_scale(p: Values) -> float:
    """Charge at rated voltage, `C_p u_rated` [C]."""
    return p["C_p"] * voltage_scale(p)


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
