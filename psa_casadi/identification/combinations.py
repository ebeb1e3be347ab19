"""What the data know of parameters that they leave open: formulas in which their errors cancel."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product
from math import nan
from typing import Any, Literal

import numpy as np

from psa_casadi.common.display import Worded
from psa_casadi.identification.determinacy import Determinacy
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import Values

#: A combination is known if its relative standard error is below this ...
KNOWN = 0.1
#: ... and each parameter that trades off in it would alone give it an error this much larger.
SURER = 5.0
#: Parameters with a relative standard error above this may trade off with others.
WEAK = 0.05
#: Two parameters whose correlation is above this are tied.
TIED = 0.5
_STEP = 1e-5
_FORCES = ("N/V", "N/(V.s)", "N", "kg", "N.s/m", "N/m")


@dataclass(frozen=True)
class Formula:
    """A formula of parameter values, as it is written, and what it means.

    `physical` is False for products and ratios that were tried only because nothing else fits.
    """

    text: str
    meaning: str
    physical: bool = True

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The parameters in it."""
        return tuple(dict.fromkeys(re.findall(r"[A-Za-z]\w*", self.text)))

    @cached_property
    def _code(self) -> Any:
        """The formula as code: a space between two factors is a product."""
        product = re.sub(r"(?<=[\w)]) (?=[\w(])", "*", self.text)
        return compile(product.replace("^", "**"), self.text, "eval")

    def value(self, p: Values) -> float:
        """Return the formula's value."""
        return float(eval(self._code, {"__builtins__": {}}, dict(p)))


_LAGS = ("tau", "R_s C_p", "c/k", "c_P/k_P", "c_B/k_B")
_ZERO = "(c_P + c_B)/(k_P + k_B)"
#: Combinations with a meaning; Yang and Zhu 2015, eqs. (8), (10)-(15), (23), (33), (34).
FORMULAS = tuple(
    Formula(text, meaning)
    for text, meaning in {
        "c_P/k_P": "the wafers' lag",
        "c_B/k_B": "the bonding layers' lag",
        "m_P/k_P": "the wafers' resonance",
        "m_B/k_B": "the bonding layers' resonance",
        "m/k": "the resonance",
        "m_P/c_P": "the wafers' quick decay",
        "m_B/c_B": "the bonding layers' quick decay",
        "c_P + c_B": "the sum of the dampings",
        _ZERO: "the zero of the mechanics",
        "k_L + A": "the slope after a reversal",
        "k_L (1/k_P + 1/k_B)": "the static gain without hysteresis",
        "(k_L + A) (1/k_P + 1/k_B)": "the slope after a reversal",
        "beta A/(k_L + A)": "the bend of the loop",
        "gamma A/(k_L + A)": "the bend of the loop",
        "beta + gamma": "the bend of a growing f_H",
        "gamma - beta": "the bend of a shrinking f_H",
    }.items()
)


def physical_formulas(values: Values, free: Sequence[str]) -> list[Formula]:
    """Return the formulas with a meaning that hold two or more free parameters.

    `FORMULAS`, and sums of two and more lags, the mechanics' with and without its zero, eq. (15).
    A lag without a free parameter is a constant, which would only make the sum look sure.
    """
    known = [
        f for f in (Formula(lag, "") for lag in _LAGS)
        if set(f.names) <= set(values) and set(f.names) & set(free)
    ]  # fmt: skip
    sums = []
    for count in range(2, len(known) + 1):
        for chosen in combinations([f.text for f in known], count):
            sums.append(" + ".join(chosen))
            if {"c_P/k_P", "c_B/k_B"} <= set(chosen):
                sums.append(f"{sums[-1]} - {_ZERO}")
    every = (*FORMULAS, *(Formula(text, "the sum of the lags") for text in sums))
    return [f for f in every if set(f.names) <= set(values) and len(set(f.names) & set(free)) > 1]


def monomials(values: Values, free: Sequence[str]) -> Iterator[Formula]:
    """Yield products and ratios of two and of three free parameters that are not zero."""
    sized = [n for n in free if values[n] != 0.0]
    pairs = ((1, 1), (1, -1), (2, 1), (2, -1), (1, 2), (1, -2))
    triples = tuple((1, *signs) for signs in product((1, -1), repeat=2))
    for count, every in ((2, pairs), (3, triples)):
        for names, powers in product(combinations(sized, count), every):
            factors = [
                f"{n}^{abs(k)}" if abs(k) > 1 else n for n, k in zip(names, powers, strict=True)
            ]
            above, below = (
                " ".join(f for f, k in zip(factors, powers, strict=True) if sign * k > 0)
                for sign in (1, -1)
            )
            text = f"{above}/({below})" if " " in below else f"{above}/{below}"
            meaning = "the ratio" if below else "the product"
            yield Formula(text if below else above, meaning, physical=False)


