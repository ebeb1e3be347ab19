"""What the data know of parameters that they leave open: combinations, in words."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from math import nan

import numpy as np

from psa_casadi.identification.determinacy import Determinacy
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.model.compose import Model
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


#: A combination is known if its relative standard error is below this ...
KNOWN = 0.1
#: ... and each parameter that trades off in it would alone give it an error so many times larger.
SURER = 5.0
#: Parameters with a relative standard error above this are asked for what they trade off with.
WEAK = 0.05
#: Two parameters whose correlation is above this are tied.
TIED = 0.5
_STEP = 1e-5


@dataclass(frozen=True)
class Combination:
    """Parameters that trade off against each other, and what of them is known.

    `known` is the formula that the data determine with the relative standard error
    `relative_error` (nan where it follows from the model's form); None where none was found.
    """

    parameters: tuple[str, ...]
    known: str | None
    relative_error: float
    sentence: str


def free_combinations(
    model: Model, found: Determinacy, *, force_scale_given: bool = False
) -> tuple[Combination, ...]:
    """Return what is known of parameters that trade off, in as few and simple formulas as possible.

    Parameters with a standard error above 5 % are asked. A formula explains those in it whose
    errors cancel: it is known to 10 %, and to a fifth of the error that each of them alone would
    give it (delta method with the covariance of the values). Formulas with a meaning are tried
    first (`FORMULAS`, sums of lags), those that explain much with few parameters and small errors
    before others; then products and ratios of two or three for what is undetermined. What remains
    is listed with the parameters it is correlated with. The scale of force and the product with an
    assumed capacitance follow from the model's form; they come last.
    """
    judge = _Judge(model, found)
    results: list[Combination] = []
    candidates = [judge.known(f) for f in physical_formulas(model.values, found.names)]
    open_ones = judge.weak()
    while True:
        news = [(judge.rank(c, open_ones), c) for c in candidates if c and open_ones & set(c.parts)]
        if not news:
            break
        best = min(news, key=lambda pair: pair[0])[1]
        results.append(judge.combination(best))
        open_ones -= set(best.parts)
    left = [n for n in found.undetermined if n in open_ones]
    for formula in monomials(model.values, found.names):
        simple = judge.known(formula) if set(left) & set(formula.names) else None
        if simple:
            results.append(judge.combination(simple))
            left = [n for n in left if n not in simple.parts]
    return (*results, *judge.rest(left), *_from_the_form(model, found.names, force_scale_given))


@dataclass(frozen=True)
class _Known:
    """A formula, the parameters that trade off in it, and its standard error.

    `relative` is that over its value, `cancelled` over what one of the parameters would make it.
    """

    formula: Formula
    parts: tuple[str, ...]
    relative: float
    cancelled: float


class _Judge:
    """Standard errors of formulas, from the covariance of the values."""

    def __init__(self, model: Model, found: Determinacy) -> None:
        self._model, self._found = model, found

    def weak(self) -> set[str]:
        """Return the parameters whose relative standard error is above `WEAK`."""
        return {n for n in self._found.names if self._relative(n) > WEAK}

    def known(self, formula: Formula) -> _Known | None:
        """Return a formula that is known far better than its parameters, else None."""
        found, names = self._found, self._found.names
        free = [n for n in formula.names if n in names]
        gradient = np.array([self._slope(formula, n) if n in free else 0.0 for n in names])
        value = abs(formula.value(self._model.values))
        error = float(np.sqrt(max(float(gradient @ found.covariance @ gradient), 0.0)))
        alone = {n: abs(gradient[names.index(n)]) * found.standard_errors[n] for n in free}
        parts = tuple(n for n in free if alone[n] >= SURER * error)
        if error > KNOWN * value or len(parts) < (2 if formula.physical else len(free)):
            return None
        return _Known(formula, parts, error / value, error / max(alone.values()))

    def rank(self, known: _Known, wanted: set[str]) -> float:
        """Return what is smallest for a formula that is sure, short, and explains much."""
        free = sum(n in self._found.names for n in known.formula.names)
        return float(known.cancelled * 2.0**free / len(wanted & set(known.parts)))

    def combination(self, known: _Known) -> Combination:
        """Say what is known and what trades off."""
        formula, parts, error = known.formula, known.parts, _percent(known.relative)
        meaning = f"{formula.meaning}, {formula.text},"
        if any(n in self._found.undetermined for n in parts):
            text = f"Only {meaning} is determined, to {error}; {_listing(parts)} trade off in it."
        else:
            alone = _listing([f"{n} to {_percent(self._relative(n))}" for n in parts])
            text = f"{_listing(parts)} trade off: {meaning} is known to {error}, {alone}."
        return Combination(parts, formula.text, known.relative, text)

    def rest(self, names: Sequence[str]) -> Iterator[Combination]:
        """Yield undetermined parameters that no formula explains, with what they are tied to."""
        left, alone = list(names), []
        while left:
            group = [left.pop(0)]
            for member in group:  # grows while it is walked
                group += [n for n in left if self._tied(member, n)]
                left = [n for n in left if n not in group]
            others = [n for n in self._found.names if n not in names and self._tied(group[0], n)]
            if len(group) > 1:
                text = f"{_listing(group)} trade off; no simple formula of them is known."
                yield Combination(tuple(group), None, nan, text)
            elif others:
                text = f"{group[0]} is free; it trades off with {_listing(others)}."
                yield Combination((*group, *others), None, nan, text)
            else:
                alone += group
        if alone:
            be, which = ("is", "it") if len(alone) == 1 else ("are", "any of them")
            text = f"{_listing(alone)} {be} free: these records hardly depend on {which}."
            yield Combination(tuple(alone), None, nan, text)

    def _tied(self, one: str, other: str) -> bool:
        row, column = self._found.names.index(one), self._found.names.index(other)
        return bool(one != other and abs(self._found.correlations[row, column]) > TIED)

    def _relative(self, name: str) -> float:
        value = self._model.values[name]
        size = abs(value) or self._model.parameter(name).typical(self._model.values)
        return self._found.standard_errors[name] / size

    def _slope(self, formula: Formula, name: str) -> float:
        values = self._model.values
        step = _STEP * (abs(values[name]) or self._model.parameter(name).typical(values))
        up, down = (formula.value({**values, name: values[name] + h}) for h in (step, -step))
        return (up - down) / (2.0 * step)


def _from_the_form(
    model: Model, free: Sequence[str], force_scale_given: bool
) -> Iterator[Combination]:
    """Yield what no record of voltage and displacement can tell."""
    if "R_s" in free and "C_p" in model.values and "C_p" not in free:
        text = (
            "Only the product R_s C_p shows in a displacement; R_s is right for the C_p that the"
            " model assumes."
        )
        yield Combination(("R_s", "C_p"), "R_s C_p", nan, text)
    if not force_scale_given:
        units = ("N/V", "N/(V.s)", "N", "kg", "N.s/m", "N/m")
        scaled = tuple(p.name for p in model.structure.parameters if p.unit in units)
        text = (
            f"The scale of force is free: {_listing(scaled)} may all be multiplied by one factor;"
            " a stiffness or blocking force from outside fixes it."
        )
        yield Combination(scaled, None, nan, text)


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %" if share < 0.995 else "no better than its size"


def _listing(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
