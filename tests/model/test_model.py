"""Composition, values, and MODEL.json."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.model_file import dumps, load_model, loads, save_model
from psa_casadi.simulation.simulate import input_samples
from psa_casadi.simulation.stepper import run
from psa_casadi.variables import Interval, Output, Parameter, Provenance, State
from tests.model.random_models import random_model
from tests.tiers import slow_but

CREEP, DRIFT = EFFECTS["slow_creep"], EFFECTS["offset_drift"]
SETS = {"base": BASE, "simplified": SIMPLIFIED, "all": (*BASE, *EFFECTS.values())}


def component(equations: Callable[[Symbols], Equations], **declared: Any) -> Component:
    return Component("extra", "for a test", "none", equations, **declared)


def message(build: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        build()
    return str(caught.value)


def gain_of(name: str, value: float = 0.0) -> Parameter:
    return Parameter(name, value, "1", (0.0, 1.0), "a gain")


def test_a_loop_of_balances_is_named() -> None:
    loop = component(lambda s: Equations(add={"drive_voltage": 0.1 * s.stack_current}))
    text = message(lambda: compose((*BASE, loop)))
    loop_names = text.split(":")[1].split(";")[0].strip().split(" -> ")
    assert loop_names[0] == loop_names[-1]
    assert set(loop_names) == {"drive_voltage", "drive_current", "stack_current"}
    own = component(lambda s: Equations(add={"tip_force": 2 * s.tip_force}))
    assert "tip_force -> tip_force;" in message(lambda: compose((*BASE, own)))


def test_a_component_gives_what_it_declares_and_nothing_else() -> None:
    state = State("z", "m", "a state", 1.0)
    bare = component(
        lambda _: Equations(), states=(state,), outputs=(Output("w", "m", "an output"),)
    )
    text = message(lambda: compose((*BASE, bare)))
    assert "lacks the derivative of the state 'z'" in text
    assert "lacks the equation of the output 'w'" in text
    foreign = component(lambda s: Equations(der={"x": s.v_x}, out={"displacement": s.x}))
    text = message(lambda: compose((*BASE, foreign)))
    assert "derivative of the state 'x', which it does not declare" in text
    assert "equation of the output 'displacement', which it does not declare" in text
    nowhere = component(lambda s: Equations(add={"weight": s.x}))
    assert "adds to 'weight', which is no balance" in message(lambda: compose((*BASE, nowhere)))


@pytest.mark.parametrize("name", ["k_L", "x", "voltage"])
def test_a_name_belongs_to_one_component(name: str) -> None:
    twice = component(lambda _: Equations(), parameters=(gain_of(name),))
    assert f"Two components declare '{name}'" in message(lambda: compose((*BASE, twice)))


def test_every_bad_value_is_named_at_once() -> None:
    text = message(lambda: compose(BASE, {"k_l": 1.0, "n": 0.5, "m_P": float("nan")}))
    assert "no parameter 'k_l'" in text
    assert "'n' is 0.5 1, outside its bounds [1, 4]" in text
    assert "'m_P' is nan" in text
    model = compose(BASE)
    assert "'tau' is -1 s" in message(lambda: model.with_values({"tau": -1.0}))
    assert "no parameter 'creep_gain'" in message(lambda: model.with_values({"creep_gain": 0.1}))
    assert "no parameter 'tua'" in message(lambda: model.parameter("tua"))
    assert model.with_values({"tau": 2e-4}).values["tau"] == 2e-4
    assert model.values["tau"] == 1e-4


def test_effects_come_and_go_without_a_trace() -> None:
    base = compose(BASE, {"k_L": 12.0})
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


@pytest.mark.parametrize("name", slow_but([n for n in SETS if n != "all"], SETS))
def test_velocity_is_the_rate_of_the_displacement(name: str) -> None:
    model = compose(SETS[name])
    gains = {"creep_gain": 0.05, "mode_gain": 0.2}
    model = model.with_values({k: v for k, v in gains.items() if k in model.values})
    t = np.linspace(0.0, 2e-3, 4001)
    given = {"voltage": 50.0 * (1.0 - np.cos(4e3 * t)), "load_force": 20.0 * np.sin(3e3 * t)}
    u = input_samples(model, len(t), given)
    y = run(model, t, u, np.zeros(len(model.state_names)), rtol=1e-9).y
    x, v = (y[:, model.output_names.index(n)] for n in ("displacement", "velocity"))
    slope = (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12 * 5e-7)
    assert np.ptp(x) > 5e-6
    np.testing.assert_allclose(slope[5:], v[7:-2], rtol=0, atol=1e-6 * np.ptp(v))


def identified(components: tuple[Component, ...] = SETS["all"]) -> Model:
    """A model with awkward values in every field of its file."""
    model = random_model(components[len(BASE) :], np.random.default_rng(7), gains=True)
    names = model.parameter_names
    origin = Provenance(
        identified_from=(("minor loops, µm.csv", "0f" * 32), ('a "b".csv', "1e" * 32)),
        package_version="0.1.0",
        free=(names[4], names[6], names[-1]),
        intervals={names[4]: Interval(-1 / 3, 2 / 3), names[-1]: Interval(-1e-300, 5e-324)},
        force_scale="given",
        notes=("the stiffness is the data sheet's", "k_P: 480 N/µm"),
    )
    return replace(model, name="stage", description="Spannung → Weg", provenance=origin)


@pytest.mark.parametrize("components", [SETS["base"], SETS["all"]], ids=["base", "all"])
def test_model_file_round_trip_is_exact(components: tuple[Component, ...], tmp_path: Path) -> None:
    model = identified(components)
    path = tmp_path / "MODEL.json"
    save_model(model, path)
    read = load_model(path)
    assert read.structure is model.structure
    assert dict(read.values) == dict(model.values)
    assert (read.name, read.description) == (model.name, model.description)
    assert read.provenance == model.provenance
    assert dumps(read) == path.read_text(encoding="utf-8") == dumps(model)


def changed(change: Callable[[dict[str, Any]], object]) -> str:
    content = json.loads(dumps(identified()))
    change(content)
    return message(lambda: loads(json.dumps(content), "m.json"))


def test_each_mistake_in_a_file_is_named() -> None:
    parameters = "parameters"
    cases: dict[str, Callable[[dict[str, Any]], object]] = {
        "its format is 'x/2', expected 'psa_casadi.model/1'": lambda c: c.update(format="x/2"),
        "'components' is missing": lambda c: c.pop("components"),
        "unknown name 'engine' in components": lambda c: c["components"].append("engine"),
        "'effects[27]' is [1]": lambda c: c["effects"].append([1]),
        "unknown name 'slow_creep' in components": lambda c: c["components"].append("slow_creep"),
        "'linear_force' is listed 2 times": lambda c: c["components"].append("linear_force"),
        "'parameters' is missing": lambda c: c.pop(parameters),
        "parameter 'k_L' [N/V] has no value": lambda c: c[parameters].pop("k_L"),
        "'parameters.tau.value' is 'fast'": lambda c: c[parameters]["tau"].update(value="fast"),
        "'parameters.m_P.value' is True": lambda c: c[parameters]["m_P"].update(value=True),
        "'tau' is given in 'ms'; convert it to 's'": lambda c: c[parameters]["tau"].update(
            unit="ms"
        ),
        "'n' is 17 1, outside its bounds": lambda c: c[parameters]["n"].update(value=17),
        "NaN is no number": lambda c: c[parameters]["n"].update(value=float("nan")),
        "unknown parameters ['warp']": lambda c: c[parameters].update(warp={"value": 1}),
        "'parameters.n.interval' is [1]": lambda c: c[parameters]["n"].update(interval=[1]),
        "'identified_from[0].sha256' is missing": lambda c: c.update(
            identified_from=[{"record": "a"}]
        ),
        "'notes' is 'one'": lambda c: c.update(notes="one"),
        "'name' is 3": lambda c: c.update(name=3),
        "'u'": lambda c: c["components"].remove("drive") or [
            c[parameters].pop(n) for n in ("G", "R_s", "C_p", "u_rated")
        ],
    }  # fmt: skip
    for expected, change in cases.items():
        text = changed(change)
        assert expected in text, text
        assert all(line.startswith("m.json") for line in text.splitlines())


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '"x"', "null"])
def test_what_is_no_model_file_says_so(text: str) -> None:
    assert message(lambda: loads(text, "m.json")).startswith("m.json is not ")


def test_a_file_that_cannot_be_read_says_so(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    assert "cannot be read" in message(lambda: load_model(path))
    path.write_bytes(b"\xff\xfe\x00")
    assert "cannot be read" in message(lambda: load_model(path))
