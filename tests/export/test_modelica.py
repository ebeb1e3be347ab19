"""The Modelica package: its text, its refusals, its equations read back, a stack in a circuit."""

import difflib
import math
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, reject, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.modelica.expression import Graph, Printer
from psa_casadi.export.modelica.package import modelica_text, reciprocal
from tests.contract.helpers import done
from tests.export.modelica_runs import (
    STUB,
    load,
    model_named,
    pure_ode,
    read_back,
    right_side_error,
    signal_class,
    simulated,
    text_of,
)
from tests.tiers import slow, slow_but

_GOLDEN = Path(__file__).parent / "golden" / "P-885.51.mo"
_ACCEPT = "psa export modelica --stack P-885.51 -o tests/export/golden/P-885.51.mo"


def _without_version(text: str) -> list[str]:
    return re.sub(r"psa_casadi \d[\w.+]*", "psa_casadi", text).splitlines(keepends=True)


def test_the_package_is_the_one_that_was_accepted(tmp_path: Path) -> None:
    path = tmp_path / "PiezoStack.mo"
    words = done("export", "modelica", "--stack", "P-885.51", "-o", path).words
    assert "left out: sensor" in words
    assert "PiezoStack.Signal, PiezoStack.Acausal, PiezoStack.Examples.Sine" in words
    expected = _without_version(_GOLDEN.read_text(encoding="utf-8"))
    texts = _without_version(path.read_text(encoding="utf-8"))
    diff = "".join(difflib.unified_diff(expected, texts, "accepted", "now", n=1))
    assert not diff, f"{diff}\nIf this is meant: {_ACCEPT}"


def _decay(parameter: str = "rate", output: str = "measured", state: str = "z") -> psa.Component:
    return psa.Component(
        "decay", 'a "decay" \\ of <z>', "none",
        lambda s: psa.Equations(
            der={state: -getattr(s, parameter) * getattr(s, state) + s.pull},
            out={output: 2 * getattr(s, state)},
        ),
        parameters=(psa.Parameter(parameter, 2.0, "1/s", (0.0, float("inf")), "rate"),),
        states=(psa.State(state, "counts", "z", 1.0, start=1.0),),
        inputs=(psa.Input("pull", "counts/s", "pull", start=0.5),),
        outputs=(psa.Output(output, "counts", "twice z"),),
    )  # fmt: skip


def test_names_that_modelica_has_taken_are_changed_and_texts_escaped() -> None:
    text = modelica_text(psa.compose([_decay("model", "output", "der")], name="decay"))
    assert 'parameter Real model_2(unit="1/s", min=0.0) = 2.0 "rate";' in text
    assert "der(der_2) = pull - model_2*der_2;" in text
    assert "output_2 = 2*der_2;" in text
    assert 'input Real pull(unit="1/s", start=0.5, nominal=1.0)' in text
    assert 'decay: a "decay" \\ of <z>' in text  # in a comment
    assert 'a \\"decay\\" \\\\ of &lt;z&gt;' in text  # in the documentation
    assert (
        "Signal device(pull=0.5 + 0.5*height*(1 - cos(6.283185307179586*frequency*time)))" in text
    )
    assert "Acausal" not in text.split("annotation(Doc")[0]
    assert "uses(Modelica" not in text


@pytest.mark.parametrize("name", ["2stack", "model", "Piezo-Stack", ""])
def test_a_name_that_no_package_can_have_is_refused(name: str) -> None:
    with pytest.raises(psa.InputError, match="cannot name a Modelica package"):
        modelica_text(psa.stack_model("P-885.51"), name=name)


@pytest.mark.parametrize(("start", "rests"), [(0.0, True), (2.0, True), (1.0, False)])
def test_the_text_states_whether_the_states_rest_at_the_start(start: float, rests: bool) -> None:
    """x' = x (2 - x) rests at 0 and at 2."""
    x = ca.SX.sym("x")
    states = [psa.State("x", "1", "a population", 1.0, start=start)]
    model = psa.ode_model({"x": x, "ode": x * (2.0 - x)}, name="logistic", states=states)
    text = modelica_text(model)
    assert ("states start at rest." in text) == rests
    assert ("states start at their start values" in text) != rests


_WIRED = "PiezoStack.Examples.Wired"


