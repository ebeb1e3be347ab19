"""Sensor jump: the reading jumps where the displacement passes one place, on both branches.

It is narrow: a wide one would be a bent sensor. A reading that stays off after a jump, as of an
interferometer that has lost a count, is not this.
"""

import casadi as ca

from psa_casadi.component import (
    DISPLACEMENT_STEPS,
    Component,
    Equations,
    Expression,
    Remedy,
    Symbols,
)
from psa_casadi.effects.sizes import stroke
from psa_casadi.scales import reading_scale, stroke_scale
from psa_casadi.variables import Parameter, Values


def _sensor_jump(s: Symbols) -> Equations:
    """Sensor jump: the reading jumps where the displacement passes one place, on both branches.

    It is narrow: a wide one would be a bent sensor. A reading that stays off after a jump, as of an
    interferometer that has lost a count, is not this.
    """
    width = s.jump_width * stroke(s)

    def side(x: Expression) -> Expression:
        return ca.tanh((x - s.jump_place) / width)

    jump = 0.5 * s.jump_gain * (side(s.displacement) - side(ca.SX(0)))
    return Equations(add={"measured_displacement": jump})


def _place_scale(p: Values) -> float:
    return 1e-2 * stroke_scale(p)


SENSOR_JUMP = Component(
    name="sensor_jump",
    description="the reading jumps where the displacement passes one place",
    source=(
        "wide or missing code of a converter (IEEE Std 1241), stitching error of a scale: a static"
        " step of the reading"
    ),
    belongs_to="sensor",
    gain="jump_gain",
    equation_text=(
        "x_m = x + jump_gain/2 (tanh((x - jump_place)/w) + tanh(jump_place/w)),"
        "  w = jump_width x_s,  x_s = k_L u_rated / k_s,  k_s = k_P k_B/(k_P + k_B) or k"
    ),
    parameters=(
        Parameter(
            "jump_gain", 0.0, "m", (-1e-3, 1e-3), "size of the jump", "um", scale=reading_scale
        ),
        Parameter(
            "jump_place", 5e-6, "m", (-1e-2, 1e-2), "displacement of it", "um", scale=_place_scale
        ),
        Parameter(
            "jump_width",
            0.01,
            "1",
            (1e-6, 0.05),
            "half its rise over the stroke",
            log=True,
            limit=True,
        ),
    ),
    equations=_sensor_jump,
    probe={"jump_place": DISPLACEMENT_STEPS, "jump_width": (0.003, 0.03)},
    remedy=Remedy("calibrate_sensor", "range"),
    looks_like="the residual jumps at one displacement, the same on both branches",
)
