"""Backlash: the output dwells after every reversal until a gap of fixed width is crossed.

Play is the motion minus a stop: z follows the output mass until |z| = w and then rests. After a
reversal z moves from one end to the other and the output, at gain 1, stands still over 2 w. A guide
with dry friction does the same in the displacement: it holds the output back over a fixed width.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.effects.sizes import stroke
from psa_casadi.scales import stroke_scale
from psa_casadi.smooth import magnitude_power, signed_power, smooth_magnitude
from psa_casadi.variables import Parameter, State, Values

#: Exponent of the smooth stop; 2 bends gently, infinity is the ideal one.
_SHARPNESS = 4.0


def _backlash(s: Symbols) -> Equations:
    """Backlash: the output dwells after every reversal until a gap of fixed width is crossed.

    Play is the motion minus a stop: z follows the output mass until |z| = w and then rests. After a
    reversal z moves from one end to the other and the output, at gain 1, stands still over 2 w. A
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


def _stop_scale(p: Values) -> float:
    return p["backlash_width"] * stroke_scale(p)


BACKLASH = Component(
    name="backlash",
    description="play, or a guide that sticks, between the output mass and what is measured",
    source=(
        "play and stop operators (Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989) in"
        " smooth Bouc-Wen form"
    ),
    gain="backlash_gain",
    equation_text=(
        "x gains -backlash_gain z,  z' = x' - (|x'| sgn(z) + x')/2 (|z|/w)^4,"
        "  w = backlash_width x_s,  x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k"
    ),
    parameters=(
        Parameter("backlash_gain", 0.0, "1", (0.0, 1.5), "1 is true play", scale=0.3),
        Parameter(
            "backlash_width", 0.01, "1", (2e-4, 0.03), "half the gap over the stroke", log=True
        ),
    ),
    states=(
        State(
            "z_b",
            "m",
            "displacement within the gap, 0 in its middle",
            _stop_scale,
            display_unit="um",
            memory=True,
            settles=False,
        ),
    ),
    equations=_backlash,
    probe={"backlash_width": (0.003, 0.01)},
    remedy=Remedy("preload", "reversal"),
    looks_like="a dwell of one fixed width after every reversal, whatever the amplitude",
)