def _value(text: str, part: str, name: str) -> float:
    """Return what the example gives a parameter of one of its parts."""
    example = text.split("model Wired")[1]
    result = example.split(f" {part}(")[1].split(f"{name}=")[1]
    return float(result.split(",")[0].split(")")[0])


def _by_hand(p: dict[str, float], text: str, t: FloatArray) -> FloatArray:
    """Return displacement, mass position and current, from equations written out here.

    The load's spring and damper pull at the stack's output, the bonding layers at the wafers.
    """
    amplitude, frequency = _value(text, "source", "V"), _value(text, "source", "f")
    c, d = _value(text, "springDamper", "c"), _value(text, "springDamper", "d")
    m = _value(text, "mass", "m")

    def current(time: float, u: float) -> float:
        source = amplitude * (1.0 - np.cos(2.0 * np.pi * frequency * time))
        return float(source - u) / p["R_s"]

    def rates(time: float, state: FloatArray) -> list[float]:
        u, f_H, f_out, y, v_y, x, v_x, s, v = state
        rate = current(time, u) / p["C_p"]
        sign = rate / np.hypot(rate, p["hold_rate"])
        power = (abs(f_H) / p["h_ref"]) ** p["n"]
        bend = p["beta"] * rate * sign * np.sign(f_H) * power + p["gamma"] * rate * power
        pull = p["c_B"] * (v_x - v_y) + p["k_B"] * (x - y)
        load = c * (s - x) + d * (v - v_x)
        return [
            rate,
            p["A"] * rate - bend + p["delta"] * u * sign,
            (p["k_L"] * u + f_H - f_out) / p["tau"],
            v_y,
            (f_out + pull - p["c_P"] * v_y - p["k_P"] * y) / p["m_P"],
            v_x,
            (load - pull) / p["m_B"],
            v,
            -load / m,
        ]

    size = np.array([100.0, 100.0, 1e3, 1e-5, 1e-2, 1e-5, 1e-2, 1e-5, 1e-2])
    span = (0.0, float(t[-1]))
    result = solve_ivp(rates, span, np.zeros(9), "Radau", t, rtol=1e-10, atol=1e-12 * size)
    drawn = np.array([current(time, u) for time, u in zip(t, result.y[0], strict=True)])
    return np.array([result.y[5], result.y[7], drawn])


@pytest.mark.parametrize("name", slow_but(["P-885.51"], ["P-885.51", "WYDS0808020"]))
def test_the_wired_example_follows_equations_written_by_hand(name: str) -> None:
    model = psa.stack_model(name)
    text = modelica_text(model)
    span = float(text.split("model Wired")[1].split("StopTime=")[1].split(",")[0])
    got = simulated(STUB + text, _WIRED, span, rtol=1e-10)
    t = got["time"]
    expected = _by_hand(dict(model.values), text, t)
    names = ("stack.displacement", "mass.s", "stack.current")
    for output, values in zip(names, expected, strict=True):
        assert np.abs(got[output] - values).max() < 1e-6 * np.ptp(values), output


@pytest.mark.parametrize(
    "name",
    slow_but(
        ["P-885.51", "slow_creep", "every_effect"], [*psa.STACKS, *psa.EFFECTS, "every_effect"]
    ),
)
def test_every_wired_example_is_a_balanced_system(name: str) -> None:
    structure = load(STUB + text_of(name), _WIRED).structure()
    assert structure.is_balanced
    assert structure.is_matched


def test_the_reaction_is_there_whatever_the_gain_of_the_model() -> None:
    assert "final parameter Real reciprocal_gain" in text_of("P-885.51")
    model = model_named("reciprocal_coupling")
    assert model.values["reciprocal_gain"] == 0.25
    signal, acausal = modelica_text(model).split("  model Acausal")
    assert "max=1.2) = 0.25" in signal
    assert "max=1.2) = 1.0" in acausal
    assert "reciprocal_gain = 1, action and reaction" in acausal