@dataclass(frozen=True)
class Combination(Worded):
    """Parameters that trade off against each other, and what of them is known.

    `known` is the formula that the data determine with the relative standard error
    `relative_error` (nan where it follows from the model's form), `meaning` what it is; None and ""
    where none is known. `kind` is `only` where nothing but the formula is determined, `traded`
    where the parameters are determined worse than it (with the errors `alone`), `group` where no
    formula of them is known, `tied` where the first trades off with the others, `free` where the
    data hardly depend on any; `product` and `force` follow from the model's form.
    """

    kind: Literal["only", "traded", "group", "tied", "free", "product", "force"]
    parameters: tuple[str, ...]
    known: str | None = None
    relative_error: float = nan
    meaning: str = ""
    alone: tuple[float, ...] = ()


def free_combinations(
    model: Model, determinacy: Determinacy, *, force_scale_given: bool = False
) -> tuple[Combination, ...]:
    """Return what is known of parameters that trade off, in as few and simple formulas as possible.

    For parameters with a standard error above 5 %. A formula explains those in it whose
    errors cancel: it is known to 10 %, and to a fifth of the error that each of them alone would
    give it (delta method with the covariance of the values). Formulas with a meaning are tried
    first (`FORMULAS`, sums of lags), those that explain much with few parameters and small errors
    before others; then products and ratios of two or three for what is undetermined. What remains
    is listed with the parameters it is correlated with. The scale of force and the product with an
    assumed capacitance follow from the model's form; they come last.
    """
    judge = _Judge(model, determinacy)
    results: list[Combination] = []
    candidates = [
        c for f in physical_formulas(model.values, determinacy.names) if (c := judge.known(f))
    ]
    open_ones = {n for n in determinacy.names if judge.relative(n) > WEAK}
    while news := [c for c in candidates if open_ones & set(c[0].parameters)]:
        best, _ = min(news, key=lambda c: c[1] / len(open_ones & set(c[0].parameters)))
        results.append(best)
        open_ones -= set(best.parameters)
    left = [n for n in determinacy.undetermined if n in open_ones]
    for formula in monomials(model.values, determinacy.names):
        simple = judge.known(formula) if set(left) & set(formula.names) else None
        if simple:
            results.append(simple[0])
            left = [n for n in left if n not in simple[0].parameters]
    results += judge.rest(left)
    if "R_s" in determinacy.names and "C_p" in model.values and "C_p" not in determinacy.names:
        results.append(Combination("product", ("R_s", "C_p"), "R_s C_p"))
    if not force_scale_given:
        scaled = tuple(p.name for p in model.structure.parameters if p.unit in _FORCES)
        results.append(Combination("force", scaled))
    return tuple(results)


class _Judge:
    """Standard errors of formulas, from the covariance of the values."""

    def __init__(self, model: Model, determinacy: Determinacy) -> None:
        self._model, self._determinacy = model, determinacy

    def known(self, formula: Formula) -> tuple[Combination, float] | None:
        """Return what is known far better than its parameters, else None.

        With it comes a rank, the smallest for a formula that is sure and short: its standard error
        over what one of the parameters would make it, doubled by each parameter that is free.
        """
        result, names = self._determinacy, self._determinacy.names
        order = formula.names if formula.physical else names
        free = [n for n in order if n in names and n in formula.names]
        values, gradient = self._model.values, np.zeros(len(names))
        for n in free:
            step = _STEP * self._size(n)
            up, down = (formula.value({**values, n: values[n] + h}) for h in (step, -step))
            gradient[names.index(n)] = (up - down) / (2.0 * step)
        value = abs(formula.value(values))
        error = float(np.sqrt(max(float(gradient @ result.covariance @ gradient), 0.0)))
        alone = {n: abs(gradient[names.index(n)]) * result.standard_errors[n] for n in free}
        parts = tuple(n for n in free if alone[n] >= SURER * error)
        if error > KNOWN * value or len(parts) < (2 if formula.physical else len(free)):
            return None
        only = any(n in result.undetermined for n in parts)
        combination = Combination(
            "only" if only else "traded", parts, formula.text, error / value, formula.meaning,
            () if only else tuple(self.relative(n) for n in parts),
        )  # fmt: skip
        return combination, error / max(alone.values()) * 2.0 ** len(free)

    def rest(self, names: Sequence[str]) -> Iterator[Combination]:
        """Yield undetermined parameters that no formula explains, with what they are tied to."""
        left, alone = list(names), []
        while left:
            group = [left.pop(0)]
            for member in group:  # grows while it is walked
                group += [n for n in left if self._tied(member, n)]
                left = [n for n in left if n not in group]
            other_names = [n for n in self._determinacy.names if n not in names]
            others = [n for n in other_names if self._tied(group[0], n)]
            if len(group) > 1:
                yield Combination("group", tuple(group))
            elif others:
                yield Combination("tied", (*group, *others))
            else:
                alone += group
        if alone:
            yield Combination("free", tuple(alone))

    def relative(self, name: str) -> float:
        """Return a parameter's standard error over its value."""
        return self._determinacy.standard_errors[name] / self._size(name)

    def _size(self, name: str) -> float:
        values = self._model.values
        return abs(values[name]) or self._model.parameter(name).typical(values)

    def _tied(self, one: str, other: str) -> bool:
        row, column = (self._determinacy.names.index(n) for n in (one, other))
        return bool(one != other and abs(self._determinacy.correlations[row, column]) > TIED)
