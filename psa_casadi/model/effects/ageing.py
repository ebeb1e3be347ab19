"""Effects of heat and age: how the force per volt changes while a stack works."""

import casadi as ca

from psa_casadi.model.component import Equations, Remedy, Symbols, effect
from psa_casadi.model.shapes import form, magnitude_power, positive, rate_magnitude, share
from psa_casadi.model.variables import Parameter, State, Values


def _heat(p: Values) -> float:
    """Heat [1] under one cycle 0 .. u_rated .. 0 a second, at equilibrium."""
    straight = abs(p["A"]) * p["u_rated"] / (2.0 * p["h_ref"])
    bent = (abs(p["A"]) / max(p["beta"] + p["gamma"], 1e-9 * abs(p["A"]), 1e-300)) ** (1.0 / p["n"])
    largest = max(min(straight, bent), 1e-3)
    return float(largest ** (p["n"] + 1.0)) * p["heating_time"]


def _heating_scale(p: Values) -> float:
    """A gain that changes by 1 % under one full cycle a second."""
    return 0.01 / _heat(p)


@effect(
    share(
        "heating_gain",
        (0.0, 1e3),
        "growth of the gain per loss of one rated swing at h_ref still felt",
        _heating_scale,
    ),
    Parameter("heating_time", 3.0, "s", (1e-2, 1e5), "time constant of cooling", log=True),
    State("heat", "1", "loss not cooled off, in rated swings at h_ref", _heat, memory=True),
    kind="changing gain",
    description="the gain changes as losses warm the stack, and recovers when it rests",
    source=(
        "Zheng, Takahashi, Yoshikawa, Uchino and de Vries, J. Am. Ceram. Soc. 79 (1996) 3193: heat"
        " generation in multilayer actuators in proportion to the loss of the hysteresis"
    ),
    needs=("bouc_wen",),
    equation_text=(
        "force gains heating_gain q (f_L + f_H),"
        "  q' = |u'|/u_rated (|f_H|/h_ref)^(n+1) - q / heating_time"
    ),
    probe={"heating_time": (1.0, 10.0)},
    remedy=Remedy("cool", "record"),
    looks_like="the gain climbs while the drive is fast and recovers when it rests",
)
def self_heating(s: Symbols) -> Equations:
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


#: Width of the smooth start of ageing at time 0, over ageing_time.
_BEGIN_WIDTH = 1e-9


@effect(
    share("ageing_gain", (0.0, 0.3), "share of the gain lost per decade", 0.01),
    positive("ageing_time", 1.0, "s", (1e-3, 1e7), "age at time 0 of the record's clock"),
    form("ageing_by_travel", "0: time ages, 1: cycles do"),
    State("travel", "s", "cycles at rated voltage, 1 s each", 1.0, memory=True, settles=False),
    kind="changing gain",
    description="the gain falls with the logarithm of time or of the cycles made",
    source=(
        "Jaffe, Cook and Jaffe, Piezoelectric Ceramics, 1971: ageing per decade of time; Hall and"
        " Ben-Omran, J. Phys.: Condens. Matter 10 (1998) 9129: of cycles"
    ),
    equation_text=(
        "f_L gains -ageing_gain lg(1 + a/ageing_time) k_L u,  a = t from the zero of the record's"
        " clock, or N where ageing_by_travel = 1,  N' = |u'|/(2 u_rated), 1 s for each cycle"
    ),
    probe={"ageing_time": (0.1, 10.0), "ageing_by_travel": (0.0, 1.0)},
    remedy=Remedy("identify_again", "record"),
    looks_like="the gain falls by the same share with every decade of time, or of cycles made",
)
def ageing(s: Symbols) -> Equations:
    """Ageing: the gain falls with the logarithm of time, or of the cycles that the stack has made.

    Time counts from the zero of the record's clock; before it nothing ages. What went on earlier,
    since the poling of the ceramic, is part of k_L. Where cycles age it, one at rated voltage
    counts as one second does; which of the two it is, is not fitted but tried.
    """
    age = s.time + s.ageing_by_travel * (s.travel - s.time)
    ages = age / s.ageing_time
    since = 0.5 * (ages + ca.sqrt(ages**2 + _BEGIN_WIDTH**2))
    lost = s.ageing_gain * ca.log10(1 + since)
    travel = 0.5 * rate_magnitude(s) / s.u_rated
    return Equations(der={"travel": travel}, add={"free_force": -lost * s.k_L * s.u})