def test_a_stage_has_a_flange_to_be_pushed_at() -> None:
    """The stage between a spring to the ground and a prescribed position."""
    text = modelica_text(psa.compose([psa.COMPONENTS["flexure"]], name="flexure"), name="Stage")
    bench = Path(__file__).with_name("modelica_bench.mo").read_text("utf-8")
    got = simulated(STUB + text + bench, "Bench", 0.05, rtol=1e-10)
    contact = 5e7 * (got["mover.s"] - got["stage.x_f"]) + 500.0 * (1e-4 - got["stage.v_f"])
    np.testing.assert_allclose(got["stage.flange_a.f"], contact, rtol=1e-6, atol=1e-9)
    # slow motion: contact and flexure are springs in series, but for the damper's drag
    drag = 50.0 * got["stage.v_f"][-1]
    assert contact[-1] == pytest.approx(5e6 * got["stage.x_f"][-1] + drag, rel=1e-3)


def test_scaled_forces_give_the_free_stroke_of_the_cascade() -> None:
    """As the documentation of `Acausal` states its stroke."""
    model = psa.stack_model("P-885.51")
    p = model.values
    scale = (p["k_P"] + p["k_B"]) / p["k_B"]
    assert f"{1 / scale:.4g} times that of the cascade" in modelica_text(model)
    forces = ("k_L", "A", "beta", "gamma", "delta", "h_ref")
    scaled = reciprocal(model.with_values({n: scale * p[n] for n in forces}))
    t = np.linspace(0.0, 1.0, 101)
    u = np.column_stack([60.0 * np.minimum(2 * t, 1.0), np.zeros(101)])
    ends = [
        psa.run(m, t, u, np.zeros(len(m.state_names)), rtol=1e-9).x[-1, m.state_names.index("x")]
        for m in (model, scaled, reciprocal(model))
    ]
    assert ends[1] == pytest.approx(ends[0], rel=1e-6)
    assert ends[2] == pytest.approx(ends[0] / scale, rel=1e-6)


NAMES = [*psa.STACKS, *psa.EFFECTS, "every_effect"]


@pytest.mark.parametrize("name", slow_but([*list(psa.STACKS)[:1], *psa.EFFECTS], NAMES))
def test_right_hand_sides_read_back_are_the_models(name: str) -> None:
    assert right_side_error(model_named(name), text_of(name)) < 1e-12


def _signs() -> list[tuple[str, str, int]]:
    """Every plus and minus between two terms of the equations, turned into the other."""
    body = re.sub(r"//[^\n]*", "", signal_class(text_of("P-885.51")).split("  equation\n")[1])
    kept = body.replace(" + 1e-24", "")
    return [("+", "-", i) for i in range(kept.count(" + "))] + [
        ("-", "+", i) for i in range(len(re.findall(r"\s-\s", kept)))
    ]


@pytest.mark.parametrize(("old", "new", "count"), _signs())
def test_a_flipped_sign_is_caught(old: str, new: str, count: int) -> None:
    text = text_of("P-885.51")
    start = text.index("  equation\n")
    pattern = rf"(?<=\s){re.escape(old)}(?=\s(?!1e-24))"
    items = list(re.finditer(pattern, re.sub(r"//[^\n]*", lambda m: " " * len(m[0]), text[start:])))
    place = start + items[count].start()
    assert right_side_error(model_named("P-885.51"), text[:place] + new + text[place + 1 :]) > 1e-6


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


def _of(f: Any, *of: Build) -> Build:
    return lambda s: f(*(_inside(x(s)) for x in of))


def _inside(value: Any) -> Any:
    """Refuse a number that is none: what comes of it, such as a choice, may be anything."""
    if value.is_constant() and not np.isfinite(float(value)):
        raise FloatingPointError
    return value


_LEAVES = st.one_of(
    st.sampled_from(_NAMES).map(_symbol),
    st.sampled_from((-2.0, -1.0, -0.5, 1e-24, 0.1, 0.5, 3.0, 1e7)).map(_constant),
)
_EXPRESSIONS = st.recursive(
    _LEAVES,
    lambda e: st.one_of(
        st.builds(_of, st.sampled_from(_UNARY), e),
        st.builds(_of, st.sampled_from(_BINARY), e, e),
        st.builds(_of, st.just(ca.if_else), e, e, e),
    ),
    max_leaves=12,
)


