"""A spectrum of hysteresis elements: what plays, their squares and cubes add to a force."""

import math
from collections.abc import Sequence

from psa_casadi.component import Expression, Symbols
from psa_casadi.variables import Parameter

#: What the elements add: the powers of their plays.
_POWERS = {"play": "the plays", "square": "the plays' squares", "cube": "the plays' cubes"}


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

    each = [weights(name, count) for name, count in zip(_POWERS, counts, strict=True)]
    return sum(_polynomial(s, z, *own) for z, *own in zip(elements, *each, strict=True))


def spectrum_parameters(
    prefix: str, counts: Sequence[int], plays: Sequence[float]
) -> list[Parameter]:
    """Return the weights of `spectrum_force`; the first ones of the `plays` begin as given.

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
