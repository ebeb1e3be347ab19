"""Effects of the material: creep, hysteresis, and how the force per volt changes with the field."""

import casadi as ca

from psa_casadi.model import shapes
from psa_casadi.model.component import Equations, Remedy, Symbols, effect
from psa_casadi.model.shapes import motion, positive, share, smooth_magnitude
from psa_casadi.model.variables import Parameter, Values

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
