"""What components are made of: smooth signs, plays, a bent curve; parameters, states, usual sizes.

The sizes are those of the signals of a stack, from its parameter values.
"""

import math
from collections.abc import Sequence
from math import pi
from typing import Any

import casadi as ca

from psa_casadi.model.component import Expression, Symbols
from psa_casadi.model.variables import Nominal, Parameter, State, Values


def voltage_scale(p: Values) -> float:
    """Rated voltage span `u_rated` [V]."""
    return abs(p["u_rated"])


def stop_scale(p: Values) -> float:
    """Usual size of a stop element of the hysteresis, a tenth of the rated voltage [V]."""
    return 0.1 * voltage_scale(p)


def force_scale(p: Values) -> float:
    """Force at rated voltage, `k_L u_rated` [N]."""
    return abs(p["k_L"]) * voltage_scale(p)


def hysteresis_scale(p: Values) -> float:
    """Usual size of a hysteresis force, a tenth of the force at rated voltage [N]."""
    return 0.1 * abs(p["k_L"]) * abs(p["u_rated"])


def stiffness_scale(p: Values) -> float:
    """Series stiffness of wafers and bonding layers, or the single stiffness [N/m]."""
    if "k_B" in p:
        return p["k_P"] * p["k_B"] / (p["k_P"] + p["k_B"])
    return p["k"]


def stroke_scale(p: Values) -> float:
    """Free stroke at rated voltage [m]."""
    return force_scale(p) / stiffness_scale(p)


def reading_scale(p: Values) -> float:
    """An ordinary error of a reading, a thousandth of the stroke [m]."""
    return 1e-3 * stroke_scale(p)


def velocity_scale(p: Values) -> float:
    """Stroke times the lowest natural angular frequency [m/s]."""
    if "k_B" in p:
        omega = min(math.sqrt(p["k_P"] / p["m_P"]), math.sqrt(p["k_B"] / p["m_B"]))
    else:
        omega = math.sqrt(p["k"] / p["m"])
    return stroke_scale(p) * omega


def current_scale(p: Values) -> float:
    """Charging current at one rated voltage span per millisecond [A]."""
    return p["C_p"] * voltage_scale(p) / 1e-3


def charge_scale(p: Values) -> float:
    """Charge at rated voltage, `C_p u_rated` [C]."""
    return p["C_p"] * voltage_scale(p)


def static_stiffness(s: Symbols) -> Expression:
    """Return the static stiffness from free force to displacement [N/m].

    The cascade's wafers and bonding layers in series, k_P k_B / (k_P + k_B), or the single k.
    """
    if hasattr(s, "k_B"):
        return s.k_P * s.k_B / (s.k_P + s.k_B)
    return s.k


def stroke(s: Symbols) -> Expression:
    """Return the linear free stroke at rated voltage, k_L u_rated / static stiffness [m]."""
    return s.k_L * s.u_rated / static_stiffness(s)


#: Exponent of the smooth stop; 2 bends gently, infinity is the ideal stop operator.
_SHARPNESS = 4.0


def direction(s: Symbols) -> Expression:
    """Return the sign of the voltage rate, `s(u') = u' / sqrt(u'^2 + hold_rate^2)` [1].

    Far above `hold_rate` this is sgn(u'); a held voltage (u' -> 0) has no direction, so that the
    hysteresis force rests during a hold.
    """
    rate = s.voltage_rate
    return rate / ca.sqrt(rate**2 + s.hold_rate**2)


def rate_magnitude(s: Symbols) -> Expression:
    """Return `|u'| = u' s(u')` [V/s]."""
    return s.voltage_rate * direction(s)


def smooth_magnitude(value: Expression, width: Expression) -> Expression:
    """Return `|value|` as `value^2 / sqrt(value^2 + width^2)`: 0 with slope 0 at 0.

    It is 1 % below `|value|` at 7 widths. A value much smaller than the width counts as none.
    """
    return value**2 / ca.sqrt(value**2 + width**2)


def softplus(z: Expression) -> Expression:
    """Return ln(1 + exp(z)) without overflow, with its slope at 0 right: |z| has slope 0 there."""
    size = ca.fabs(z)
    return 0.5 * (z + size) + ca.log(1 + ca.exp(-size))


