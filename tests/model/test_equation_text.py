"""Equations as text: what is written reads back as the same, and nothing of a text is run."""

from cProfile import Profile
from typing import Any

import casadi as ca
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.model.component import KeptEquations, OnDemand
from psa_casadi.model.equation_text import FUNCTIONS, EquationTexts, equations_of, texts_of

X, Y = ca.SX.sym("x"), ca.SX.sym("y")


def kept(result: Any) -> KeptEquations:
    function = ca.Function("equations", [X, Y], [ca.SX(result)])
    return KeptEquations(function, ("x", "y"), (("der", "x"),))


def read(text: str, **where: str) -> KeptEquations:
    return equations_of(EquationTexts(where=where, der={"x": text}), "own.a.equations")


def value(of: KeptEquations, x: float, y: float) -> float:
    return float(of.function(*({"x": x, "y": y}[n] for n in of.symbols)))


@pytest.mark.parametrize(
    ("built", "text"),
    [
        (X - (Y - X), "x - (y - x)"),
        ((-X) ** Y, "(-x) ** y"),
        (-(X**Y), "-x ** y"),
        (X ** (Y**X), "x ** y ** x"),
        (ca.SX(-3.0) ** Y, "(-3) ** y"),
        (X / (Y * ca.sin(X)), "x / (y * sin(x))"),
        (X + X, "2 * x"),
        (1 / X, "1 / x"),
        (X * X, "x ** 2"),
        (0.1 * X, "0.1 * x"),
        (1e-300 * X, "1e-300 * x"),
        (ca.if_else(X < Y, X, Y), "if_else(x < y, x, y)"),
        (ca.if_else(ca.logic_and(X > 1, Y != 2), X, 0), "if_else(1 < x and y != 2, x, 0)"),
        (ca.logic_not(ca.logic_or(X <= Y, X == 3)), "not (x <= y or x == 3)"),
        (ca.log10(X), "log10(x)"),
        (ca.atan2(X, ca.fmax(Y, 0)), "atan2(x, fmax(y, 0))"),
    ],
)
def test_an_expression_is_written_as_people_write_it(built: Any, text: str) -> None:
    written = texts_of(kept(built))
    assert (written.der["x"], written.where) == (text, {})
    again = equations_of(written, "own.a.equations")
    for x, y in np.random.default_rng(0).uniform(0.1, 3.0, (20, 2)):
        np.testing.assert_equal(value(again, x, y), value(kept(built), x, y))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_reads_back_as_itself(name: str) -> None:
    inputs = [X, Y, ca.SX(0.7)][: FUNCTIONS[name]]
    built = getattr(ca, name)(*inputs)
    again = equations_of(texts_of(kept(built)), "own.a.equations")
    for x, y in np.random.default_rng(1).uniform(-3.0, 3.0, (20, 2)):
        np.testing.assert_equal(value(again, x, y), value(kept(built), x, y))


def test_every_number_comes_back_bit_for_bit() -> None:
    rng = np.random.default_rng(2)
    numbers = [float(v) for v in rng.standard_normal(50) * 10.0 ** rng.integers(-300, 300, 50)]
    for number in [*numbers, 5e-324, 1.7976931348623157e308, 0.1 + 0.2, 1e15 + 1.0, 999999.0]:
        again = equations_of(texts_of(kept(X + number)), "own.a.equations")
        assert value(again, 0.0, 0.0) == number


def test_what_is_used_often_or_is_long_has_a_name() -> None:
    deep: Any = X
    for _ in range(60):
        deep = ca.sin(deep) * ca.cos(deep) + 0.1 * deep
    written = texts_of(kept(deep + sum((X + k) ** 2 for k in range(300))))
    every = [*written.where.values(), *written.der.values()]
    assert max(map(len, every)) < 1_000
    assert sum(map(len, every)) < 10_000
    again = equations_of(written, "own.a.equations")
    assert value(again, 0.4, 0.0) == pytest.approx(40.5e6 / 4.5 * 0.99, rel=0.02)
    assert texts_of(again) == written


