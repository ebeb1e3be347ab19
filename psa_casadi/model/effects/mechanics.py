"""Effects of the mechanics: resonances, loads, contacts, and what one mass does to the other."""

from functools import partial

import casadi as ca

from psa_casadi.model.component import (
    SPECTRAL_PEAKS,
    Component,
    Equations,
    Expression,
    Remedy,
    Symbols,
    effect,
)
from psa_casadi.model.shapes import (
    ANGLES,
    BEND_TEXT,
    bend,
    magnitude_power,
    motion,
    positive,
    shape_parameters,
    share,
    signed_power,
    smooth_magnitude,
    static_stiffness,
    stroke,
    stroke_scale,
    velocity_scale,
)
from psa_casadi.model.variables import Parameter, State, Values

_TWO_PI = 6.283185307179586

#: Gains to try, over 0.25: a fit from near 0 does not find a truth near 1, since the static gain
#: k_L (1 + (1 - g) k_P/k_B) / (k_P (1 - g + g^2)) has a ridge between the two.
_STEPS = (0.0, 2.0, 4.0)


@effect(
    share(
        "reciprocal_gain",
        (0.0, 1.2),
        "share of the reaction: 0 the paper's cascade, 1 Newton; more only in error",
        0.25,
    ),
    motion("y_r", "change of y from holding the output at zero, over the gain"),
    State("v_r", "m/s", "its rate", velocity_scale, display_unit="um/s"),
    kind="resonance",
    description="the bonding layers push back on the wafers: two masses with action and reaction",
    source="Newton's third law, whose reaction Yang and Zhu 2015, eqs. 4 and 5, leave out",
    needs=("cascade_mechanics",),
    finite_step=_STEPS,
    equation_text=(
        "m_P y'' + c_P y' + k_P y = f_out + g F,  F = c_B (x' - y') + k_B (x - y);  "
        "m_B x'' + F = (1 - g) (c_P y' + k_P y) + f_load,  g = reciprocal_gain: 0 the paper's"
        " cascade, 1 Newton;  y + g y_r is y with the output held at zero, for the blocked force"
    ),
    remedy=Remedy("extended_model", "resonance"),
    looks_like="the resonances and the zero between them do not fit the one-way cascade",
)
def reciprocal_coupling(s: Symbols) -> Equations:
    """Reciprocal coupling: the wafers feel the bonding layers too, as Newton's third law demands.

    Stable for every gain g from 0 to 1 + m_B/m_P: with q = 1 - g + g^2 the characteristic
    polynomial is m_P m_B s^4 + (m_P c_B + m_B (c_P + g c_B)) s^3 + (m_P k_B + m_B (k_P + g k_B) + q
    c_P c_B) s^2 + q (c_P k_B + k_P c_B) s + q k_P k_B, and Hurwitz' determinant is a sum of
    positive terms.
    """
    g = s.reciprocal_gain
    pull = s.c_B * (s.v_x - s.v_y) + s.k_B * (s.x - s.y)
    held = s.c_B * s.v_x + s.k_B * s.x + (s.c_P + g * s.c_B) * s.v_r + (s.k_P + g * s.k_B) * s.y_r
    blocked = (s.c_B + (1 - g) * s.c_P) * s.v_r + (s.k_B + (1 - g) * s.k_P) * s.y_r
    return Equations(
        der={"y_r": s.v_r, "v_r": -held / s.m_P},
        add={
            "wafer_force": g * pull,
            "transmitted_force": -g * (s.c_P * s.v_y + s.k_P * s.y),
            "blocked_force": g * blocked,
        },
    )


def _rate_scale(frequency: str, p: Values) -> float:
    return stroke_scale(p) * _TWO_PI * p[frequency]


def _mode(q: str, r: str, frequency: str, text: str) -> tuple[State, State]:
    """Return displacement and velocity of a mode whose frequency is the parameter of a name."""
    scale, speed = partial(_rate_scale, frequency), text.format("velocity")
    return (
        motion(q, text.format("displacement")),
        State(r, "m/s", speed, scale, display_unit="um/s"),
    )


@effect(
    Parameter("mode_gain", 0.0, "1", (-2.0, 2.0), "static share of the mode", scale=0.01),
    Parameter("mode_frequency", 1e3, "Hz", (0.1, 1e6), "natural frequency", log=True),
    Parameter("mode_lead", 0.0, "1", (-20.0, 20.0), "tangent of the phase lead", scale=1.0),
    Parameter("mode_damping", 0.02, "1", (1e-4, 0.7), "damping ratio", log=True),
    *_mode("q", "r_q", "mode_frequency", "modal {}"),
    kind="resonance",
    description="a further resonance, of the mount or the guide",
    source="modal superposition, one second-order mode driven by the output mass",
    tone="mode_frequency",
    equation_text=(
        "q'' + 2 zeta w q' + w^2 q = w^2 x_tip,  x gains mode_gain (q + mode_lead q'/w),"
        "  w = 2 pi mode_frequency"
    ),
    probe={"mode_frequency": SPECTRAL_PEAKS, "mode_damping": (0.03,)},
    remedy=Remedy("avoid_resonance", "resonance"),
    looks_like="the residual rings at a tone that is neither pole of the stack",
)
def structural_mode(s: Symbols) -> Equations:
    """Structural mode: a resonance of the mount or the guide that the two-mass model lacks.

    What drives it may run ahead of the output mass or behind it: the lead turns the phase of the
    resonance by its arc tangent, so that it also covers a mode driven by the force ahead of its
    lag.
    """
    omega = _TWO_PI * s.mode_frequency
    return Equations(
        der={
            "q": s.r_q,
            "r_q": omega**2 * (s.tip_displacement - s.q) - 2 * s.mode_damping * omega * s.r_q,
        },
        add={"displacement": s.mode_gain * (s.q + s.mode_lead * s.r_q / omega)},
    )


