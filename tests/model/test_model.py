"""Composition, values, and MODEL.json; components that no table has, and hostile files."""

import json
from collections.abc import Callable
from cProfile import Profile
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.diagnosis.generic import effects_of, extended
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.evidence import Evidence
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.ports import ports_of, with_ports
from psa_casadi.model.variables import Interval, nominal_value
from psa_casadi.records.split import divided
from psa_casadi.simulation.sizes import Sizes
from tests.any_model.own_models import cylinder, motor, oscillator, oven, pair, tanks
from tests.export.fmu_models import model_named
from tests.model.evidence_models import NOISE, OFFSET, evident_model, noisy_record
from tests.model.sampled_models import loop

CREEP, DRIFT = psa.EFFECTS["slow_creep"], psa.EFFECTS["offset_drift"]


def component(equations: Callable[[psa.Symbols], psa.Equations], **declared: Any) -> psa.Component:
    return psa.Component("extra", "for a test", "none", equations, **declared)


def message(build: Callable[[], object]) -> str:
    with pytest.raises(psa.InputError) as caught:
        build()
    return str(caught.value)


def gain_of(name: str, value: float = 0.0) -> psa.Parameter:
    return psa.Parameter(name, value, "1", (0.0, 1.0), "a gain")


def test_a_loop_of_balances_is_named() -> None:
    loop = component(lambda s: psa.Equations(add={"drive_voltage": 0.1 * s.stack_current}))
    text = message(lambda: psa.compose((*psa.BASE, loop)))
    loop_names = text.split(":")[1].split(";")[0].strip().split(" -> ")
    assert loop_names[0] == loop_names[-1]
    assert set(loop_names) == {"drive_voltage", "drive_current", "stack_current"}
    itself = component(lambda s: psa.Equations(add={"tip_force": 2 * s.tip_force}))
    assert "tip_force -> tip_force;" in message(lambda: psa.compose((*psa.BASE, itself)))


def test_a_component_gives_what_it_declares_and_nothing_else() -> None:
    state = psa.State("z", "m", "a state", 1.0)
    bare = component(
        lambda _: psa.Equations(), states=(state,), outputs=(psa.Output("w", "m", "an output"),)
    )
    text = message(lambda: psa.compose((*psa.BASE, bare)))
    assert "lacks the derivative of the state 'z'" in text
    assert "lacks the equation of the output 'w'" in text
    foreign = component(lambda s: psa.Equations(der={"x": s.v_x}, out={"displacement": s.x}))
    text = message(lambda: psa.compose((*psa.BASE, foreign)))
    assert "derivative of the state 'x', which it does not declare" in text
    assert "equation of the output 'displacement', which it does not declare" in text
    nowhere = component(lambda s: psa.Equations(add={"weight": s.x}))
    assert "adds to 'weight', which is no balance" in message(
        lambda: psa.compose((*psa.BASE, nowhere))
    )


@pytest.mark.parametrize("name", ["k_L", "x", "voltage"])
def test_a_name_belongs_to_one_component(name: str) -> None:
    twice = component(lambda _: psa.Equations(), parameters=(gain_of(name),))
    assert f"Two components declare '{name}'" in message(lambda: psa.compose((*psa.BASE, twice)))


def test_every_bad_value_is_named_at_once() -> None:
    text = message(lambda: psa.compose(psa.BASE, {"k_l": 1.0, "n": 0.5, "m_P": float("nan")}))
    assert "no parameter 'k_l'" in text
    assert "'n' is 0.5 1, outside its bounds [1, 4]" in text
    assert "'m_P' is nan" in text
    model = psa.compose(psa.BASE)
    assert "'tau' is -1 s" in message(lambda: model.with_values({"tau": -1.0}))
    assert "no parameter 'creep_gain'" in message(lambda: model.with_values({"creep_gain": 0.1}))
    assert "no parameter 'tua'" in message(lambda: model.parameter("tua"))
    assert model.with_values({"tau": 2e-4}).values["tau"] == 2e-4
    assert model.values["tau"] == 1e-4