def pade_section(
    delay: Expression, floor: Expression, y: Expression, a: Expression, b: Expression
) -> tuple[Expression, ...]:
    """Return (a', b', output) of a second-order Pade section of a delay T, the identity at T = 0.

    a is y behind 1/(1 + s T/2 + s^2 T^2/12) and b = T a', so that the output y - b is y behind
    (1 - s T/2 + s^2 T^2/12)/(1 + s T/2 + s^2 T^2/12). A small `floor` [s] is added to T in the
    filter.
    """
    time = delay + floor
    return b / time, 12 / time * (y - a - b / 2), y - delay / time * b


def magnitude_power(value: Expression, exponent: Expression) -> Expression:
    """Return `|value|^exponent`, as `(value^2 + 1e-24)^(exponent/2)`.

    The tiny constant keeps the derivatives with respect to value and exponent finite at 0; it
    changes the result only where `|value|` is below 1e-12.
    """
    return (value**2 + 1e-24) ** (exponent / 2)


def signed_power(value: Expression, exponent: Expression) -> Expression:
    """Return `sign(value) |value|^exponent`, smooth at 0 like `magnitude_power`."""
    return value * (value**2 + 1e-24) ** ((exponent - 1) / 2)


def stop_rate(s: Symbols, z: Expression, threshold: Expression) -> Expression:
    """Rate of a smooth stop element: z' = u' - (|u'| sgn(z) + u') / 2 * |z / threshold|^m."""
    ratio = z / threshold
    return s.voltage_rate - 0.5 * (
        rate_magnitude(s) * signed_power(ratio, _SHARPNESS)
        + s.voltage_rate * magnitude_power(ratio, _SHARPNESS)
    )


#: What the elements add: the powers of their plays.
_POWERS = {"play": "the plays", "square": "the plays' squares", "cube": "the plays' cubes"}


def stop_rates(
    s: Symbols, prefix: str, thresholds: Sequence[Expression]
) -> tuple[list[Expression], dict[str, Expression]]:
    """Return stop elements `prefix`1, `prefix`2, ... of these thresholds [V], and their rates."""
    names = [f"{prefix}{i}" for i in range(1, len(thresholds) + 1)]
    elements = [getattr(s, name) for name in names]
    rates = [stop_rate(s, z, r) for z, r in zip(elements, thresholds, strict=True)]
    return elements, dict(zip(names, rates, strict=True))


def stop_state(name: str, description: str) -> State:
    """Return the state of a stop element."""
    return State(
        name, "V", description, stop_scale, memory=True, settles=False, whole=voltage_scale
    )


def stop_states(prefix: str, thresholds: Sequence[str]) -> tuple[State, ...]:
    """Return the states of stop elements, whose thresholds are described in words."""
    return tuple(
        stop_state(f"{prefix}{i}", f"stop element {i}, threshold {threshold}")
        for i, threshold in enumerate(thresholds, 1)
    )


def spectrum_force(
    s: Symbols, prefix: str, elements: Sequence[Expression], counts: Sequence[int]
) -> Expression:
    """Return what stop elements add to the voltage [V]: the polynomials of their plays, summed.

    Plays, squares and cubes have separate weights, each a sum of `counts` cosines over the
    elements.
    """
    places = [math.pi * (i + 0.5) / len(elements) for i in range(len(elements))]

    def weights(name: str, count: int) -> list[Expression]:
        terms = [getattr(s, f"{prefix}{name}_{k}") for k in range(count)]
        return [sum(c * math.cos(k * x) for k, c in enumerate(terms)) for x in places]

    each = [weights(name, count) for name, count in zip(_POWERS, counts, strict=True)]
    return sum(_polynomial(s, z, *item) for z, *item in zip(elements, *each, strict=True))


def spectrum_parameters(
    prefix: str, counts: Sequence[int], plays: Sequence[float]
) -> list[Parameter]:
    """Return the weights of `spectrum_force`; the first ones of the plays start at `plays`.

    The k-th cosine has a scale of 1/(k + 1), so that the prior prefers smooth spectra.
    """
    return [
        Parameter(
            f"{prefix}{name}_{k}",
            plays[k] if name == "play" and k < len(plays) else 0.0,
            "1",
            (-2.0, 2.0),
            f"cosine {k} of the weights of {text}" if k else f"mean weight of {text}",
            scale=0.02 / (k + 1),
        )
        for (name, text), count in zip(_POWERS.items(), counts, strict=True)
        for k in range(count)
    ]


