"""Intermediates and parameters as ports: forces between bodies, formulas, parameters that vary."""

import json
import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from fmpy import simulate_fmu

import psa_casadi as psa
from psa_casadi.model.ports import (
    is_place,
    kinematic,
    ports_of,
    seen_by,
    variables_at,
    with_ports,
)
from tests.any_model import hard_plants as hard


@pytest.mark.slow
def test_a_force_between_two_bodies_is_named_at_the_force_with_its_values() -> None:
    model, record, truth = hard.hardening()
    d = psa.diagnose(model, record, hold="linear", leave_out=["hysteresis"])
    assert [c.effect for c in d.causes] == ["curve_of_stretch_in_spring"]
    assert d.causes[0].port == "the intermediate spring"
    values, name = d.model.values, "curve_of_stretch_in_spring"
    cubic = values[f"{name}_size"] * np.sin(values[f"{name}_angle"]) / values[f"{name}_range"] ** 3
    assert -cubic == pytest.approx(1.2e6, rel=0.02) or cubic == pytest.approx(1.2e6, rel=0.02)
    for n, v in truth.items():
        assert values[n] == pytest.approx(v, rel=0.01)
    assert all(e.extended < 1.1 * e.noise < 0.05 * e.base for e in d.errors)


def test_the_places_of_intermediates() -> None:
    """A definition has no port, and what only adds to one rate has none besides that rate's."""
    model = hard.two_bodies()
    ports = {p.variable: p for p in ports_of(model)}
    assert {n for n, p in ports.items() if p.kind == "intermediate"} == {"spring", "held"}
    component = model.components[0]
    assert dict(kinematic(component)) == {
        "stretch": {"x1": 1.0, "x2": -1.0},
        "slip": {"v1": 1.0, "v2": -1.0},
    }  # fmt: skip
    assert is_place(model, ports["spring"])
    assert not is_place(model, ports["held"])
    assert seen_by(model, ports["spring"]) == ("stretch", "slip")
    assert seen_by(model, ports["v2"]) == ("v2", "stretch", "slip")
    assert variables_at(model, ports["spring"]) == ("stretch", "slip", "x1", "v1")
    assert variables_at(model, ports["y1"]) == ("y1",)
    opened = with_ports(model)
    at = 0.0, [0.1, 0.2, -0.3, 0.4], [1.5], model.parameter_vector()
    assert ports_of(opened) == ports_of(model)
    for plain, same in zip(model.structure.f(*at), opened.structure.f(*at), strict=True):
        np.testing.assert_allclose(np.array(same), np.array(plain), rtol=1e-15)


@pytest.mark.slow
def test_a_law_that_no_effect_of_the_table_has_is_reported_as_a_formula(tmp_path: Path) -> None:
    model, record, truth = hard.grazing(0)
    without = ("hysteresis", "change", "loss", "curve", "stop", "saturation", "bend", "drag")
    more = ("friction", "delay", "lag", "dead_zone", "drift", "constant")
    d = psa.diagnose(model, record, hold="linear", leave_out=[*without, *more], starts=3)
    law = d.correction
    assert law is not None
    assert not d.causes
    assert re.fullmatch(r"eaten is divided by 1 \+ [\d.]+ \|x\|", law.equation)
    (h,) = law.parameters.values()
    assert h.value == pytest.approx(0.02, rel=0.03)
    assert h.interval[0] < 0.02 < h.interval[1]
    assert law.held[0] < 0.8 * d.errors[0].base
    assert law.equation in " ".join(str(d).split())
    assert json.loads(d.to_json())["correction"]["parameters"].keys() == law.parameters.keys()
    patched = psa.patched_model(d)
    for n, v in truth.items():
        assert patched.values[n] == pytest.approx(v, rel=0.02)
    psa.save_model(patched, tmp_path / "law.json")
    psa.export_fmu(psa.load_model(tmp_path / "law.json"), tmp_path / "law.fmu")
    t = record["time"]
    u = np.array(
        [*zip(t, record["light"], record["harvest"], strict=True)],
        dtype=[(n, float) for n in ("time", "light", "harvest")],
    )
    ran = simulate_fmu(
        str(tmp_path / "law.fmu"), stop_time=t[-1], output_interval=0.05, input=u,
        start_values={"x": 45.0, "y": 15.0},
    )  # fmt: skip
    assert np.std(ran["prey"] - record["prey"]) < 0.03 * np.ptp(record["prey"])


