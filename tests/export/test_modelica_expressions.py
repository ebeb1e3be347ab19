import math
import re
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st

import psa_casadi as psa
from psa_casadi.export.modelica.expression import Graph, Printer
from psa_casadi.export.modelica.package import modelica_text
from tests.export.modelica_runs import pure_ode, read_back
from tests.tiers import slow

Build = Callable[[psa.Symbols], Any]

_UNARY = (
    ca.sqrt, ca.exp, ca.log, ca.sin, ca.cos, ca.tan, ca.atan, ca.sinh, ca.cosh, ca.tanh, ca.fabs,
    ca.sign, ca.logic_not, lambda x: -x, lambda x: x**2, lambda x: x**3, lambda x: 1 / x,
    lambda x: 2 * x, lambda x: (x**2 + 1) ** 0.3, lambda x: x**-2, lambda x: abs(x) ** 1.5,
)  # fmt: skip
_BINARY = (
    lambda x, y: x + y, lambda x, y: x - y, lambda x, y: x * y, lambda x, y: x / y,
    lambda x, y: abs(x) ** y, lambda x, y: -(x**2) * y, ca.fmin, ca.fmax, ca.atan2, ca.logic_and,
    ca.logic_or, lambda x, y: x < y, lambda x, y: x <= y, lambda x, y: x == y, lambda x, y: x != y,
)  # fmt: skip
_NAMES = ("alpha", "beta", "gamma")


def _symbol(name: str) -> Build:
    return lambda s: getattr(s, name)


def _constant(value: float) -> Build:
    return lambda s: ca.SX(value)


def _one(f: Any, x: Build) -> Build:
    return lambda s: f(x(s))


def _two(f: Any, x: Build, y: Build) -> Build:
    return lambda s: f(x(s), y(s))


def _choice(c: Build, x: Build, y: Build) -> Build:
    return lambda s: ca.if_else(c(s), x(s), y(s))


_LEAVES = st.one_of(
    st.sampled_from(_NAMES).map(_symbol),
    st.sampled_from((-2.0, -1.0, -0.5, 1e-24, 0.1, 0.5, 3.0, 1e7)).map(_constant),
)
_EXPRESSIONS = st.recursive(
    _LEAVES,
    lambda e: st.one_of(
        st.builds(_one, st.sampled_from(_UNARY), e),
        st.builds(_two, st.sampled_from(_BINARY), e, e),
        st.builds(_choice, e, e, e),
    ),
    max_leaves=12,
)


def _model(first: Build, second: Build) -> Any:
    """Three states whose rates hold the expressions, one of them twice."""
    states = tuple(psa.State(n, "1", n, 1.0) for n in _NAMES)
    return psa.compose(
        [
            psa.Component(
                "random",
                "random rates",
                "none",
                lambda s: psa.Equations(
                    der={
                        "alpha": first(s),
                        "beta": second(s) + s.alpha,
                        "gamma": first(s) * second(s) - s.beta,
                    }
                ),
                states=states,
            )
        ]
    )


def _as_numbers(source: str) -> str:
    """Keep rumoca from looking for events, which CasADi's form of a class cannot have."""
    return re.sub(r"(der\(\w+\)) = ([^;]*);", r"\1 = noEvent(\2);", source)


@slow
@settings(max_examples=200, deadline=None, derandomize=True)
@given(first=_EXPRESSIONS, second=_EXPRESSIONS, seed=st.integers(0, 1000))
def test_expressions_survive_being_written_and_read(first: Build, second: Build, seed: int) -> None:
    model = _model(first, second)
    try:
        text = modelica_text(model)
    except psa.InputError as error:
        if "cannot write" not in str(error):  # a constant such as log(-2) is folded to nan
            raise
        reject()
    read = read_back(_as_numbers(pure_ode(model, text)))
    draw = np.random.default_rng(seed)
    compared = 0
    for x in (draw.uniform(-3.0, 3.0, 3), draw.uniform(0.1, 2.0, 3), np.ones(3)):
        expected = np.array(model.structure.f(0.0, x, [], [])[0]).ravel()
        got = np.array(read.rhs(0.0, x, [], [])).ravel()
        there = np.isfinite(expected)  # outside its domain an expression may be anything
        np.testing.assert_allclose(got[there], expected[there], rtol=1e-12, atol=0.0)
        compared += int(there[:2].sum())
    assume(compared > 2)


@pytest.mark.parametrize(
    "function",
    [ca.log10, ca.log1p, ca.expm1, ca.asinh, lambda x: ca.hypot(x, 3.0), lambda x: ca.asin(x / 9)],
)
def test_functions_that_modelica_says_in_other_words(function: Any) -> None:
    model = _model(lambda s: function(s.alpha), lambda s: s.beta)
    read = read_back(pure_ode(model, modelica_text(model)))
    for value in (0.3, 1.0, 7.5):
        got = np.array(read.rhs(0.0, [value, 1.0, 1.0], [], [])).ravel()[0]
        assert got == pytest.approx(float(function(ca.DM(value))), rel=1e-14)


@pytest.mark.parametrize(
    ("function", "name"), [(ca.erf, "erf"), (lambda x: ca.fmod(x, 2.0), "fmod"),
                           (lambda x: ca.copysign(x, -x), "copysign")],
)  # fmt: skip
def test_a_function_that_modelica_lacks_is_refused_by_its_name(function: Any, name: str) -> None:
    model = _model(lambda s: function(s.alpha), lambda s: s.beta)
    with pytest.raises(psa.InputError, match=f"uses '{name}'"):
        modelica_text(model)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_constant_that_is_not_finite_is_refused(value: float) -> None:
    model = _model(lambda s: s.alpha * value, lambda s: s.beta)
    with pytest.raises(psa.InputError, match=r"constant (-?inf|nan), which Modelica cannot write"):
        modelica_text(model)


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (lambda a, b: a - (b - 2), "a - (b - 2)"),
        (lambda a, b: a * -b, "-a*b"),
        (lambda a, b: (-a) ** b, "(-a)^b"),
        (lambda a, b: a**-1.5, "a^(-1.5)"),
        (lambda a, b: (a**b) ** 2.5, "(a^b)^2.5"),
        (lambda a, b: a / (b / 3), "a/(b/3)"),
        (lambda a, b: ca.if_else(a < b, a, b), "(if a < b then a else b)"),
        (lambda a, b: ca.if_else(a == b, a, 1), "(if a <= b and a >= b then a else 1)"),
        (lambda a, b: -3 * a, "(-3)*a"),
        (lambda a, b: a + a, "2*a"),
        (lambda a, b: 1e-300 * a, "1e-300*a"),
    ],
)
def test_texts(build: Any, text: str) -> None:
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    graph = Graph()
    (node,) = graph.read([build(a, b)])
    assert Printer(graph, {"a": "a", "b": "b"}).definition(node) == text


def test_what_is_used_twice_does_not_make_the_text_grow_exponentially() -> None:
    def deep(s: psa.Symbols) -> Any:
        value = s.alpha
        for _ in range(60):
            value = ca.sin(value) * ca.cos(value) + 0.1 * value
        return value

    text = modelica_text(_model(deep, lambda s: s.beta))
    assert len(text) < 20_000