def test_effects_come_and_go_without_a_trace() -> None:
    base = psa.compose(psa.BASE, {"k_L": 12.0})
    extended = base.with_effect(CREEP, {"creep_gain": 0.02}).with_effect(DRIFT)
    assert [e.name for e in extended.effects] == ["slow_creep", "offset_drift"]
    assert extended.values["k_L"] == 12.0
    assert extended.values["drift_rate"] == 0.0
    again = extended.with_effect(CREEP, {"creep_gain": 0.03})
    assert again.structure is extended.structure
    assert (again.values["creep_gain"], extended.values["creep_gain"]) == (0.03, 0.02)
    back = extended.without(["slow_creep", "offset_drift"])
    assert back.structure is base.structure
    assert back.values == base.values


def evidence_in(model: psa.Model) -> Evidence:
    assert model.evidence is not None
    return model.evidence


def test_it_has_the_ranges_of_the_record_and_the_errors_of_the_model() -> None:
    record, evidence = noisy_record(), evidence_in(evident_model())
    rates = np.abs(np.diff(record.voltage) / np.diff(record.time))
    ranges = evidence.seen
    assert ranges.voltage == Interval(record.voltage.min(), record.voltage.max())
    assert ranges.rate == pytest.approx(rates.max())
    assert ranges.duration == record.duration
    assert ranges.temperature is None
    held = evidence.held_out
    assert held is not None
    assert held.interval_m.low < NOISE < held.interval_m.high
    assert held.rms_m == pytest.approx(NOISE, rel=0.15)
    (played,) = evidence.runs
    assert (played.sha256, played.samples, played.averaged) == (record.sha256, 640, 1)
    assert played.offset_m == pytest.approx(OFFSET, abs=1e-8)
    (split,) = divided([record], ())
    held_out = [k for first, stop in played.held_out for k in range(first, stop)]
    assert held_out == np.flatnonzero(split.held_out).tolist()


def test_the_covariance_is_that_of_the_intervals() -> None:
    model = evident_model()
    covariance, known = evidence_in(model).covariance, model.provenance.intervals
    assert covariance.names == ("k_L", "A", "tau")
    for k, name in enumerate(covariance.names):
        half = 0.5 * (known[name].high - known[name].low)
        assert 1.96 * covariance.matrix[k][k] ** 0.5 == pytest.approx(half, rel=0.02), name


def test_other_values_or_physics_have_no_evidence() -> None:
    model = evident_model()
    same = model.with_values({"k_L": model.values["k_L"]})
    assert same.evidence is model.evidence
    assert model.with_values({"k_L": 1.01 * model.values["k_L"]}).evidence is None
    assert model.with_effect(psa.EFFECTS["slow_creep"]).evidence is None
    assert model.without(["creep_lag"]).evidence is None
    assert model.with_starts({"u": 1.0}).evidence is model.evidence


def test_a_plant_keeps_it_with_the_covariance_of_its_parameters() -> None:
    model = evident_model()
    drift = psa.EFFECTS["offset_drift"]
    gain = drift.gain or ""
    evidence = evidence_in(model)
    names = ("k_L", gain)
    wider = replace(evidence.covariance, names=names, matrix=((4.0, 1.0), (1.0, 9.0)))
    both = replace(
        model.with_effect(drift),
        evidence=replace(evidence, covariance=wider, outside=(drift.name,)),
    )
    plant = loads(dumps(both)).plant()
    assert evidence_in(plant).covariance.names == ("k_L",)
    assert evidence_in(plant).covariance.matrix == ((4.0,),)
    assert loads(dumps(plant)).evidence == plant.evidence


USER_MODELS = {f.__name__: f for f in (oscillator, motor, tanks, pair, cylinder, oven)}


def again(model: Model) -> Model:
    """Return a model as it comes back from its file, which is the same when written again."""
    text = dumps(model)
    content = loads(text)
    assert dumps(content) == text
    return content


def assert_computes_the_same(model: Model, other: Model, rtol: float = 1e-13) -> None:
    """Rates, outputs, switches and next values at random points are equal to rounding."""
    s, o = model.structure, other.structure
    assert list(s.switches) == list(o.switches)
    functions = [
        ca.Function("all", q.arguments, [q.xdot, q.y, q.znext, ca.vertcat(*q.switches.values())])
        for q in (s, o)
    ]
    draw = np.random.default_rng(4)
    p = model.parameter_vector()
    for _ in range(10):
        x = model.state_nominals() * draw.normal(size=len(s.states))
        u = draw.normal(size=len(s.inputs)) * [
            nominal_value(i.nominal, model.values) for i in s.inputs
        ]
        z = [draw.normal(size=len(s.sampled))] if s.sampled else []
        moved = p * draw.uniform(0.9, 1.1, len(p))
        for a, b in zip(*(f(0.3, x, u, moved, *z) for f in functions), strict=True):
            size = max(1.0, float(np.nanmax(np.abs(np.array(a)), initial=0.0)))
            np.testing.assert_allclose(np.array(b), np.array(a), rtol=rtol, atol=1e-15 * size)


