"""Effects of the material: how the force per volt changes with field, time, heat and age."""

import casadi as ca

from psa_casadi.model.component import Equations, Remedy, Symbols, effect
from psa_casadi.model.shapes import (
    form,
    magnitude_power,
    motion,
    positive,
    rate_magnitude,
    share,
    smooth_magnitude,
)
from psa_casadi.model.variables import Parameter, State, Values

#: Time constants of the relaxations, as multiples of `creep_time`: a decade apart.
_CREEP_RATIOS = (1.0, 10.0, 100.0)


@effect(
    share("creep_gain", (0.0, 0.5), "creep per decade of time over elongation", 0.01),
    positive("creep_time", 0.1, "s", (1e-3, 1e4), "fastest time constant of the creep"),
    *(
        motion(
            f"z_c{k}", f"elongation relaxed with time constant {ratio:g} creep_time", memory=True
        )
        for k, ratio in enumerate(_CREEP_RATIOS, 1)
    ),
    kind="relaxation",
    description="displacement that keeps growing for seconds to hours at constant voltage",
    source="Croft, Shed and Devasia, J. Dyn. Sys. Meas. Control 123 (2001) 35: relaxations",
    equation_text="x_c = creep_gain (z_1 + z_2 + z_3),  creep_time 10^(i-1) z_i' + z_i = x",
    probe={"creep_time": (0.03, 0.3, 3.0)},
    remedy=Remedy("wait_or_feed_forward", "hold"),
    looks_like="the residual is a straight line in log time after every change of voltage",
)
def slow_creep(s: Symbols) -> Equations:
    """Slow creep: displacement that keeps growing for seconds to hours at constant voltage."""
    relaxed = [s.z_c1, s.z_c2, s.z_c3]
    return Equations(
        der={
            f"z_c{k}": (s.tip_displacement - relaxed[k - 1]) / (s.creep_time * ratio)
            for k, ratio in enumerate(_CREEP_RATIOS, 1)
        },
        add={"displacement": s.creep_gain * sum(relaxed)},
    )


#: Width of the smooth magnitude, over rated voltage.
_REVERSAL_WIDTH = 1e-3


@effect(
    share("field_gain", (0.0, 2.0), "growth of the gain at rated voltage", 0.05),
    kind="curve",
    description="the displacement per volt grows with the voltage",
    source=(
        "Rayleigh's law d = d_0 + alpha E of domain walls: Damjanovic and Demartin, J. Phys. D 29"
        " (1996) 2057"
    ),
    equation_text="f_L gains k_L field_gain u |u| / u_rated",
    remedy=Remedy("undo_curve", "range"),
    looks_like="the gain grows in proportion to the amplitude; both branches curve upwards",
)
def field_dependent_gain(s: Symbols) -> Equations:
    """Field-dependent gain: the displacement per volt grows with the voltage.

    Rayleigh's law is d(E_0) = d_0 + alpha E_0 for an amplitude E_0: strain d_0 E + alpha E_0 E,
    with loops (alpha/2) (E_0^2 - E^2) around it. A drive that swings from 0 to a peak and back has
    its reversals at u = 0 and at the peak, and along its first branch, from the unpolarised rest,
    the law is d_0 E + alpha E |E|. The loops around this curve are the hysteresis force's business;
    the bend of their middle line is what the base lacks.
    """
    share = smooth_magnitude(s.u, _REVERSAL_WIDTH * s.u_rated) / s.u_rated
    return Equations(add={"free_force": s.k_L * s.field_gain * s.u * share})


@effect(
    share("capacitance_gain", (0.0, 3.0), "growth of the capacitance at rated voltage", 0.1),
    kind="lag",
    description="the capacitance of the stack grows with the voltage",
    source=(
        "Rayleigh's law of the permittivity: Hall, J. Mater. Sci. 36 (2001) 4575; large-signal"
        " capacitance in data sheets of stacks"
    ),
    equation_text="C_p u' = i/(1 + capacitance_gain |u|/u_rated)",
    needs_column=("charge", "current"),
    remedy=Remedy("control_charge", "slew"),
    looks_like="charge per volt grows with the amplitude; the drive's lag grows with the voltage",
)
def field_dependent_capacitance(s: Symbols) -> Equations:
    """Field-dependent capacitance: the stack takes more charge per volt at high voltage.

    dq/du = C_p (1 + capacitance_gain |u|/u_rated), Rayleigh's law of the polarisation. The
    displacement shows no more of it than a drive whose lag grows with the voltage, so that it is
    looked for where a charge or a current was measured.
    """
    share = smooth_magnitude(s.u, _REVERSAL_WIDTH * s.u_rated) / s.u_rated
    grown = s.capacitance_gain * share
    return Equations(
        add={
            "voltage_rate": -s.stack_current / s.C_p * grown / (1 + grown),
            "stack_charge": 0.5 * s.C_p * s.u * grown,
        }
    )


@effect(
    share(
        "saturation_gain",
        (0.0, 10.0),
        "twice the share of force that is lost at rated voltage, while that is small",
        0.05,
    ),
    kind="curve",
    description="the strain saturates as the domains that can still turn run out",
    source=(
        "saturating anhysteretic polarisation: Smith, Smart Material Systems, SIAM 2005, chapter 2;"
        " here u / sqrt(1 + g u^2) for its Langevin or tanh law"
    ),
    equation_text="f_L = k_L u / sqrt(1 + saturation_gain (u/u_rated)^2)",
    remedy=Remedy("undo_curve", "range"),
    looks_like="the curve flattens towards high voltage on both branches, at every rate",
)
def saturation_of_strain(s: Symbols) -> Equations:
    """Saturation of strain: the curve flattens at high voltage, on both branches."""
    share = 1 / ca.sqrt(1 + s.saturation_gain * (s.u / s.u_rated) ** 2) - 1
    return Equations(add={"free_force": s.k_L * s.u * share})


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
