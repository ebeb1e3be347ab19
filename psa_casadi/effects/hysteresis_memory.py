"""Hysteresis memory: the error depends on past reversal points; minor loops nest differently."""

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.scales import voltage_scale
from psa_casadi.smooth import magnitude_power, rate_magnitude, signed_power
from psa_casadi.variables import Parameter, State, Values

#: Exponent of the smooth stop; 2 bends gently, infinity is the ideal stop operator.
_SHARPNESS = 4.0
#: Narrowest first threshold, over rated voltage. The memory of a ferroelectric is spread over the
#: loop; a dwell much narrower than the loop is friction or backlash and not this effect.
_NARROWEST = 0.025
#: Thresholds of the elements over the first one.
_RATIOS = (1.0, 2.0, 4.0)


def stop_rate(s: Symbols, z: Expression, threshold: Expression) -> Expression:
    """Rate of a smooth stop element: z' = u' - (|u'| sgn(z) + u') / 2 * |z / threshold|^m."""
    ratio = z / threshold
    return s.voltage_rate - 0.5 * (
        rate_magnitude(s) * signed_power(ratio, _SHARPNESS)
        + s.voltage_rate * magnitude_power(ratio, _SHARPNESS)
    )


def _equations(s: Symbols) -> Equations:
    elements = {"z_m1": s.z_m1, "z_m2": s.z_m2, "z_m3": s.z_m3}
    first = s.memory_threshold * s.u_rated
    weighted = s.z_m1 + s.memory_weight_2 * s.z_m2 + s.memory_weight_3 * s.z_m3
    return Equations(
        der={
            name: stop_rate(s, z, ratio * first)
            for (name, z), ratio in zip(elements.items(), _RATIOS, strict=True)
        },
        add={"free_force": s.k_L * s.memory_gain * weighted},
    )


def _state(index: int) -> State:
    return State(
        f"z_m{index}",
        "V",
        f"stop element {index}, threshold {_RATIOS[index - 1]:g} times the first",
        _stop_scale,
        memory=True,
        settles=False,
    )


def _stop_scale(p: Values) -> float:
    return 0.1 * voltage_scale(p)


def _weight(index: int, value: float) -> Parameter:
    return Parameter(
        f"memory_weight_{index}",
        value,
        "1",
        (-100.0, 100.0),
        f"weight of element {index} over that of the first",
        scale=1.0,
    )


HYSTERESIS_MEMORY = Component(
    name="hysteresis_memory",
    description="further hysteresis elements with thresholds of their own",
    source="stop operators in parallel (Prandtl-Ishlinskii, Visintin 1994) in smooth Bouc-Wen form",
    gain="memory_gain",
    equation_text=(
        "f = k_L memory_gain (z_1 + weight_2 z_2 + weight_3 z_3),  "
        "z_i' = u' - (|u'| sgn(z_i) + u')/2 (|z_i|/w_i)^4,  "
        "w_1 = threshold u_rated,  w_2 = 2 w_1,  w_3 = 4 w_1"
    ),
    parameters=(
        Parameter(
            "memory_gain", 0.0, "1", (-2.0, 2.0), "first element's force over k_L", scale=0.02
        ),
        Parameter(
            "memory_threshold",
            0.04,
            "1",
            (_NARROWEST, 1.0),
            "first threshold over rated voltage",
            log=True,
        ),
        _weight(2, 2.0),
        _weight(3, 2.0),
    ),
    states=(_state(1), _state(2), _state(3)),
    equations=_equations,
    probe={"memory_threshold": (0.03, 0.1), "memory_weight_2": (0.0, 2.0)},
    looks_like=(
        "the residual changes with the distance from past reversal points; minor loops do not nest"
    ),
)