@pytest.mark.parametrize("name", USER_MODELS)
@pytest.mark.parametrize("ported", [False, True])
def test_a_user_model_comes_back_exactly(name: str, ported: bool) -> None:
    model = with_ports(USER_MODELS[name]()) if ported else USER_MODELS[name]()
    result = again(model)
    assert dict(result.values) == dict(model.values)
    for kind in ("parameters", "states", "inputs", "outputs"):
        assert getattr(result.structure, kind) == getattr(model.structure, kind)
    assert ports_of(result) == ports_of(model)
    assert result.structure.balance_table == model.structure.balance_table
    assert_computes_the_same(model, result)


@pytest.mark.parametrize("name", USER_MODELS)
def test_every_effect_at_a_port_comes_back_exactly(name: str) -> None:
    model = USER_MODELS[name]()
    ones = dict.fromkeys((*model.input_names, *model.state_names, *model.output_names), 1.0)
    effects = effects_of(model, Sizes(ones, ones, sample=1e-3, duration=1.0))
    assert len(effects) > 10
    whole = extended(model, effects)
    draw = np.random.default_rng(5)
    gains = {
        str(c.gain): float(np.clip(draw.uniform(0.1, 1.0), *whole.parameter(str(c.gain)).bounds))
        for c in whole.effects
    }
    whole = whole.with_values(gains)
    result = again(whole)
    for mine, its in zip(whole.effects, result.effects, strict=True):
        for field in ("name", "description", "source", "gain", "linear", "belongs_to", "looks_like",
                      "equation_text", "parameters", "states"):  # fmt: skip
            assert getattr(its, field) == getattr(mine, field), (mine.name, field)
    assert_computes_the_same(whole, result)
    assert result.plant().output_names == whole.plant().output_names


def test_every_component_of_the_package_could_be_written_with_its_equations() -> None:
    """Copies, which no table has: the texts hold all physics of a stack and its effects."""
    model = model_named("every_effect")
    copies = compose([replace(c) for c in model.components], model.values, name="copies")
    content = loads(dumps(copies))
    assert set(json.loads(dumps(copies))["own"]) == {c.name for c in model.components}
    assert_computes_the_same(model, content, rtol=1e-12)


def test_a_connected_system_with_sampled_parts_comes_back() -> None:
    model = loop()
    result = again(model)
    assert result.structure.period == model.structure.period
    assert_computes_the_same(model, result)


def test_user_components_join_those_of_the_package() -> None:
    component = psa.Component(
        "pull", "a spring at the tip", "test", gain="k_pull",
        equations=lambda s: psa.Equations(add={"tip_force": -s.k_pull * s.tip_displacement}),
        parameters=(psa.Parameter("k_pull", 0.0, "N/m", (0.0, 1e9), "k", scale=1e6),),
    )  # fmt: skip
    model = psa.stack_model("demo").with_effect(component, {"k_pull": 2e6 / 3.0})
    result = again(model)
    content = json.loads(dumps(model))
    assert list(content["own"]) == ["pull"]
    assert content["own"]["pull"]["equations"] == {
        "add": {"tip_force": "-(k_pull * tip_displacement)"}
    }
    assert [c for c in result.components if c.name != "pull"] == list(model.components[:-1])
    assert_computes_the_same(model, result)


def test_starts_bounds_and_usual_sizes_come_back() -> None:
    x, a = ca.SX.sym("x"), ca.SX.sym("a")
    model = psa.ode_model(
        {"x": x, "p": a, "ode": -a * x}, name="decay",
        states=[psa.State("x", "m", "place", lambda v: 3.0 * v["a"], 0.25, memory=True)],
        parameters=[psa.Parameter("a", 2.0, "1/s", (0.5, np.inf), "rate", "1/min", log=True)],
    ).with_starts({"x": 1.0 / 3.0})  # fmt: skip
    result = again(model)
    assert result.changed_starts() == {"x": 1.0 / 3.0}
    assert result.parameter("a") == model.parameter("a")
    (state,) = result.structure.states
    assert (state.nominal, state.memory, state.settles) == (6.0, True, True)


