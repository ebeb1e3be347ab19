"""Rate-dependent hysteresis: the loop's width changes with the logarithm of the voltage rate.

Two forms, of which one is tried after the other, with c - 1 = exp(rate_gain L) - 1 and
L = lg sqrt(1 + (u'/(rate_onset u_rated))^2), the decades above the onset:

* the hysteresis force acts c-fold, at every amplitude alike;
* play elements' thresholds w grow c-fold (Al Janaideh): what is added is nothing after a reversal,
  and (c - 1) w behind the motion once the element moves, whatever the amplitude.

A positive gain widens loops and lowers the stroke as the rate rises. The rate acts at once and
leaves the memory as it is.
"""

import casadi as ca

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.scales import stop_scale, voltage_scale
from psa_casadi.smooth import direction, magnitude_power, signed_power, stop_rate
from psa_casadi.variables import Parameter, State

#: Force over voltage of the play elements, over k_L: loops of some 10 % of the stroke.
_SHARE = 0.3
#: How steeply the force sets in where the stop element comes to its end.
_ONSET = 6.0


def _rate_dependent_hysteresis(s: Symbols) -> Equations:
    """Rate-dependent hysteresis: the loop's width changes with the logarithm of the voltage rate.

    Two forms, of which one is tried after the other, with c - 1 = exp(rate_gain L) - 1 and L = lg
    sqrt(1 + (u'/(rate_onset u_rated))^2), the decades above the onset:

    * the hysteresis force acts c-fold, at every amplitude alike;
    * play elements' thresholds w grow c-fold (Al Janaideh): nothing is added after a reversal,
      and (c - 1) w behind the motion once the element moves, whatever the amplitude.

    A positive gain widens loops and lowers the stroke as the rate rises. The rate acts at once and
    leaves the memory as it is.
    """
    relative = s.voltage_rate / (s.rate_onset * s.u_rated)
    grown = ca.exp(s.rate_gain * 0.5 * ca.log10(1 + relative**2)) - 1
    width = s.rate_threshold * s.u_rated
    at_end = magnitude_power(s.z_r / width, _ONSET)
    same_way = 0.5 * (direction(s) + signed_power(s.z_r / width, 1.0))
    behind = -_SHARE * s.k_L * width * at_end * same_way
    force = s.f_H + s.rate_by_threshold * (behind - s.f_H)
    return Equations(
        der={"z_r": stop_rate(s, s.z_r, width)},
        add={"free_force": grown * force},
    )


RATE_DEPENDENT_HYSTERESIS = Component(
    name="rate_dependent_hysteresis",
    description="loop width and stroke change with the logarithm of the voltage rate",
    source=(
        "Damjanovic, Phys. Rev. B 55 (1997) R649: logarithm of frequency; elements that grow with"
        " the rate: Ang, Khosla and Riviere, IEEE/ASME Trans. Mechatronics 12 (2007) 134;"
        " thresholds that do: Al Janaideh, Su and Rakheja, Smart Mater. Struct. 17 (2008) 035026"
    ),
    gain="rate_gain",
    needs=("bouc_wen",),
    equation_text=(
        "force gains (c - 1) f_H,  c = (1 + (u'/(rate_onset u_rated))^2)^(rate_gain/(2 ln 10)),  or"
        " where rate_by_threshold = 1  -(c - 1) 0.3 k_L w |z/w|^6 (sgn(u') + z/w)/2,"
        "  z' = u' - (|u'| sgn(z) + u')/2 (|z|/w)^4,  w = rate_threshold u_rated"
    ),
    parameters=(
        Parameter(
            "rate_gain",
            0.0,
            "1",
            (-0.5, 0.5),
            "growth of the loop's width per decade of voltage rate",
            scale=0.05,
        ),
        Parameter(
            "rate_onset",
            1.0,
            "1/s",
            (1e-3, 1e3),
            "rate over rated voltage, below which the loop no longer changes",
            log=True,
        ),
        Parameter(
            "rate_threshold",
            0.1,
            "1",
            (0.01, 1.0),
            "threshold of the elements over rated voltage",
            log=True,
        ),
        Parameter(
            "rate_by_threshold",
            0.0,
            "1",
            (0.0, 1.0),
            "0: the loop grows, 1: thresholds do",
            fitted=False,
        ),
    ),
    states=(
        State(
            "z_r",
            "V",
            "stop element of the thresholds that grow",
            stop_scale,
            memory=True,
            settles=False,
            whole=voltage_scale,
        ),
    ),
    equations=_rate_dependent_hysteresis,
    probe={"rate_onset": (0.1, 3.0), "rate_by_threshold": (0.0, 1.0)},
    remedy=Remedy("undo_hysteresis", "slew"),
    looks_like="loops grow wider, or narrower, by the same share with every decade of rate",
)