def test_a_rate_that_is_an_input_or_a_flow() -> None:
    """A rate that is an input is a definition, in the model with ports too; a flow is physics."""
    x, y, u, flow = (ca.SX.sym(n) for n in ("x", "y", "u", "flow"))
    model = psa.ode_model(
        {"x": [x, y], "u": u, "w": flow, "wdef": u * x - y, "ode": [u, flow]}, name="filled"
    )
    ports = ports_of(model)
    assert [p.variable for p in ports if p.kind == "rate"] == ["y"]
    assert ports_of(with_ports(model)) == ports


@pytest.mark.slow
def test_a_spring_that_ages_is_named_at_its_parameter() -> None:
    d = psa.diagnose(hard.spring(), hard.aged(0), leave_out=["hysteresis"])
    assert [c.effect for c in d.causes] == ["change_of_k_with_time"]
    assert d.causes[0].port == "the parameter k"
    values = d.model.values
    size, angle = (values[f"change_of_k_with_time_{n}"] for n in ("size", "angle"))
    ends = values["k"] * (1.0 + size * (np.cos(angle) + np.sin(angle)))
    assert values["k"] == pytest.approx(60.0, rel=0.02)
    assert ends == pytest.approx(60.0 * (1.0 - 0.15 * (1.0 - np.exp(-2.5))), rel=0.02)
    assert d.errors[0].extended < 0.2 * d.errors[0].base


@pytest.mark.slow
def test_a_resistance_over_the_charge_is_named_at_its_parameter() -> None:
    """Charged and discharged three times, so that the charge is no clock."""
    model, record = hard.battery()
    d = psa.diagnose(model, record, hold="zero", leave_out=["hysteresis", "stop"])
    assert [c.effect for c in d.causes] == ["change_of_R0_with_soc"]
    values = d.model.values
    at = np.array([0.0, 0.5]) / values["change_of_R0_with_soc_range"]
    size, angle = (values[f"change_of_R0_with_soc_{k}"] for k in ("size", "angle"))
    result = values["R0"] * (1.0 + size * (np.cos(angle) * at + np.sin(angle) * at**2))
    np.testing.assert_allclose(result, [0.05 * 2.2, 0.05 * 1.3], rtol=0.05)


def test_a_user_effect_acts_at_a_parameter_and_is_kept(tmp_path: object) -> None:
    soft = psa.Component(
        "soft",
        description="the spring softens",
        source="this test",
        equations=lambda s: psa.Equations(add={"varied_k": -s.softer * s.k * s.time / 30.0}),
        parameters=(psa.Parameter("softer", 0.0, "1", (-1.0, 1.0), "share", scale=0.1),),
        gain="softer",
    )
    few = ["lag", "delay", "bend", "sat", "dead", "const", "loss", "fric", "drag", "curve", "stop"]
    few += ["hysteresis", "zero", "drift", "change"]
    d = psa.diagnose(hard.spring(), hard.aged(1), effects=[soft], leave_out=few)
    assert [c.effect for c in d.causes] == ["soft"]
    path = f"{tmp_path}/soft.json"
    psa.save_model(d.model, path)
    again = psa.load_model(path)
    t, u = 0.01 * np.arange(300, dtype=np.float64), np.ones((300, 1))
    x0 = np.zeros(2)
    np.testing.assert_array_equal(psa.run(again, t, u, x0).y, psa.run(d.model, t, u, x0).y)