def test_two_components_of_one_name_are_not_saved() -> None:
    one = psa.Component("twin", "", "", lambda s: psa.Equations())
    with pytest.raises(psa.InputError, match="2 components are named 'twin'"):
        dumps(compose([one, replace(one)]))


def test_what_could_not_be_read_again_is_not_saved() -> None:
    x = ca.SX.sym("x", 1_001)
    with pytest.raises(
        psa.InputError, match=r"cannot be saved as MODEL\.json: its user-defined components"
    ):
        dumps(psa.ode_model({"x": x, "ode": -x, "y": x}, name="many"))


def entry(content: dict[str, Any]) -> dict[str, Any]:
    table: dict[str, Any] = content["own"]["motor"]
    return table


HOSTILE: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "code": (
        lambda m: entry(m)["equations"]["der"].update(current="().__class__.__base__"),
        "'own.motor.equations.der.current' has a Python Attribute",
    ),
    "no text": (lambda m: entry(m)["equations"]["der"].update(current=3), "give a text"),
    "no equations": (lambda m: entry(m).pop("equations"), "lacks the derivative of the state"),
    "a state that is none": (
        lambda m: entry(m)["equations"]["der"].update(z="1"), "the state 'z', which it does not",
    ),
    "a symbol that is none": (
        lambda m: entry(m)["equations"]["der"].update(current="z"), "no symbol named 'z'",
    ),
    "a balance that is none": (
        lambda m: entry(m)["equations"].update(add={"z": "1"}), "adds to 'z', which is no balance",
    ),
    "a loop": (
        lambda m: entry(m)["equations"].update(add={"tip_force": "tip_force"}), "form a loop",
    ),
    "a name": (lambda m: entry(m)["states"][0].update(name="<b>"), "'<b>' cannot name a variable"),
    "a name of the file": (
        lambda m: m["own"].update({"../x": m["own"].pop("motor")}), "'../x' cannot name a variable",
    ),
    "a unit": (lambda m: entry(m)["states"][0].update(unit="furlang"), "furlang"),
    "a name twice": (
        lambda m: entry(m)["states"].append(dict(entry(m)["states"][0])), "declare 'current'",
    ),
    "a port": (
        lambda m: entry(m).update(ports=[{"kind": "rate", "variable": "z", "unit": "1/s"}]),
        "the rate of z, which it does not have",
    ),
    "a gain": (lambda m: entry(m).update(gain="z"), "'z' is a gain or linear, and no parameter"),
    "a place": (lambda m: entry(m).update(belongs_to="nowhere"), "give one of 'plant', 'drive'"),
    "no equation at a port": (
        lambda m: entry(m)["equations"].update(out={})
        or entry(m).update(ports=[{"kind": "output", "variable": "w", "unit": "rad/s"}]),
        "lacks the equation of the output 'w'",
    ),
    "no word": (lambda m: entry(m).update(belongs_to={}), "give one of 'plant', 'drive'"),
    "a size": (lambda m: entry(m)["states"][0].update(nominal=None), "give a number"),
    "bounds": (lambda m: entry(m)["parameters"][0].update(bounds=[5, 1]), "are reversed"),
    "too much": (
        lambda m: entry(m).update(states=entry(m)["states"] * 2_000),
        "have 4007 variables, of which",
    ),
    "too many expressions": (
        lambda m: entry(m)["equations"].update(where={f"c{k}": "x" for k in range(20_000)}),
        "have 20004 expressions",
    ),
    "too long": (
        lambda m: entry(m)["equations"].update(where={f"c{k}": "x + " * 999 for k in range(200)}),
        "characters of equations, of which a file holds 500000",
    ),
    "not named": (lambda m: m.update(own={}), "unknown name 'motor'"),
    "a sample period": (lambda m: entry(m).update(sample_period="z"), "sample period"),
    "an FMU": (
        lambda m: entry(m).update(fmu={"file": "x.fmu", "sha256": ""}), "is not opened from here",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_a_mistake_in_a_user_component_is_named(case: str) -> None:
    change, problem = HOSTILE[case]
    content = json.loads(dumps(motor()))
    change(content)
    with Profile() as calls, pytest.raises(psa.InputError, match=r"m\.json") as caught:
        loads(json.dumps(content), "m.json")
    assert problem in str(caught.value)
    assert sum(c.callcount for c in calls.getstats()) < 3_000_000  # half of it: the units