#: Force over stiffness times stroke at which it levels off.
_MOST = 0.5


@effect(
    share(
        "load_gain",
        (-0.5, 0.5),
        "bow and S of the load's force over the stack's stiffness times the stroke",
        0.002,
    ),
    *shape_parameters("load"),
    kind="curve",
    description="an elastic load or guide whose stiffness changes with displacement",
    source="Duffing's spring; flexures that stretch: Howell 2001; contacts: Johnson 1985",
    equation_text=(
        "f_load gains -k_s x_s F/sqrt(1 + (2 F)^2),  F = load_gain b(x/x_s),"
        "  x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k,  " + BEND_TEXT.format("load")
    ),
    curve="displacement",
    measured_by="load_force",
    probe={"load_angle": ANGLES},
    remedy=Remedy("undo_load_curve", "range"),
    looks_like="the curve bends with displacement, however fast or by what force it got there",
)
def load_stiffness(s: Symbols) -> Equations:
    """Load stiffness: an elastic load or guide whose stiffness changes with displacement.

    A linear load is no separate effect: it stiffens k_B (or k) and, for the same stroke per volt,
    scales k_L, so that by voltage and displacement a stack with a spring is indistinguishable from
    a stiffer one. Only a factor that depends on displacement shows: contacts and disc springs bow
    the curve, flexures that stretch bend it at the end (Duffing's cubic force 20 sin(a) gain q^3 is
    the angle a = atan(1/5)). Below the resonances a load and a bent sensor are the same curve over
    the displacement, so that both have the same forms. A force near half of what the stack can
    exert levels off: a load that softens would run away.
    """
    force = s.load_gain * bend(s.x / stroke(s), s.load_angle, s.load_wave)
    levelled = force / ca.sqrt(1 + (force / _MOST) ** 2)
    return Equations(add={"tip_force": -static_stiffness(s) * stroke(s) * levelled})


#: Width over which contact builds up, over the stroke.
_CONTACT_WIDTH = 5e-3


@effect(
    share("contact_gain", (-0.8, 10.0), "spring's stiffness over the stack's", 0.05),
    share(
        "contact_position",
        (-0.5, 1.5),
        "displacement of first contact, over the stroke",
        0.1,
        0.4,
    ),
    kind="curve",
    description="a spring touches, or a guide changes its stiffness, at one displacement",
    source="unilateral contact (Signorini) with an elastic load: Johnson, Contact Mechanics, 1985",
    equation_text=(
        "f_load gains -contact_gain k_s max(0, x - contact_position x_s), smooth over 0.5 % of"
        " x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k"
    ),
    probe={"contact_position": (0.2, 0.4, 0.65)},
    remedy=Remedy("preload", "range"),
    looks_like="the slope changes abruptly at one displacement, the same on both branches",
)
def preload_loss(s: Symbols) -> Equations:
    """Preload loss: on one side of a certain displacement a spring has lost contact.

    With a positive gain the output meets the spring at x_c and beyond, and below there is a gap.
    With a negative one the spring, which elsewhere stiffens k_B and scales k_L unseen, leaves it
    there: beyond x_c its stiffness is missing, -k max(0, x_c - x) being -k (x_c - x) - k max(0, x -
    x_c). The spring that is lost was part of the stack's stiffness, so that the gain stays above
    -1. A guide that is stiffer on one side of a displacement than on the other bends the curve
    there in the same way.
    """
    full = stroke(s)
    depth = s.x - s.contact_position * full
    pressed = 0.5 * (depth + ca.sqrt(depth**2 + (_CONTACT_WIDTH * full) ** 2))
    return Equations(add={"tip_force": -s.contact_gain * static_stiffness(s) * pressed})


#: Exponent of the smooth stop; 2 bends gently, infinity is the ideal one.
_SHARPNESS = 4.0


def _stop_scale(p: Values) -> float:
    return p["backlash_width"] * stroke_scale(p)


