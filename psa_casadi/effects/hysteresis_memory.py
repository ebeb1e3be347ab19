"""Hysteresis memory: the error depends on past reversals; minor loops nest differently."""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.plays import spectrum_force, spectrum_parameters
from psa_casadi.scales import stop_scale, voltage_scale
from psa_casadi.smooth import stop_rate
from psa_casadi.variables import Parameter, State

#: Narrowest first threshold, over rated voltage. The memory of a ferroelectric is spread over the
#: loop; a dwell much narrower than the loop is friction or backlash and not this effect.
_NARROWEST = 0.0125
#: Thresholds of the elements over the first one: more than a decade.
_RATIOS = (1.0, 2.5, 6.0, 15.0)
#: Cosines over the elements that the weights of plays, of their squares and cubes are made of.
_COUNTS = (3, 3, 3)
#: Mean weight at which it is looked for; an ordinary one is larger in narrow elements.
_ORDINARY = 0.02

_WEIGHTS = tuple(spectrum_parameters("memory_", _COUNTS, (_ORDINARY, 0.5 * _ORDINARY)))


def _hysteresis_memory(s: Symbols) -> Equations:
    """Hysteresis memory: the error depends on past reversals; minor loops nest differently."""
    elements = [getattr(s, f"z_m{i + 1}") for i in range(len(_RATIOS))]
    first = s.memory_threshold * s.u_rated
    total = spectrum_force(s, "memory_", elements, _COUNTS)
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
        whole=voltage_scale,
    )


HYSTERESIS_MEMORY = Component(
    name="hysteresis_memory",
    description="a spectrum of further hysteresis elements, symmetric or not",
    source=(
        "generalised Prandtl-Ishlinskii: plays, their squares and cubes (Al Janaideh, Rakheja and"
        " Su, IEEE/ASME Trans. Mechatronics 16 (2011) 734; a Preisach density of second order in"
        " the mean of its two thresholds), as stops in smooth Bouc-Wen form"
    ),
    gain="memory_gain",
    linear=tuple(p.name for p in _WEIGHTS),
    equation_text=(
        "f = k_L memory_gain sum_i z_i (a_i + b_i (2 u - z_i)/u_rated"
        " + c_i (3 u^2 - 3 u z_i + z_i^2)/u_rated^2),  "
        "z_i' = u' - (|u'| sgn(z_i) + u')/2 (|z_i|/r_i)^4,  "
        "r_i = threshold u_rated (1, 2.5, 6, 15),  "
        "a_i = sum_k play_k cos(pi k (i - 1/2)/4),  b_i and c_i of square_k and cube_k likewise"
    ),
    parameters=(
        Parameter(
            "memory_gain", 0.0, "1", (-100.0, 100.0), "1 with the elements", scale=1.0, fitted=False
        ),
        Parameter(
            "memory_threshold",
            0.03,
            "1",
            (_NARROWEST, 1.0),
            "first threshold over rated voltage",
            log=True,
        ),
        *_WEIGHTS,
    ),
    states=tuple(_state(i + 1) for i in range(len(_RATIOS))),
    equations=_hysteresis_memory,
    probe={"memory_threshold": (0.015, 0.12)},
    remedy=Remedy("undo_hysteresis", "reversal"),
    looks_like=(
        "the residual changes with the distance from past reversal points; minor loops do not nest"
    ),
)
