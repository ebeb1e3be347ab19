"""Hysteresis memory: the error depends on past reversal points; minor loops nest differently."""

import math

import casadi as ca

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.scales import stop_scale
from psa_casadi.smooth import stop_rate
from psa_casadi.variables import Parameter, State

#: Narrowest first threshold, over rated voltage. The memory of a ferroelectric is spread over the
#: loop; a dwell much narrower than the loop is friction or backlash and not this effect.
_NARROWEST = 0.0125
#: Thresholds of the elements over the first one: more than a decade.
_RATIOS = (1.0, 2.5, 6.0, 15.0)


def _weights(s: Symbols) -> list[Expression]:
    """Weights: a smooth curve over the elements, of a form that a fit can turn without a stop.

    The first three cosines over the elements, each of the same sum of squares. The base has an
    element of its own, so that the mean weight may be anything: as an angle it may pass through 0.
    """
    places = [math.pi * (i + 0.5) / len(_RATIOS) for i in range(len(_RATIOS))]
    even, slope = ca.cos(s.memory_angle), math.sqrt(2.0) * ca.sin(s.memory_angle)
    bend = math.sqrt(2.0) * s.memory_bend
    return [even + slope * math.cos(x) + bend * math.cos(2.0 * x) for x in places]


def _equations(s: Symbols) -> Equations:
    elements = [getattr(s, f"z_m{i + 1}") for i in range(len(_RATIOS))]
    first = s.memory_threshold * s.u_rated
    plain, squares = ca.cos(s.memory_asymmetry), ca.sin(s.memory_asymmetry) / s.u_rated
    total = sum(
        weight * z * (plain + squares * (2.0 * s.u - z))
        for weight, z in zip(_weights(s), elements, strict=True)
    )
    return Equations(
        der={
            f"z_m{i + 1}": stop_rate(s, z, ratio * first)
            for i, (z, ratio) in enumerate(zip(elements, _RATIOS, strict=True))
        },
        add={"free_force": s.k_L * s.memory_gain * total},
    )


def _state(index: int) -> State:
    return State(
        f"z_m{index}",
        "V",
        f"stop element {index}, threshold {_RATIOS[index - 1]:g} times the first",
        stop_scale,
        memory=True,
        settles=False,
    )


def _angle(name: str, value: float, text: str) -> Parameter:
    return Parameter(
        f"memory_{name}", value, "rad", (-2.0 * math.pi, 2.0 * math.pi), text, scale=0.3
    )


HYSTERESIS_MEMORY = Component(
    name="hysteresis_memory",
    description="a spectrum of further hysteresis elements, symmetric or not",
    source=(
        "generalised Prandtl-Ishlinskii: plays and their squares (Al Janaideh, Rakheja and Su,"
        " IEEE/ASME Trans. Mechatronics 16 (2011) 734), as stops in smooth Bouc-Wen form"
    ),
    gain="memory_gain",
    equation_text=(
        "f = k_L memory_gain sum_i w_i z_i (cos(asymmetry)"
        " + sin(asymmetry) (2 u - z_i)/u_rated),  "
        "z_i' = u' - (|u'| sgn(z_i) + u')/2 (|z_i|/r_i)^4,  "
        "r_i = threshold u_rated (1, 2.5, 6, 15),  "
        "w_i = cos(angle) + sin(angle) sqrt(2) cos(pi (i - 1/2)/4)"
        " + bend sqrt(2) cos(2 pi (i - 1/2)/4)"
    ),
    parameters=(
        Parameter("memory_gain", 0.0, "1", (-2.0, 2.0), "elements' force over k_L", scale=0.02),
        Parameter(
            "memory_threshold",
            0.03,
            "1",
            (_NARROWEST, 1.0),
            "first threshold over rated voltage",
            log=True,
        ),
        _angle("angle", 0.34, "form of the weights: 0 equal, pi/2 narrow against wide elements"),
        Parameter(
            "memory_bend",
            0.0,
            "1",
            (-20.0, 20.0),
            "weights of the outer elements more than of the inner",
            scale=1.0,
        ),
        _angle("asymmetry", 0.0, "0: plays, as of a symmetric loop; pi/2: their squares alone"),
    ),
    states=tuple(_state(i + 1) for i in range(len(_RATIOS))),
    equations=_equations,
    probe={
        "memory_threshold": (0.03, 0.06),
        "memory_asymmetry": (-0.25 * math.pi, 0.0, 0.25 * math.pi),
    },
    looks_like=(
        "the residual changes with the distance from past reversal points; minor loops do not nest"
    ),
)
