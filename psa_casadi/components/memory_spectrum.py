"""The hysteresis as a spectrum of elements: what stands in the place of Bouc-Wen's."""

import math
from collections.abc import Sequence

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.components.wafers import HOLD_RATE
from psa_casadi.scales import stop_scale
from psa_casadi.smooth import play_polynomial, stop_rate
from psa_casadi.variables import Parameter, State

#: Thresholds over the rated voltage: from a hundredth of it to beyond the widest loop, evenly in
#: their logarithms, a factor of two apart.
_THRESHOLDS = tuple(0.0125 * 2.0**i for i in range(8))
#: Cosines over the elements that the weights of plays, of their squares and cubes are made of.
_COUNTS = (5, 3, 3)
#: What the elements add: the powers of their plays.
POWERS = {"play": "the plays", "square": "the plays' squares", "cube": "the plays' cubes"}


def spectrum_force(
    s: Symbols, prefix: str, elements: Sequence[Expression], counts: Sequence[int]
) -> Expression:
    """Return what stop elements add to the voltage [V]: the polynomials of their plays, summed.

    Plays, squares and cubes have weights of their own, each a sum of `counts` cosines over the
    elements.
    """
    places = [math.pi * (i + 0.5) / len(elements) for i in range(len(elements))]

    def weights(name: str, count: int) -> list[Expression]:
        terms = [getattr(s, f"{prefix}{name}_{k}") for k in range(count)]
        return [sum(c * math.cos(k * x) for k, c in enumerate(terms)) for x in places]

    each = [weights(name, count) for name, count in zip(POWERS, counts, strict=True)]
    return sum(play_polynomial(s, z, *own) for z, *own in zip(elements, *each, strict=True))


def spectrum_parameters(prefix: str, counts: Sequence[int], mean: float) -> list[Parameter]:
    """Return the weights of `spectrum_force`; `mean` is that of the plays.

    The k-th cosine has a scale of 1/(k + 1), so that the prior prefers smooth spectra.
    """
    return [
        Parameter(
            f"{prefix}{name}_{k}",
            mean if name == "play" and not k else 0.0,
            "1",
            (-2.0, 2.0),
            f"cosine {k} of the weights of {text}" if k else f"mean weight of {text}",
            scale=0.02 / (k + 1),
        )
        for (name, text), count in zip(POWERS.items(), counts, strict=True)
        for k in range(count)
    ]


def _equations(s: Symbols) -> Equations:
    elements = [getattr(s, f"z_{i + 1}") for i in range(len(_THRESHOLDS))]
    return Equations(
        der={
            f"z_{i + 1}": stop_rate(s, z, threshold * s.u_rated)
            for i, (z, threshold) in enumerate(zip(elements, _THRESHOLDS, strict=True))
        },
        add={"free_force": s.k_L * spectrum_force(s, "", elements, _COUNTS)},
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


MEMORY_SPECTRUM = Component(
    name="memory_spectrum",
    description="hysteresis force as a spectrum of elements, symmetric or not",
    source=(
        "generalised Prandtl-Ishlinskii: plays, their squares and cubes (Al Janaideh, Rakheja and"
        " Su, IEEE/ASME Trans. Mechatronics 16 (2011) 734), as stops in smooth Bouc-Wen form"
    ),
    equation_text=(
        "f_H = k_L sum_i z_i (a_i + b_i (2 u - z_i)/u_rated"
        " + c_i (3 u^2 - 3 u z_i + z_i^2)/u_rated^2),  "
        "z_i' = u' - (|u'| sgn(z_i) + u')/2 (|z_i|/r_i)^4,  r_i = u_rated 2^(i-1)/80,  "
        "a_i = sum_k play_k cos(pi k (i - 1/2)/8),  b_i and c_i of square_k and cube_k likewise"
    ),
    parameters=(
        *spectrum_parameters("", _COUNTS, -0.03),
        HOLD_RATE,
    ),
    states=tuple(_state(i + 1) for i in range(len(_THRESHOLDS))),
    equations=_equations,
)