def _model(first: Build, second: Build) -> Any:
    """Three states whose rates hold the expressions, one of them twice."""
    states = tuple(psa.State(n, "1", n, 1.0) for n in _NAMES)

    def equations(s: psa.Symbols) -> psa.Equations:
        rates = (first(s), second(s) + s.alpha, first(s) * second(s) - s.beta)
        return psa.Equations(der=dict(zip(_NAMES, rates, strict=True)))

    return psa.compose([psa.Component("random", "random rates", "none", equations, states=states)])


def _with(function: Any) -> Any:
    """Return a model with a function of its first state."""
    return _model(lambda s: function(s.alpha), lambda s: s.beta)


def _as_numbers(source: str) -> str:
    """Keep rumoca from looking for events, which CasADi's form of a class cannot have."""
    return re.sub(r"(der\(\w+\)) = ([^;]*);", r"\1 = noEvent(\2);", source)


@slow
@settings(max_examples=200, deadline=None, derandomize=True)
@given(first=_EXPRESSIONS, second=_EXPRESSIONS, seed=st.integers(0, 1000))
def test_expressions_survive_being_written_and_read(first: Build, second: Build, seed: int) -> None:
    try:
        model = _model(first, second)
        text = modelica_text(model)
    except FloatingPointError:  # a constant such as log(-2)
        reject()
    except psa.InputError as error:
        if "cannot write" not in str(error):  # the same, as the outermost
            raise
        reject()
    read = read_back(_as_numbers(pure_ode(model, text)))
    draw = np.random.default_rng(seed)
    compared = 0
    for x in (draw.uniform(-3.0, 3.0, 3), draw.uniform(0.1, 2.0, 3), np.ones(3)):
        at: Any = SimpleNamespace(**{n: ca.SX(v) for n, v in zip(_NAMES, x, strict=True)})
        try:
            _of(ca.plus, first, second)(at)
        except FloatingPointError:
            continue  # outside its domain an expression may be anything
        expected = np.array(model.structure.f(0.0, x, [], [])[0]).ravel()
        got = np.array(read.rhs(0.0, x, [], [])).ravel()
        there = np.isfinite(expected)
        np.testing.assert_allclose(got[there], expected[there], rtol=1e-12, atol=0.0)
        compared += int(there[:2].sum())
    assume(compared > 2)


@pytest.mark.parametrize(
    "function",
    [ca.log10, ca.log1p, ca.expm1, ca.asinh, lambda x: ca.hypot(x, 3.0), lambda x: ca.asin(x / 9)],
)
def test_functions_that_modelica_writes_otherwise(function: Any) -> None:
    model = _with(function)
    read = read_back(pure_ode(model, modelica_text(model)))
    for value in (0.3, 1.0, 7.5):
        got = np.array(read.rhs(0.0, [value, 1.0, 1.0], [], [])).ravel()[0]
        assert got == pytest.approx(float(function(ca.DM(value))), rel=1e-14)


def _endless(start: float) -> psa.Model:
    states = (psa.State("z", "1", "z", 1.0, start=start),)
    endless = psa.Component(
        "endless", "no start", "none", lambda s: psa.Equations(der={"z": -s.z}), states=states
    )
    return psa.compose([endless])


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: psa.compose([_decay(output="z")]), "named 'z', which Modelica does not allow"),
        (lambda: psa.compose([*psa.BASE, _decay(output="tip_force")]),
         "output 'tip_force' of 'psa' differs from the balance"),
        (lambda: _endless(math.inf), "start of state 'z' is inf, which Modelica cannot write"),
        (lambda: _with(ca.erf), "uses 'erf'"),
        (lambda: _with(lambda x: ca.fmod(x, 2.0)), "uses 'fmod'"),
        (lambda: _with(lambda x: ca.copysign(x, -x)), "uses 'copysign'"),
        (lambda: _with(lambda x: x * math.inf), "constant inf, which Modelica cannot write"),
        (lambda: _with(lambda x: x * -math.inf), "constant -inf, which Modelica cannot write"),
        (lambda: _with(lambda x: x * math.nan), "constant nan, which Modelica cannot write"),
    ],
)  # fmt: skip
def test_what_modelica_cannot_hold_is_refused(
    make: Callable[[], psa.Model], match: str, tmp_path: Path
) -> None:
    with pytest.raises(psa.InputError, match=match):
        psa.export_modelica(make(), tmp_path / "x.mo")
    assert not list(tmp_path.iterdir())


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
