"""Effects of the hysteresis: memory, rate and asymmetry beyond the paper's loop."""

import casadi as ca

from psa_casadi.model import shapes
from psa_casadi.model.component import Equations, Remedy, Symbols, effect
from psa_casadi.model.variables import Parameter, Values

#: Force over voltage of the play elements, over k_L: loops of some 10 % of the stroke.
_SHARE = 0.3
#: How steeply the force sets in where the stop element comes to its end.
_ONSET = 6.0


@effect(
    shapes.share(
        "rate_gain", (-0.5, 0.5), "growth of the loop's width per decade of voltage rate", 0.05
    ),
    shapes.positive(
        "rate_onset",
        1.0,
        "1/s",
        (1e-3, 1e3),
        "rate over rated voltage, below which the loop no longer changes",
    ),
    shapes.positive(
        "rate_threshold", 0.1, "1", (0.01, 1.0), "threshold of the elements over rated voltage"
    ),
    shapes.form("rate_by_threshold", "0: the loop grows, 1: thresholds do"),
    shapes.stop_state("z_r", "stop element of the thresholds that grow"),
    kind="hysteresis",
    description="loop width and stroke change with the logarithm of the voltage rate",
    source=(
        "Damjanovic, Phys. Rev. B 55 (1997) R649: logarithm of frequency; elements that grow with"
        " the rate: Ang, Khosla and Riviere, IEEE/ASME Trans. Mechatronics 12 (2007) 134;"
        " thresholds that do: Al Janaideh, Su and Rakheja, Smart Mater. Struct. 17 (2008) 035026"
    ),
    needs=("bouc_wen",),
    equation_text=(
        "force gains (c - 1) f_H,  c = (1 + (u'/(rate_onset u_rated))^2)^(rate_gain/(2 ln 10)),  or"
        " where rate_by_threshold = 1  -(c - 1) 0.3 k_L w |z/w|^6 (sgn(u') + z/w)/2,"
        "  z' = u' - (|u'| sgn(z) + u')/2 (|z|/w)^4,  w = rate_threshold u_rated"
    ),
    probe={"rate_onset": (0.1, 3.0), "rate_by_threshold": (0.0, 1.0)},
    remedy=Remedy("undo_hysteresis", "slew"),
    looks_like="loops grow wider, or narrower, by the same share with every decade of rate",
)
def rate_dependent_hysteresis(s: Symbols) -> Equations:
    """Rate-dependent hysteresis: the loop's width changes with the logarithm of the voltage rate.

    Two forms, of which one is tried after the other, with c - 1 = exp(rate_gain L) - 1 and L = lg
    sqrt(1 + (u'/(rate_onset u_rated))^2), the decades above the onset:

    * the hysteresis force acts c-fold, at every amplitude;
    * play elements' thresholds w grow c-fold (Al Janaideh): nothing is added after a reversal,
      and (c - 1) w behind the motion once the element moves, whatever the amplitude.

    A positive gain widens loops and lowers the stroke as the rate rises. The rate acts at once and
    leaves the memory as it is.
    """
    relative = s.voltage_rate / (s.rate_onset * s.u_rated)
    grown = ca.exp(s.rate_gain * 0.5 * ca.log10(1 + relative**2)) - 1
    width = s.rate_threshold * s.u_rated
    at_end = shapes.magnitude_power(s.z_r / width, _ONSET)
    same_way = 0.5 * (shapes.direction(s) + shapes.signed_power(s.z_r / width, 1.0))
    behind = -_SHARE * s.k_L * width * at_end * same_way
    force = s.f_H + s.rate_by_threshold * (behind - s.f_H)
    return Equations(
        der={"z_r": shapes.stop_rate(s, s.z_r, width)},
        add={"free_force": grown * force},
    )


#: Narrowest first threshold, over rated voltage. The memory of a ferroelectric is spread over the
#: loop; a dwell much narrower than the loop is friction or backlash and not this effect.
_NARROWEST = 0.0125
#: Thresholds of the elements over the first one: more than a decade.
_RATIOS = (1.0, 2.5, 6.0, 15.0)
#: Cosines over the elements that the weights of plays, of their squares and cubes are made of.
_COUNTS = (3, 3, 3)
#: Mean weight at which it is looked for; an ordinary one is larger in narrow elements.
_ORDINARY = 0.02

