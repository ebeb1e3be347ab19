"""The hysteresis as a spectrum of elements: what stands in the place of Bouc-Wen's."""

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.components.wafers import HOLD_RATE
from psa_casadi.plays import spectrum_force, spectrum_parameters
from psa_casadi.scales import stop_scale, voltage_scale
from psa_casadi.smooth import stop_rate
from psa_casadi.variables import State

#: Thresholds over the rated voltage: from a hundredth of it to beyond the widest loop, evenly in
#: their logarithms, a factor of two apart.
_THRESHOLDS = tuple(0.0125 * 2.0**i for i in range(8))
#: Cosines over the elements that the weights of plays, of their squares and cubes are made of.
_COUNTS = (5, 3, 3)


def _memory_spectrum(s: Symbols) -> Equations:
    """The hysteresis as a spectrum of elements: what stands in the place of Bouc-Wen's."""
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
        whole=voltage_scale,
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
        *spectrum_parameters("", _COUNTS, (-0.03,)),
        HOLD_RATE,
    ),
    states=tuple(_state(i + 1) for i in range(len(_THRESHOLDS))),
    equations=_memory_spectrum,
)
