"""Structural mode: a resonance of the mount or the guide that the two-mass model lacks.

What drives it may run ahead of the output mass or behind it: the lead turns the phase of the
resonance by its arc tangent, so that a mode driven by the force ahead of its lag is told as well.
"""

from psa_casadi.component import SPECTRAL_PEAKS, Component, Equations, Remedy, Symbols
from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Parameter, State, Values

_TWO_PI = 6.283185307179586


def _structural_mode(s: Symbols) -> Equations:
    """Structural mode: a resonance of the mount or the guide that the two-mass model lacks.

    What drives it may run ahead of the output mass or behind it: the lead turns the phase of the
    resonance by its arc tangent, so that a mode driven by the force ahead of its lag is told as
    well.
    """
    omega = _TWO_PI * s.mode_frequency
    return Equations(
        der={
            "q": s.r_q,
            "r_q": omega**2 * (s.tip_displacement - s.q) - 2 * s.mode_damping * omega * s.r_q,
        },
        add={"displacement": s.mode_gain * (s.q + s.mode_lead * s.r_q / omega)},
    )


def _rate_scale(p: Values) -> float:
    return stroke_scale(p) * _TWO_PI * p["mode_frequency"]


STRUCTURAL_MODE = Component(
    name="structural_mode",
    description="a further resonance, of the mount or the guide",
    source="modal superposition, one second-order mode driven by the output mass",
    gain="mode_gain",
    tone="mode_frequency",
    equation_text=(
        "q'' + 2 zeta w q' + w^2 q = w^2 x_tip,  x gains mode_gain (q + mode_lead q'/w),"
        "  w = 2 pi mode_frequency"
    ),
    parameters=(
        Parameter("mode_gain", 0.0, "1", (-2.0, 2.0), "static share of the mode", scale=0.01),
        Parameter("mode_frequency", 1e3, "Hz", (0.1, 1e6), "natural frequency", log=True),
        Parameter("mode_lead", 0.0, "1", (-20.0, 20.0), "tangent of the phase lead", scale=1.0),
        Parameter("mode_damping", 0.02, "1", (1e-4, 0.7), "damping ratio", log=True),
    ),
    states=(
        State("q", "m", "modal displacement", stroke_scale, display_unit="um"),
        State("r_q", "m/s", "modal velocity", _rate_scale, display_unit="um/s"),
    ),
    equations=_structural_mode,
    probe={"mode_frequency": SPECTRAL_PEAKS, "mode_damping": (0.03,)},
    remedy=Remedy("avoid_resonance", "resonance"),
    looks_like="the residual rings at a tone that is neither pole of the stack",
)