def test_names_of_parts_are_none_of_the_symbols() -> None:
    a1 = ca.SX.sym("a1")
    function = ca.Function("equations", [a1], [ca.sin(a1) ** 2 + ca.sin(a1)])
    written = texts_of(KeptEquations(function, ("a1",), (("der", "x"),)))
    assert written.where == {"a2": "sin(a1)"}
    again = equations_of(written, "own.a.equations")
    assert float(again.function(0.5)) == float(function(0.5))


PLACE = r"'own\.a\.equations\.der\.x' "
HOSTILE = {
    "a call": "__import__('os').system('true')",
    "eval": "eval(x)",
    "open": "open(x)",
    "an attribute": "x.__class__",
    "a subscript": "x[0]",
    "a text": "'x'",
    "bytes": "b'x'",
    "a formatted text": "f'{x}'",
    "a lambda": "(lambda: x)()",
    "a comprehension": "[x for x in y]",
    "a tuple": "x, y",
    "an assignment": "(z := x)",
    "a choice of Python": "x if y else 0",
    "a word": "True",
    "nothing": "None",
    "an ellipsis": "...",
    "a complex number": "1j",
    "await": "await x",
    "yield": "(yield x)",
    "stars": "fmax(*x)",
    "keywords": "fmax(x, y=1)",
    "a function of others": "fmax(x)",
    "a function as a number": "x + sin",
    "a call of a call": "sin(x)(y)",
    "two comparisons": "x < y < 1",
    "membership": "x in y",
    "identity": "x is y",
    "division without rest": "x // y",
    "rest": "x % y",
    "a matrix product": "x @ y",
    "bits": "x & y",
    "shift": "x << 1000000000",
    "inversion": "~x",
    "a statement": "import os",
    "two statements": "x; y",
    "no text": "",
    "a null": "x\0y",
    "a surrogate": "\ud800",
    "infinity": "1e999",
    "a number that ends in a word": "1and x",
    "many digits": "9" * 5_000,
    "a whole number beyond doubles": "9" * 400,
    "open brackets": "(" * 4_000,
    "brackets": "(" * 3_000 + "x" + ")" * 3_000,
    "signs": "-" * 7_000 + "x",
    "nots": "not " * 1_900 + "x",
    "a long sum": "x" + "+x" * 3_900,
    "towers": "x" + "**x" * 2_600,
    "a long text": "x+" * 100_000 + "x",
    "the table's own name": "_table + 1",
    "the table's other name": "made",
    "a class": "__class__",
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_text_is_refused_at_once(case: str) -> None:
    with Profile() as calls, pytest.raises(psa.InputError, match=PLACE) as caught:
        read(HOSTILE[case])
    assert sum(c.callcount for c in calls.getstats()) < 1_000  # of up to 200,001 letters
    assert all(len(p) < 700 for p in caught.value.problems)


def test_parts_cannot_grow_beyond_what_is_written() -> None:
    doubled = {"b0": "x"} | {f"b{k}": f"b{k - 1} * b{k - 1}" for k in range(1, 2_000)}
    assert read("b1999", **doubled).function.n_instructions() < 2_010
    assert value(read("b3", **doubled), 2.0, 0.0) == 2.0**8


@pytest.mark.parametrize("where", [{"b": "c", "c": "x"}, {"x": "y", "b": "x", "y": "1"}])
def test_parts_stand_in_the_order_of_their_dependence(where: dict[str, str]) -> None:
    with pytest.raises(psa.InputError, match="before it is defined"):
        read("b", **where)


def test_what_no_text_can_have_is_refused() -> None:
    with pytest.raises(psa.InputError, match="the constant inf"):
        texts_of(kept(ca.if_else(X < Y, X, ca.inf)))
    with pytest.raises(psa.InputError, match=r"'erfinv', which MODEL\.json does not have"):
        texts_of(kept(ca.erfinv(X)))


def test_no_symbol_of_a_text_is_a_name_of_the_table_of_symbols() -> None:
    for name in dir(OnDemand()):
        with pytest.raises(psa.InputError, match="no symbol has that name"):
            read(name)
