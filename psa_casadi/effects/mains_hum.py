"""Mains hum: a line at one frequency in the reading, whatever the drive does.

The hum is an undamped oscillator w1' = w w2, w2' = -w w1 whose amplitude and phase are each
record's own. It is written in the frame that turns with it: w1 = a cos(w t) + b sin(w t) with
a' = b' = 0, the exact solution. So it costs no steps, keeps its amplitude for any number of
periods, and a line above the sampling rate shows up at its alias. a and b are memories that rest at
any value; at the start (0, 0) there is no hum. The gain has either sign, so that one start serves
both phases.
"""

import casadi as ca

from psa_casadi.component import SPECTRAL_PEAKS, Component, Equations, Remedy, Symbols
from psa_casadi.scales import reading_scale
from psa_casadi.variables import Parameter, State

_TWO_PI = 6.283185307179586


def _mains_hum(s: Symbols) -> Equations:
    """Mains hum: a line at one frequency in the reading, whatever the drive does.

    The hum is an undamped oscillator w1' = w w2, w2' = -w w1 whose amplitude and phase are each
    record's own. It is written in the frame that turns with it: w1 = a cos(w t) + b sin(w t) with
    a' = b' = 0, the exact solution. So it costs no steps, keeps its amplitude for any number of
    periods, and a line above the sampling rate shows up at its alias. a and b are memories that
    rest at any value; at the start (0, 0) there is no hum. The gain has either sign, so that one
    start serves both phases.
    """
    angle = _TWO_PI * s.hum_frequency * s.time
    hum = s.hum_cosine * ca.cos(angle) + s.hum_sine * ca.sin(angle)
    return Equations(
        der={"hum_cosine": 0.0, "hum_sine": 0.0},
        add={"measured_displacement": s.hum_gain * hum},
    )


def _part(name: str) -> State:
    return State(
        f"hum_{name}", "1", f"{name} part of the hum over its gain", 1.0, memory=True, settles=False
    )


MAINS_HUM = Component(
    name="mains_hum",
    description="a line at one frequency in the reading, whatever the drive does",
    source="pick-up of 50 or 60 Hz mains: Morrison, Grounding and Shielding Techniques (Wiley)",
    belongs_to="environment",
    gain="hum_gain",
    tone="hum_frequency",
    equation_text=(
        "x_m gains hum_gain (a cos(w t) + b sin(w t)),  w = 2 pi hum_frequency,"
        "  a' = b' = 0 with a start of each record's own"
    ),
    parameters=(
        Parameter(
            "hum_gain", 0.0, "m", (-1e-3, 1e-3), "size of the hum", "um", scale=reading_scale
        ),
        Parameter("hum_frequency", 50.0, "Hz", (0.05, 1e5), "frequency of the line", log=True),
    ),
    states=(_part("cosine"), _part("sine")),
    equations=_mains_hum,
    probe={"hum_frequency": SPECTRAL_PEAKS},
    remedy=Remedy("shield", "record"),
    looks_like="a narrow line in the residual's spectrum, as strong when the voltage rests",
    trial_starts=({"hum_cosine": 1.0}, {"hum_sine": 1.0}),
)
