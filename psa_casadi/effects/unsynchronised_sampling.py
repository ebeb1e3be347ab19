"""Unsynchronised sampling: the reading is renewed by a clock of its own, so its age saws with time.

A sensor that renews its value every T seconds, read by another clock, gives at each sample the
value that it had up to T ago. Where the two clocks differ by a few parts in 10^5, this age grows or
falls by T during one beat of the two, and jumps back. Phase and rate of the beat are each record's
own: clocks start anew and warm up.

The age counts on the displacement, as the terms of other sensor effects do. Beside a bent sensor,
whose slope is in no reading but its own, what saws is the age over that slope.
"""

from math import exp, pi

import casadi as ca

from psa_casadi.component import DELAY_BEATS, Component, Equations, Symbols
from psa_casadi.scales import stroke_scale
from psa_casadi.variables import Parameter, State

#: Added to the time constant [s]; keeps the filter defined at zero age.
_FLOOR = 1e-6
#: The jump is smooth over 0.2 % of a beat on either side, so that a fit sees where it is.
_SHARP = exp(-2 * pi * 0.002)


def _equations(s: Symbols) -> Equations:
    oldest = s.sampling_age + _FLOOR
    turn = 2 * pi * s.beat_phase
    saw = ca.atan(_SHARP * ca.sin(turn) / (1 - _SHARP * ca.cos(turn)))
    moved = s.displacement - s.aged_displacement
    return Equations(
        der={"aged_displacement": moved / oldest, "beat_phase": s.beat_rate, "beat_rate": 0.0},
        add={"measured_displacement": -s.sampling_age / oldest * (0.5 - saw / pi) * moved},
    )


def _of_record(name: str, unit: str, description: str, nominal: float) -> State:
    return State(name, unit, description, nominal, memory=True, settles=False)


UNSYNCHRONISED_SAMPLING = Component(
    name="unsynchronised_sampling",
    description="the reading is up to one period of the sensor's own clock old, in a sawtooth",
    source="the beat of two free-running clocks: a held value of period T read at another period",
    belongs_to="sensor",
    gain="sampling_age",
    equation_text=(
        "x_m = x - frac(p) (x - z),  sampling_age z' = x - z,  p' = beat_rate,  beat_rate' = 0 with"
        " starts of each record's own: x_m(t) = x(t - sampling_age frac(p)) to first order"
    ),
    parameters=(
        Parameter(
            "sampling_age", 0.0, "s", (0.0, 0.1), "period of the sensor's clock", "ms", scale=1e-4
        ),
    ),
    states=(
        State(
            "aged_displacement",
            "m",
            "displacement behind a lag of the oldest age",
            stroke_scale,
            display_unit="um",
        ),
        _of_record("beat_phase", "1", "phase of the clocks' beat, in beats", 1.0),
        _of_record("beat_rate", "Hz", "beats in a second, below 0 where the age falls", 0.1),
    ),
    equations=_equations,
    looks_like="the residual follows the displacement's rate by an amount that saws with time",
    starts_from=DELAY_BEATS,
    trial_starts=({"beat_phase": 0.25, "beat_rate": 0.6},),
)