def _polynomial(
    s: Symbols, z: Expression, plain: Expression, square: Expression, cube: Expression
) -> Expression:
    """Return plain (u - p) + square (u^2 - p^2)/u_r + cube (u^3 - p^3)/u_r^2 [V] of a stop z.

    p = u - z is its play, u_r the rated voltage: u^2 - p^2 = z (2 u - z), u^3 - p^3 =
    z (3 u (u - z) + z^2). Squares make a loop asymmetric, cubes steeper or flatter in its middle;
    over all thresholds this is a Preisach density of second order in the mean of its thresholds.
    """
    u, rated = s.u, s.u_rated
    return z * (
        plain + square * (2.0 * u - z) / rated + cube * (3.0 * u * (u - z) + z**2) / rated**2
    )


#: Angles from which fits start; sizes of either sign make the circle whole.
ANGLES = (0.0, 0.25 * pi, 0.5 * pi, 0.75 * pi)
#: How the reports write the curve.
BEND_TEXT = (
    "b(q) = cos({0}_angle) 6 q^2 + sin({0}_angle) (20 q^3 - 30 q^2)"
    " + {0}_wave (70 q^4 - 140 q^3 + 90 q^2)"
)


def bend(q: Expression, angle: Expression, wave: Expression) -> Expression:
    """Return b(q) [1] for a displacement over the stroke, the angle [rad] and the W part [1].

    b(q) = cos(a) B(q) + sin(a) S(q) + w W(q), where B = 6 q^2, S = 20 q^3 - 30 q^2 and
    W = 70 q^4 - 140 q^3 + 90 q^2 are the second to fourth Legendre polynomials on 0 <= q <= 1
    without constant and slope, which a fit attributes to the stack (offset and sensitivity,
    a linear load). So a is the angle between a bow (0) and an S about the middle (pi/2), and any
    cubic is a size and an angle: ratios of coefficients would have to pass through infinity on the
    way from one sign to the other.
    """
    bow, s, w = 6 * q**2, q**2 * (20 * q - 30), q**2 * (70 * q**2 - 140 * q + 90)
    return ca.cos(angle) * bow + ca.sin(angle) * s + wave * w


def shape_parameters(prefix: str) -> tuple[Parameter, Parameter]:
    """Return the two parameters of the curve's form, `prefix`_angle and `prefix`_wave."""
    return (
        Parameter(
            f"{prefix}_angle",
            0.0,
            "rad",
            (-2.0 * pi, 2.0 * pi),
            "form of the bend: 0 a bow, pi/2 an S about half the stroke",
            scale=0.3,
        ),
        Parameter(
            f"{prefix}_wave", 0.0, "1", (-20.0, 20.0), "quartic (W) part over bow and S", scale=0.1
        ),
    )


def share(
    name: str, bounds: tuple[float, float], description: str, scale: Nominal, value: float = 0.0
) -> Parameter:
    """Return a parameter without a dimension; `scale` is the size of an ordinary change."""
    return Parameter(name, value, "1", bounds, description, scale=scale)


def positive(
    name: str,
    value: float,
    unit: str,
    bounds: tuple[float, float],
    description: str,
    *,
    limit: bool = False,
) -> Parameter:
    """Return a parameter that spans decades; `limit` as in `Parameter`."""
    return Parameter(name, value, unit, bounds, description, log=True, limit=limit)


def reading(name: str, description: str) -> Parameter:
    """Return the size of an error of a reading [m]."""
    return Parameter(name, 0.0, "m", (-1e-3, 1e-3), description, "um", scale=reading_scale)


def delay(name: str, description: str) -> Parameter:
    """Return a delay or lag [s] that is a gain: 0 removes it."""
    return Parameter(name, 0.0, "s", (0.0, 0.1), description, "ms", scale=1e-4)


def form(name: str, description: str) -> Parameter:
    """Return what chooses between two forms, 0 and 1; it is tried and not fitted."""
    return Parameter(name, 0.0, "1", (0.0, 1.0), description, fitted=False)


def motion(name: str, description: str, scale: Nominal = stroke_scale, **more: Any) -> State:
    """Return a displacement as a state; `more` as in `State`."""
    return State(name, "m", description, scale, display_unit="um", **more)
