"""Self-heating: losses warm the stack under fast drive, and its gain changes with the warmth.

The loss is what the hysteresis dissipates: f_H u' less the rate of the energy f_H^2/(2 A) that it
stores leaves beta |u'| |f_H| r^n / A, which grows with the third power of a small swing and more
slowly with a large one. Share of heat, heat capacity and the gain's temperature coefficient act as
one number, heating_gain.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.smooth import magnitude_power, rate_magnitude
from psa_casadi.variables import Parameter, State, Values


def _self_heating(s: Symbols) -> Equations:
    """Self-heating: losses warm the stack under fast drive, and its gain changes with the warmth.

    The loss is what the hysteresis dissipates: f_H u' less the rate of the energy f_H^2/(2 A) that
    it stores leaves beta |u'| |f_H| r^n / A, which grows with the third power of a small swing and
    more slowly with a large one. Share of heat, heat capacity and the gain's temperature
    coefficient act as one number, heating_gain.
    """
    loss = rate_magnitude(s) / s.u_rated * magnitude_power(s.f_H / s.h_ref, s.n + 1)
    return Equations(
        der={"heat": loss - s.heat / s.heating_time},
        add={"free_force": s.heating_gain * s.heat * (s.k_L * s.u + s.f_H)},
    )


def _heat(p: Values) -> float:
    """Heat [1] under one cycle 0 .. u_rated .. 0 a second, at equilibrium."""
    straight = abs(p["A"]) * p["u_rated"] / (2.0 * p["h_ref"])
    bent = (abs(p["A"]) / max(p["beta"] + p["gamma"], 1e-9 * abs(p["A"]), 1e-300)) ** (1.0 / p["n"])
    largest = max(min(straight, bent), 1e-3)
    return float(largest ** (p["n"] + 1.0)) * p["heating_time"]


def _scale(p: Values) -> float:
    """A gain that changes by 1 % under one full cycle a second."""
    return 0.01 / _heat(p)


SELF_HEATING = Component(
    name="self_heating",
    description="the gain changes as losses warm the stack, and recovers when it rests",
    source=(
        "Zheng, Takahashi, Yoshikawa, Uchino and de Vries, J. Am. Ceram. Soc. 79 (1996) 3193: heat"
        " generation in multilayer actuators in proportion to the loss of the hysteresis"
    ),
    gain="heating_gain",
    needs=("bouc_wen",),
    equation_text=(
        "force gains heating_gain q (f_L + f_H),"
        "  q' = |u'|/u_rated (|f_H|/h_ref)^(n+1) - q / heating_time"
    ),
    parameters=(
        Parameter(
            "heating_gain",
            0.0,
            "1",
            (0.0, 1e3),
            "growth of the gain per loss of one rated swing at h_ref still felt",
            scale=_scale,
        ),
        Parameter("heating_time", 3.0, "s", (1e-2, 1e5), "time constant of cooling", log=True),
    ),
    states=(
        State("heat", "1", "loss not cooled off, in rated swings at h_ref", _heat, memory=True),
    ),
    equations=_self_heating,
    probe={"heating_time": (1.0, 10.0)},
    remedy=Remedy("cool", "record"),
    looks_like="the gain climbs while the drive is fast and recovers when it rests",
)
