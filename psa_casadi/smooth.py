"""Smooth forms of sign and magnitude that are exactly zero at zero and have finite slopes there."""

import casadi as ca

from psa_casadi.component import Expression, Symbols

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