@effect(
    Parameter("backlash_gain", 0.0, "1", (0.0, 1.5), "1 is true play", scale=0.3),
    positive("backlash_width", 0.01, "1", (2e-4, 0.03), "half the gap over the stroke"),
    motion(
        "z_b",
        "displacement within the gap, 0 in its middle",
        _stop_scale,
        memory=True,
        settles=False,
    ),
    kind="hysteresis",
    description="play, or a guide that sticks, between the output mass and what is measured",
    source=(
        "play and stop operators (Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989) in"
        " smooth Bouc-Wen form"
    ),
    equation_text=(
        "x gains -backlash_gain z,  z' = x' - (|x'| sgn(z) + x')/2 (|z|/w)^4,"
        "  w = backlash_width x_s,  x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k"
    ),
    probe={"backlash_width": (0.003, 0.01)},
    remedy=Remedy("preload", "reversal"),
    looks_like="a dwell of one fixed width after every reversal, whatever the amplitude",
)
def backlash(s: Symbols) -> Equations:
    """Backlash: the output dwells after every reversal until a gap of fixed width is crossed.

    Play is the motion minus a stop: z follows the output mass until |z| = w and then rests. After a
    reversal z moves from one end to the other and the output, at gain 1, rests over 2 w. A
    guide with dry friction does the same in the displacement: it holds the output back over a fixed
    width.
    """
    full = stroke(s)
    ratio = s.z_b / (s.backlash_width * full)
    speed = smooth_magnitude(s.v_x, s.hold_rate * full / s.u_rated)
    stop = 0.5 * (
        speed * signed_power(ratio, _SHARPNESS) + s.v_x * magnitude_power(ratio, _SHARPNESS)
    )
    return Equations(
        der={"z_b": s.v_x - stop},
        add={"displacement": -s.backlash_gain * s.z_b},
    )


#: Numbers of modes for which there is a component.
FEWEST, MOST = 2, 9


def _modal_series(count: int, s: Symbols) -> Equations:
    """Modal series: several resonances of the mount, the guide or the load that the stack moves.

    Every mode is driven by the force of the wafers and adds its share to the displacement. A
    residue that is not in phase with the force, of damping that is not proportional, has a part
    ahead of it. There is a component for every number of modes.
    """
    der, total, rest = {}, 0.0, s.wafer_force * _compliance(s)
    for k in range(1, count + 1):
        q, rate = getattr(s, f"q_s{k}"), getattr(s, f"r_s{k}")
        omega = _TWO_PI * getattr(s, f"series_frequency_{k}")
        damping = 2.0 * getattr(s, f"series_damping_{k}") * omega
        der[f"q_s{k}"] = rate
        der[f"r_s{k}"] = omega**2 * (rest - q) - damping * rate
        ahead = getattr(s, f"series_ahead_{k}") * rate / omega
        total = total + getattr(s, f"series_share_{k}") * q + ahead
    return Equations(der=der, add={"displacement": s.series_gain * total})


def _compliance(s: Symbols) -> Expression:
    """Return what a force of the wafers moves the output at rest by [m/N]."""
    try:
        return 1.0 / s.k_P + 1.0 / s.k_B
    except AttributeError:  # the single mass
        return 1.0 / s.k


def _parameters(k: int) -> tuple[Parameter, ...]:
    return (
        share(f"series_share_{k}", (-1e3, 1e3), f"static share of mode {k}", 0.01, 0.01),
        share(f"series_ahead_{k}", (-1e3, 1e3), f"share of mode {k} a quarter period ahead", 0.01),
        positive(f"series_frequency_{k}", 1e3, "Hz", (1e-4, 1e6), f"natural frequency of mode {k}"),
        positive(f"series_damping_{k}", 0.02, "1", (1e-4, 0.7), f"damping ratio of mode {k}"),
    )


def modal_series(count: int) -> Component:
    """Return the component of `count` modes; `series_gain` is 1 with them and 0 without."""
    numbers = range(1, count + 1)
    gain = Parameter("series_gain", 0.0, "1", (0.0, 2.0), "1 with the modes", fitted=False)
    return Component(
        name=f"modal_series_{count}",
        kind="resonance",
        description=f"{count} further resonances, of the mount, the guide or the load",
        source="modal superposition; Ewins, Modal Testing, 2nd ed. 2000, ch. 2",
        gain=gain.name,
        equation_text=(
            "q_k'' + 2 zeta_k w_k q_k' + w_k^2 q_k = w_k^2 x_rest,"
            "  x gains sum_k (share_k q_k + ahead_k q_k'/w_k),  w_k = 2 pi frequency_k,"
            "  x_rest: displacement that the wafers' force has at rest"
        ),
        parameters=(gain, *(p for k in numbers for p in _parameters(k))),
        states=tuple(
            s
            for k in numbers
            for s in _mode(f"q_s{k}", f"r_s{k}", f"series_frequency_{k}", f"{{}} of mode {k}")
        ),
        equations=partial(_modal_series, count),
        remedy=Remedy("avoid_resonance", "resonance"),
        looks_like="the residual rings at several tones that are no poles of the stack",
        more_of=structural_mode.name,
        count=count,
    )


MODAL_SERIES: dict[int, Component] = {n: modal_series(n) for n in range(FEWEST, MOST + 1)}
