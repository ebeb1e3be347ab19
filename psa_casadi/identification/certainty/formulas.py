"""Formulas of parameters that a record may determine although their parameters are open."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.variables import Values


@dataclass(frozen=True)
class Formula:
    """A formula of parameter values, what it means, and the parameters in it.

    `physical` is False for products and ratios that were tried only because nothing else fits.
    """

    text: str
    meaning: str
    names: tuple[str, ...]
    value: Callable[[Values], float]
    physical: bool = True


def _quotient(above: str, below: str, meaning: str) -> Formula:
    return Formula(
        f"{above}/{below}", meaning, (above, below), lambda p: float(p[above] / p[below])
    )


def _bend(name: str) -> Formula:
    return Formula(
        f"{name} A/(k_L + A)",
        "the bend of the loop",
        (name, "A", "k_L"),
        lambda p: float(p[name] * p["A"] / (p["k_L"] + p["A"])),
    )


_SUMMANDS = (
    Formula("tau", "", ("tau",), lambda p: p["tau"]),
    Formula("R_s C_p", "", ("R_s", "C_p"), lambda p: p["R_s"] * p["C_p"]),
    _quotient("c", "k", ""),
    _quotient("c_P", "k_P", ""),
    _quotient("c_B", "k_B", ""),
)
_ZERO = Formula(
    "(c_P + c_B)/(k_P + k_B)",
    "the zero of the mechanics",
    ("c_P", "c_B", "k_P", "k_B"),
    lambda p: (p["c_P"] + p["c_B"]) / (p["k_P"] + p["k_B"]),
)

#: Combinations with a meaning; Yang and Zhu 2015, eqs. (8), (10)-(15), (23), (33), (34).
FORMULAS: tuple[Formula, ...] = (
    _quotient("c_P", "k_P", "the wafers' lag"),
    _quotient("c_B", "k_B", "the bonding layers' lag"),
    _quotient("m_P", "k_P", "the wafers' resonance"),
    _quotient("m_B", "k_B", "the bonding layers' resonance"),
    _quotient("m", "k", "the resonance"),
    _quotient("m_P", "c_P", "the wafers' quick decay"),
    _quotient("m_B", "c_B", "the bonding layers' quick decay"),
    Formula("c_P + c_B", "the sum of the dampings", ("c_P", "c_B"), lambda p: p["c_P"] + p["c_B"]),
    _ZERO,
    Formula("k_L + A", "the slope after a reversal", ("k_L", "A"), lambda p: p["k_L"] + p["A"]),
    Formula(
        "k_L (1/k_P + 1/k_B)",
        "the static gain without hysteresis",
        ("k_L", "k_P", "k_B"),
        lambda p: p["k_L"] * static_compliance(p),
    ),
    Formula(
        "(k_L + A) (1/k_P + 1/k_B)",
        "the slope after a reversal",
        ("k_L", "A", "k_P", "k_B"),
        lambda p: (p["k_L"] + p["A"]) * static_compliance(p),
    ),
    _bend("beta"),
    _bend("gamma"),
    Formula(
        "beta + gamma",
        "the bend of a growing f_H",
        ("beta", "gamma"),
        lambda p: p["beta"] + p["gamma"],
    ),
    Formula(
        "gamma - beta",
        "the bend of a shrinking f_H",
        ("beta", "gamma"),
        lambda p: p["gamma"] - p["beta"],
    ),
)


def physical_formulas(values: Values, free: Sequence[str]) -> list[Formula]:
    """Return the formulas with a meaning that hold two or more free parameters."""
    declared = [*FORMULAS, *_lag_sums(values, free)]
    return [
        f
        for f in declared
        if all(n in values for n in f.names) and sum(n in free for n in f.names) > 1
    ]


def monomials(values: Values, free: Sequence[str]) -> Iterator[Formula]:
    """Yield products and ratios of two and of three free parameters that are not zero."""
    sized = [n for n in free if values[n] != 0.0]
    for pair in combinations(sized, 2):
        for powers in ((1, 1), (1, -1), (2, 1), (2, -1), (1, 2), (1, -2)):
            yield _monomial(pair, powers)
    for triple in combinations(sized, 3):
        for second, third in product((1, -1), repeat=2):
            yield _monomial(triple, (1, second, third))


def _lag_sums(values: Values, free: Sequence[str]) -> Iterator[Formula]:
    """Yield sums of two and more lags, the mechanics' with and without its zero, eq. (15).

    A lag without a free parameter is a constant, which would only make the sum look sure.
    """
    known = [
        f
        for f in _SUMMANDS
        if all(n in values for n in f.names) and any(n in free for n in f.names)
    ]
    for count in range(2, len(known) + 1):
        for chosen in combinations(known, count):
            yield _sum(chosen, ())
            if {"c_P", "c_B"} <= {n for f in chosen for n in f.names}:
                yield _sum(chosen, (_ZERO,))


def _sum(plus: Sequence[Formula], minus: Sequence[Formula]) -> Formula:
    def value(p: Values) -> float:
        return sum(f.value(p) for f in plus) - sum(f.value(p) for f in minus)

    text = " - ".join([" + ".join(f.text for f in plus), *(f.text for f in minus)])
    names = tuple(dict.fromkeys(n for f in plus for n in f.names))
    return Formula(text, "the sum of the lags", names, value)


def _monomial(names: Sequence[str], powers: Sequence[int]) -> Formula:
    def value(p: Values) -> float:
        return float(np.prod([p[n] ** k for n, k in zip(names, powers, strict=True)]))

    above = [n if k == 1 else f"{n}^{k}" for n, k in zip(names, powers, strict=True) if k > 0]
    below = [n if k == -1 else f"{n}^{-k}" for n, k in zip(names, powers, strict=True) if k < 0]
    text = " ".join(above)
    if below:
        text += f"/{below[0]}" if len(below) == 1 else f"/({' '.join(below)})"
    meaning = "the ratio" if below else "the product"
    return Formula(text, meaning, tuple(names), value, physical=False)
