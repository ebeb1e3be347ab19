"""From the coefficients of eq. (15) to physical parameters: factor the denominator."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.paper.moments import COEFFICIENTS

#: A root counts as real where its imaginary part is below this share of its size.
_REAL = 1e-6
#: The zero that the factors imply may differ from b_1 by this share before a sentence says so.
_ZERO_AGREES = 0.2


@dataclass(frozen=True)
class Factors:
    """One way to read the denominator: tau [s], then m/k [s^2] and c/k [s] of both parts."""

    tau: float
    m_P: float
    c_P: float
    m_B: float
    c_B: float


def mechanics_of(
    coefficients: Mapping[str, float], k_P: float, k_B: float
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return tau, m_P, c_P, m_B, c_B (SI), and sentences; tau alone where no stack has the roots.

    a_5 s^5 + ... + a_1 s + 1 = (tau s + 1) (m_P/k_P s^2 + c_P/k_P s + 1) (m_B/k_B s^2 + ...).
    A real root gives tau, the other four make two pairs. Where several readings exist (the
    displacement does not tell them apart, but for the zero) the one is taken whose zero,
    (c_B + c_P)/(k_B + k_P), comes nearest to b_1, and of those the one with the longest tau. Where
    a pole does not decay, tau = K_1 = a_1 - b_1, the first line of (21), is all that is left.
    """
    denominator = [coefficients[name] for name in reversed(COEFFICIENTS[:5])]
    if not np.all(np.isfinite(denominator)) or denominator[0] == 0.0:
        return _delay_alone(coefficients), (_NOT_A_STACK.format("a_5 is zero or not finite"),)
    roots = np.roots([*denominator, 1.0]).astype(np.complex128)
    if np.any(roots.real >= 0.0):
        count = int(np.sum(roots.real >= 0.0))
        return _delay_alone(coefficients), (
            _NOT_A_STACK.format(f"{count} of its 5 poles do not decay"),
        )
    b_1 = coefficients["b_1"]

    def distance(f: Factors) -> tuple[float, float]:
        off = abs(_zero(f, k_P, k_B) - b_1)
        return round(off / max(abs(b_1), 1e-12), 6), -f.tau

    best = min(readings(roots), key=distance)
    values = {
        "tau": best.tau,
        "m_P": best.m_P * k_P,
        "c_P": best.c_P * k_P,
        "m_B": best.m_B * k_B,
        "c_B": best.c_B * k_B,
    }
    if distance(best)[0] <= _ZERO_AGREES:
        return values, ()
    return values, (
        f"b_1 = {b_1:.3g} s, but the poles allow {_zero(best, k_P, k_B):.3g} s at the nearest with"
        f" the assumed k_P/k_B = {k_P / k_B:.3g}: b_1 or this ratio is wrong, and the first"
        " microseconds of a step will be off.",
    )


def readings(roots: npt.NDArray[np.complex128]) -> Iterator[Factors]:
    """Yield every way to split five stable roots into a real one and two pairs with real factors.

    Of five roots of a real polynomial one is real; complex ones stay with their conjugates.
    """
    real = [k for k, r in enumerate(roots) if abs(r.imag) <= _REAL * abs(r)]
    for alone in real:
        rest = [k for k in range(5) if k != alone]
        for pair in combinations(rest, 2):
            other = [k for k in rest if k not in pair]
            one, two = (_pair(roots[list(p)]) for p in (pair, other))
            if one is not None and two is not None:
                yield Factors(float(-1.0 / roots[alone].real), *one, *two)


def _pair(roots: npt.NDArray[np.complex128]) -> tuple[float, float] | None:
    """Return (m/k, c/k) of (s - s_1)(s - s_2) = 0, None where that is no real polynomial."""
    product, total = roots[0] * roots[1], roots[0] + roots[1]
    size = float(np.max(np.abs(roots)))
    if abs(product.imag) > _REAL * size**2 or abs(total.imag) > _REAL * size:
        return None
    return float(1.0 / product.real), float(-total.real / product.real)


def _delay_alone(coefficients: Mapping[str, float]) -> dict[str, float]:
    delay = coefficients["a_1"] - coefficients["b_1"]
    return {"tau": delay} if delay > 0.0 else {}


def _zero(f: Factors, k_P: float, k_B: float) -> float:
    return (f.c_B * k_B + f.c_P * k_P) / (k_B + k_P)


_NOT_A_STACK = (
    "The denominator of eq. (15) is no stack's: {}. tau = a_1 - b_1 alone is taken, masses and"
    " dampings keep ordinary values; use --method prediction-error, or a longer, quieter step."
)