_WEIGHTS = tuple(shapes.spectrum_parameters("memory_", _COUNTS, (_ORDINARY, 0.5 * _ORDINARY)))


@effect(
    Parameter(
        "memory_gain", 0.0, "1", (-100.0, 100.0), "1 with the elements", scale=1.0, fitted=False
    ),
    shapes.positive(
        "memory_threshold", 0.03, "1", (_NARROWEST, 1.0), "first threshold over rated voltage"
    ),
    *_WEIGHTS,
    *shapes.stop_states("z_m", [f"{ratio:g} times the first" for ratio in _RATIOS]),
    kind="hysteresis",
    description="a spectrum of further hysteresis elements, symmetric or not",
    source=(
        "generalised Prandtl-Ishlinskii: plays, their squares and cubes (Al Janaideh, Rakheja and"
        " Su, IEEE/ASME Trans. Mechatronics 16 (2011) 734; a Preisach density of second order in"
        " the mean of its two thresholds), as stops in smooth Bouc-Wen form"
    ),
    linear=tuple(p.name for p in _WEIGHTS),
    equation_text=(
        "f = k_L memory_gain sum_i z_i (a_i + b_i (2 u - z_i)/u_rated"
        " + c_i (3 u^2 - 3 u z_i + z_i^2)/u_rated^2),  "
        "z_i' = u' - (|u'| sgn(z_i) + u')/2 (|z_i|/r_i)^4,  "
        "r_i = threshold u_rated (1, 2.5, 6, 15),  "
        "a_i = sum_k play_k cos(pi k (i - 1/2)/4),  b_i and c_i of square_k and cube_k likewise"
    ),
    probe={"memory_threshold": (0.015, 0.12)},
    remedy=Remedy("undo_hysteresis", "reversal"),
    looks_like=(
        "the residual changes with the distance from past reversal points; minor loops do not nest"
    ),
)
def hysteresis_memory(s: Symbols) -> Equations:
    """Hysteresis memory: the error depends on past reversals; minor loops nest differently."""
    first = s.memory_threshold * s.u_rated
    elements, rates = shapes.stop_rates(s, "z_m", [ratio * first for ratio in _RATIOS])
    total = shapes.spectrum_force(s, "memory_", elements, _COUNTS)
    return Equations(der=rates, add={"free_force": s.k_L * s.memory_gain * total})


def _asymmetry_scale(p: Values) -> float:
    return 0.05 * abs(p["k_L"]) / abs(p["u_rated"])


@effect(
    Parameter(
        "delta_r",
        0.0,
        "N/V2",
        (-1e5, 1e5),
        "rate-independent asymmetry",
        scale=_asymmetry_scale,
    ),
    shapes.share("asymmetry_bend", (-100.0, 100.0), "share that follows the hysteresis force", 1.0),
    kind="hysteresis",
    description="ascending and descending branch curve differently at every frequency",
    source=(
        "the paper's asymmetry (eq. 8, delta) made rate-independent, u sgn(u') -> u |u'|, with the"
        " even term of generalised Bouc-Wen models (Song and Der Kiureghian, J. Eng. Mech. 2006)"
    ),
    needs=("bouc_wen",),
    equation_text="f_H' gains delta_r |u'| (u + asymmetry_bend u_rated (|f_H|/h_ref)^n)",
    probe={"asymmetry_bend": (-2.0, 0.0, 2.0)},
    remedy=Remedy("undo_hysteresis", "reversal"),
    looks_like=(
        "the residual differs between rising and falling voltage in the same way at every rate"
    ),
)
def rate_independent_asymmetry(s: Symbols) -> Equations:
    """Rate-independent asymmetry: the branches curve differently, equally at every frequency."""
    bend = s.asymmetry_bend * s.u_rated * shapes.magnitude_power(s.f_H / s.h_ref, s.n)
    return Equations(add={"hysteresis_rate": s.delta_r * (s.u + bend) * shapes.rate_magnitude(s)})
