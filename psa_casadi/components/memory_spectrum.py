"""The hysteresis as a spectrum of elements: what stands in the place of Bouc-Wen's."""

import math

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.components.wafers import HOLD_RATE
from psa_casadi.scales import stop_scale
from psa_casadi.smooth import stop_rate
from psa_casadi.variables import Parameter, State

#: Thresholds over the rated voltage: from a hundredth of it to beyond the widest loop, evenly in
#: their logarithms, a factor of two apart.
_THRESHOLDS = tuple(0.0125 * 2.0**i for i in range(8))
#: Cosines over the elements that the weights of plays and of their squares are made of; the k-th
#: has a scale of 1/(k + 1), so that the prior prefers smooth spectra.
_PLAYS, _SQUARES = 5, 3


def _weights(s: Symbols, name: str, count: int) -> list[Expression]:
    places = [math.pi * (i + 0.5) / len(_THRESHOLDS) for i in range(len(_THRESHOLDS))]
    terms = [getattr(s, f"{name}_{k}") for k in range(count)]
    return [sum(c * math.cos(k * x) for k, c in enumerate(terms)) for x in places]


def _equations(s: Symbols) -> Equations:
    elements = [getattr(s, f"z_{i + 1}") for i in range(len(_THRESHOLDS))]
    plays, squares = _weights(s, "play", _PLAYS), _weights(s, "square", _SQUARES)
    total = sum(
        z * (play + square * (2.0 * s.u - z) / s.u_rated)
        for play, square, z in zip(plays, squares, elements, strict=True)
    )
    return Equations(
        der={
            f"z_{i + 1}": stop_rate(s, z, threshold * s.u_rated)
            for i, (z, threshold) in enumerate(zip(elements, _THRESHOLDS, strict=True))
        },
        add={"free_force": s.k_L * total},
        switches={"voltage_reversal": s.voltage_rate},
    )


def _state(index: int) -> State:
    return State(
        f"z_{index}",
        "V",
        f"stop element {index}, threshold {_THRESHOLDS[index - 1]:g} of the rated voltage",
        stop_scale,
        memory=True,
        settles=False,
    )


def _cosines(name: str, count: int, text: str, mean: float) -> list[Parameter]:
    return [
        Parameter(
            f"{name}_{k}",
            0.0 if k else mean,
            "1",
            (-2.0, 2.0),
            f"cosine {k} of the weights of {text}" if k else f"mean weight of {text}",
            scale=0.02 / (k + 1),
        )
        for k in range(count)
    ]


MEMORY_SPECTRUM = Component(
    name="memory_spectrum",
    description="hysteresis force as a spectrum of elements, symmetric or not",
    source=(
        "generalised Prandtl-Ishlinskii: plays and their squares (Al Janaideh, Rakheja and Su,"
        " IEEE/ASME Trans. Mechatronics 16 (2011) 734), as stops in smooth Bouc-Wen form"
    ),
    equation_text=(
        "f_H = k_L sum_i z_i (a_i + b_i (2 u - z_i)/u_rated),  "
        "z_i' = u' - (|u'| sgn(z_i) + u')/2 (|z_i|/r_i)^4,  r_i = u_rated 2^(i-1)/80,  "
        "a_i = sum_k play_k cos(pi k (i - 1/2)/8),  b_i = sum_k square_k cos(pi k (i - 1/2)/8)"
    ),
    parameters=(
        *_cosines("play", _PLAYS, "the plays", -0.03),
        *_cosines("square", _SQUARES, "the plays' squares", 0.0),
        HOLD_RATE,
    ),
    states=tuple(_state(i + 1) for i in range(len(_THRESHOLDS))),
    equations=_equations,
)
