"""Hysteresis memory: the error depends on past reversal points; minor loops nest differently."""

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.scales import voltage_scale
from psa_casadi.smooth import magnitude_power, rate_magnitude, signed_power
from psa_casadi.variables import Parameter, State, Values

#: Sharpness of the smooth stop; 2 bends gently, infinity is the ideal stop operator.
_SHARPNESS = 2.0


def _stop(s: Symbols, z: Expression, threshold: Expression) -> Expression:
    """Rate of a smooth stop element: z' = u' - (|u'| sgn(z) + u') / 2 * |z / threshold|^m."""
    ratio = z / threshold
    return s.voltage_rate - 0.5 * (
        rate_magnitude(s) * signed_power(ratio, _SHARPNESS)
        + s.voltage_rate * magnitude_power(ratio, _SHARPNESS)
    )


def _equations(s: Symbols) -> Equations:
    first, second = s.memory_threshold * s.u_rated, 3 * s.memory_threshold * s.u_rated
    return Equations(
        der={"z_m1": _stop(s, s.z_m1, first), "z_m2": _stop(s, s.z_m2, second)},
        add={
            "free_force": s.k_L
            * s.memory_gain
            * ((1 - s.memory_share) * s.z_m1 + s.memory_share * s.z_m2)
        },
    )


def _state(name: str, what: str) -> State:
    return State(
        name, "V", f"stop element with {what} threshold", _stop_scale, memory=True, settles=False
    )


def _stop_scale(p: Values) -> float:
    return 0.1 * voltage_scale(p)


HYSTERESIS_MEMORY = Component(
    name="hysteresis_memory",
    description="further hysteresis elements with thresholds of their own",
    source="stop operators in parallel (Prandtl-Ishlinskii, Visintin 1994) in smooth Bouc-Wen form",
    gain="memory_gain",
    equation_text=(
        "f = k_L memory_gain ((1 - share) z_1 + share z_2),  "
        "z_i' = u' - (|u'| sgn(z_i) + u')/2 (|z_i|/w_i)^2,  w_1 = threshold u_rated,  w_2 = 3 w_1"
    ),
    parameters=(
        Parameter("memory_gain", 0.0, "1", (-2.0, 2.0), "force of the elements over k_L", scale=0.05),
        Parameter("memory_threshold", 0.1, "1", (1e-3, 2.0), "first threshold over rated voltage", log=True),
        Parameter("memory_share", 0.0, "1", (-10.0, 10.0), "share of the second element", scale=0.5),
    ),
    states=(_state("z_m1", "the first"), _state("z_m2", "three times the first")),
    equations=_equations,
    probe={"memory_threshold": (0.02, 0.06, 0.2), "memory_share": (0.0, 1.0)},
    looks_like="the residual changes with the distance from past reversal points; minor loops do not nest",
)
