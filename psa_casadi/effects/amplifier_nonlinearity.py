"""Amplifier nonlinearity: the amplifier's gain changes with its output.

A stack whose strain per volt changes with the voltage bends the displacement in the same way, but
for the hysteresis, which an amplifier bends as well. A monitor of the output voltage tells them
apart: the effect is looked for where there is one.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.effects.bend import ANGLES, BEND_TEXT, bend, shape_parameters
from psa_casadi.variables import Parameter


def _amplifier_nonlinearity(s: Symbols) -> Equations:
    """Amplifier nonlinearity: the amplifier's gain changes with its output.

    A stack whose strain per volt changes with the voltage bends the displacement in the same way,
    but for the hysteresis, which an amplifier bends as well. A monitor of the output voltage tells
    them apart: the effect is looked for where there is one.
    """
    share = s.G * s.voltage / s.u_rated
    bent = s.amplifier_gain * s.u_rated * bend(share, s.amplifier_angle, s.amplifier_wave)
    return Equations(add={"drive_voltage": bent})


AMPLIFIER_NONLINEARITY = Component(
    name="amplifier_nonlinearity",
    description="the amplifier's gain changes with its output voltage",
    source="output-dependent gain of amplifiers: Horowitz and Hill, The Art of Electronics",
    belongs_to="drive",
    gain="amplifier_gain",
    equation_text=(
        "drive voltage gains amplifier_gain u_rated b(G v/u_rated),  "
        + BEND_TEXT.format("amplifier")
    ),
    parameters=(
        Parameter(
            "amplifier_gain",
            0.0,
            "1",
            (-0.2, 0.2),
            "bow and S of the amplifier's curve over the rated voltage",
            scale=0.002,
        ),
        *shape_parameters("amplifier"),
    ),
    equations=_amplifier_nonlinearity,
    needs_column=("monitor_voltage",),
    probe={"amplifier_angle": ANGLES},
    remedy=Remedy("measure_voltage", "range"),
    looks_like="the voltage at the stack is a bent curve over the command, on both branches alike",
)
