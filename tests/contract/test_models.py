"""Models: MODEL.json, the independent reference, effects, parts, and models of users."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

import psa_casadi as psa
from tests.contract.helpers import Floats, command, done, off, reference_run, refused, table, write

STACK = "P-885.51"
#: The share of the range to which a simulation agrees with the independent reference.
AGREES = 1e-6


# --- simulation ---


@pytest.mark.parametrize("stack", ["PTBS200", "WYDS0808020", STACK])
def test_a_simulation_agrees_with_the_independent_reference(stack: str) -> None:
    time, voltage, expected = reference_run(stack)
    result = psa.simulate(psa.stack_model(stack), time, voltage, from_rest_at_zero=True, rtol=1e-8)
    assert off(result.displacement, expected.displacement) < AGREES
    for name, values in expected.states.items():
        assert off(result.states[name], values) < 10.0 * AGREES, name
    assert off(result.outputs["blocked_force"], expected.blocked_force) < AGREES
    assert off(result.outputs["charge"], expected.charge) < AGREES


def test_the_command_simulates_a_voltage_and_writes_every_output_with_its_unit(
    tmp_path: Path,
) -> None:
    time, voltage, expected = reference_run()
    planned = write(tmp_path / "v.csv", {"time [ms]": 1e3 * time, "voltage [V]": voltage})
    out = tmp_path / "x.csv"
    done("simulate", "--stack", STACK, "--input", planned, "--start-voltage", "0", "-o", out)
    columns = table(out)
    assert list(columns)[:2] == ["time [s]", "voltage [V]"]
    np.testing.assert_allclose(columns["time [s]"], time, atol=1e-12)
    assert off(columns["displacement [um]"], 1e6 * expected.displacement) < 1e-5
    assert off(columns["blocked_force [N]"], expected.blocked_force) < 1e-5
    assert off(columns["charge [uC]"], 1e6 * expected.charge) < 1e-5
    assert off(columns["velocity [um/s]"], 1e6 * expected.velocity) < 1e-3


def test_a_history_leaves_the_memory_that_sweeping_it_leaves(tmp_path: Path) -> None:
    model, sweep = psa.stack_model(STACK), 0.5
    time = np.array([0.0, sweep, 2.0 * sweep])
    swept = psa.simulate(model, time, np.array([0.0, 120.0, 30.0]), from_rest_at_zero=True)
    memory = psa.memory_after(model, (0.0, 120.0), at=30.0, sweep=sweep)
    assert memory["f_H"] == pytest.approx(swept.states["f_H"][-1], rel=2e-3)
    relaxed = psa.memory_after(model, (), at=30.0, sweep=sweep)
    assert abs(memory["f_H"] - relaxed["f_H"]) > 0.05 * model.values["h_ref"]
    settled = psa.settled_at(model, 30.0, (120.0,), sweep=sweep)
    held = psa.simulate(settled, np.linspace(0.0, 0.01, 21), np.full(21, 30.0), as_exported=True)
    assert np.ptp(held.displacement) < 1e-3 * 1.8e-5
    assert held.displacement[0] == pytest.approx(swept.displacement[-1], rel=5e-3)


def test_a_load_moves_the_tip_by_force_over_stiffness_and_takes_no_stroke() -> None:
    stack = psa.stack_model(STACK).plant()
    time = np.linspace(0.0, 5e-3, 501)
    voltage = np.clip(2e5 * (time - 1e-3), 0.0, 100.0)
    free = psa.simulate(stack, time, voltage).displacement
    pressed = psa.simulate(stack, time, voltage, load_force=np.full(501, -32.0)).displacement
    assert 1e6 * free[-1] == pytest.approx(15.96, abs=0.01)
    np.testing.assert_allclose((pressed - free)[[0, -1]], -32.0 / stack.values["k_B"], rtol=2e-3)
    loaded = psa.simulate(stack.with_values({"m_B": 0.2}), time, voltage).displacement
    assert loaded[-1] == pytest.approx(free[-1], rel=2e-3)
    assert loaded.max() > 1.02 * loaded[-1] > 1.01 * free.max()


def test_many_parameter_sets_are_run_at_once() -> None:
    model, (time, voltage, _) = psa.stack_model(STACK), reference_run()
    sets = [{"k_L": 6.0}, {"k_L": 7.0, "tau": 2e-3}]
    record = psa.Record(name="planned", time=time, voltage=voltage)
    together = psa.simulate_many(model, sets, record)
    ranges = psa.simulate_many(model, sets, record, reduce="range")
    for row, reduced, values in zip(together, ranges, sets, strict=True):
        one = psa.simulate_record(model.with_values(values), record).displacement
        np.testing.assert_allclose(row, one, atol=1e-5 * np.ptp(one))
        assert reduced == pytest.approx(np.ptp(one), rel=1e-5)


# --- effects ---


def test_creep_after_a_step_is_its_closed_form() -> None:
    """Each declared relaxation, of 0.2, 2 and 20 s, adds its share of the elongation."""
    plain = psa.stack_model(STACK).with_values({"delta": 0.0})
    model = plain.with_effect(psa.EFFECTS["slow_creep"], {"creep_gain": 0.04, "creep_time": 0.2})
    time = np.concatenate([[0.0, 1e-3], np.geomspace(0.05, 30.0, 60)])
    voltage = np.minimum(time / 1e-3, 1.0) * 80.0
    x, crept = (
        psa.simulate(m, time, voltage, from_rest_at_zero=True).displacement for m in (plain, model)
    )
    after = time[2:] - 0.5e-3
    shares = 0.04 * np.sum([1.0 - np.exp(-after / tau) for tau in (0.2, 2.0, 20.0)], axis=0)
    np.testing.assert_allclose((crept - x)[2:], shares * x[-1], atol=1e-3 * x[-1] * 0.12)


@pytest.mark.parametrize(
    ("name", "values", "delayed"),
    [
        ("sensor_lag", {"sensor_lag_time": 2e-3}, lambda x, dx, d2x: x - 2e-3 * dx + 4e-6 * d2x),
        ("sensor_delay", {"sensor_delay": 1e-3}, lambda x, dx, d2x: x - 1e-3 * dx + 5e-7 * d2x),
    ],
)  # fmt: skip
def test_what_the_sensor_shows_late_is_late_by_its_time(
    name: str, values: dict[str, float], delayed: Callable[..., Floats]
) -> None:
    model = psa.stack_model(STACK).with_effect(psa.EFFECTS[name], values)
    time = np.linspace(0.0, 2.0, 4001)
    result = psa.simulate(model, time, 50.0 - 50.0 * np.cos(2.0 * np.pi * time))
    x = result.outputs["displacement"]
    spline = make_interp_spline(time, x, 5)
    expected = delayed(x, spline.derivative(1)(time), spline.derivative(2)(time))
    smooth = (np.abs((2.0 * time) % 1.0 - 0.5) < 0.3) & (time > 0.5)
    late = result.outputs["measured_displacement"]
    assert np.max(np.abs(late - expected)[smooth]) < 2e-3 * np.max(np.abs(late - x))


def test_every_effect_is_listed_and_displayed_with_equation_source_and_bounds() -> None:
    listed = done("effects", "--quiet").out.split()
    assert listed == list(psa.EFFECTS)
    assert len(listed) >= 27
    text = done("effects", "slow_creep").words
    for part in ("creep_gain (z_1 + z_2 + z_3)", "Croft, Shed and Devasia", "belongs to plant",
                 "creep_time s 0.100", "0 to 0.500"):  # fmt: skip
        assert part in text
    assert "did you mean slow_creep" in refused("effects", "slow_crep")
    for name, effect in psa.EFFECTS.items():
        assert effect.belongs_to in ("plant", "drive", "sensor", "environment"), name
        assert effect.equation_text, name
        assert effect.source, name


# --- MODEL.json ---


def creeping() -> psa.Model:
    return psa.stack_model(STACK).with_effect(psa.EFFECTS["slow_creep"], {"creep_gain": 0.1 / 3})


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    psa.save_model(creeping(), tmp_path / "model.json")
    return tmp_path / "model.json"


def test_a_model_file_is_complete_and_round_trips_exactly(saved: Path, tmp_path: Path) -> None:
    content, model = json.loads(saved.read_text("utf-8")), psa.load_model(saved)
    assert content["format"] == "psa_casadi.model/1"
    assert content["effects"] == ["slow_creep"]
    assert content["components"][:3] == ["drive", "linear_force", "bouc_wen"]
    assert set(content["parameters"]) == set(model.values)
    creeps = {"value": 0.1 / 3, "unit": "1", "interval": None, "free": False}
    assert content["parameters"]["creep_gain"] == creeps
    psa.save_model(model, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == saved.read_bytes()
    time, voltage, _ = reference_run()
    one, other = (psa.simulate(m, time, voltage).displacement for m in (model, creeping()))
    np.testing.assert_array_equal(one, other)


MISTAKES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "unknown effect": (lambda m: m["effects"].append("warp"), "unknown name 'warp'"),
    "missing parameter": (lambda m: m["parameters"].pop("k_L"), "'k_L' [N/V] has no value"),
    "out of bounds": (
        lambda m: m["parameters"]["creep_gain"].update(value=7.0), "'creep_gain' is 7 1, outside",
    ),
    "no number": (lambda m: m["parameters"]["k_L"].update(value="1"), "give a number"),
    "another unit": (lambda m: m["parameters"]["k_L"].update(unit="kN/V"), "convert it"),
    "interval": (lambda m: m["parameters"]["n"].update(interval=[2, 1]), "interval of 'n'"),
    "free": (lambda m: m["parameters"]["n"].update(free="no"), "give true or false"),
    "format": (lambda m: m.update(format="psa_casadi.diagnosis/1"), "is not a model file"),
}  # fmt: skip


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_in_a_model_file_is_named(case: str, saved: Path, tmp_path: Path) -> None:
    change, text = MISTAKES[case]
    content = json.loads(saved.read_text("utf-8"))
    change(content)
    saved.write_text(json.dumps(content), encoding="utf-8")
    command = ("export", "modelica", "--model", saved, "-o", tmp_path / "x.mo")
    message = refused(*command, folder=tmp_path)
    assert text in message
    assert "model.json" in message
    with pytest.raises(psa.InputError, match=r"model\.json"):
        psa.load_model(saved)


def test_mistakes_of_a_model_file_are_reported_together(saved: Path) -> None:
    content = json.loads(saved.read_text("utf-8"))
    for change, _ in (MISTAKES["no number"], MISTAKES["interval"], MISTAKES["unknown effect"]):
        change(content)
    saved.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(psa.InputError) as caught:
        psa.load_model(saved)
    assert len(caught.value.problems) >= 2
    saved.write_text("{", encoding="utf-8")
    with pytest.raises(psa.InputError, match="is not JSON"):
        psa.load_model(saved)


def test_named_stacks_have_their_published_figures() -> None:
    listed = done("stacks", "--quiet").out.split()
    assert {"PTBS200", "WYDS0808020", STACK, "demo", "micromanipulator"} <= set(listed)
    assert listed == list(psa.STACKS)
    values = psa.stack_model(STACK).values
    assert (values["C_p"], values["u_rated"]) == (1.5e-6, 120.0)
    stroke = values["k_L"] * 120.0 * (1.0 / values["k_P"] + 1.0 / values["k_B"])
    assert 0.86 * stroke == pytest.approx(18e-6, rel=0.01)
    text = done("stacks", STACK).words
    assert "C_p 1.50000 uF Yang and Zhu 2015" in text
    with pytest.raises(psa.InputError, match=r"P-885\.51"):
        psa.stack_model("P-885.52")


# --- effects of users ---

PICKUP = """
import psa_casadi as psa

def equations(s):
    passed = s.voltage - s.slow_voltage
    return psa.Equations(
        der={"slow_voltage": passed / s.pickup_time},
        add={"measured_displacement": s.pickup_gain * passed},
    )

PICKUP = psa.Component(
    name="sensor_pickup", description="the line picks up the voltage", source="two cables",
    belongs_to="sensor", gain="pickup_gain", equations=equations,
    parameters=(
        psa.Parameter("pickup_gain", 0.0, "m/V", (-1e-6, 1e-6), "per volt", scale=1e-9),
        psa.Parameter("pickup_time", 0.02, "s", (1e-4, 10.0), "time constant", log=True),
    ),
    states=(psa.State("slow_voltage", "V", "slow part", 100.0, memory=True),),
    probe={"pickup_time": (0.003, 0.03, 0.3)}, looks_like="the reading jumps",
)
"""


def test_a_users_effect_is_displayed_simulated_and_saved_by_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pickup_of_mine.py").write_text(PICKUP)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert "pickup_gain" in done("effects", "sensor_pickup", "--effects", "pickup_of_mine").out
    pickup = psa.load_effects("pickup_of_mine")["sensor_pickup"]
    plain = psa.stack_model(STACK)
    model = plain.with_effect(pickup, {"pickup_gain": 4e-9, "pickup_time": 0.05})
    time = np.linspace(0.0, 0.4, 801)
    voltage = np.where(time < 0.1, 1000.0 * time, 100.0)
    runs = [psa.simulate(m, time, voltage, rtol=1e-8) for m in (plain, model)]
    without, picked = (run.outputs["measured_displacement"] for run in runs)
    rise, fall = 1.0 - np.exp(-time / 0.05), np.exp(-(time - 0.1) / 0.05)
    passed = 50.0 * np.where(time < 0.1, rise, (1.0 - np.exp(-2.0)) * fall)
    np.testing.assert_allclose(picked - without, 4e-9 * passed, atol=4e-9 * 0.05)
    psa.save_model(model, "m.json")
    assert "equations" not in Path("m.json").read_text("utf-8")
    with pytest.raises(psa.InputError, match="pickup_of_mine"):
        psa.load_model("m.json")
    assert psa.load_model("m.json", [pickup]).values["pickup_gain"] == 4e-9
    export = ("export", "modelica", "--model", "m.json", "-o", "x.mo", "--include-sensor")
    assert command(*export).code == 2
    done(*export, "--effects", "pickup_of_mine")
    assert "pickup_time" in Path("x.mo").read_text("utf-8")


# --- models of users, parts, systems ---


def van_der_pol() -> psa.Model:
    x, v, mu = ca.SX.sym("x"), ca.SX.sym("v"), ca.SX.sym("mu")
    ode = {"x": ca.vertcat(x, v), "p": mu, "ode": ca.vertcat(v, mu * (1 - x**2) * v - x), "y": x}
    start = psa.State("x", "1", "position", nominal=2.0, start=2.0)
    mu_ = psa.Parameter("mu", 1.5, "1", (0.1, 10.0), "damping", log=True)
    return psa.ode_model(
        ode, name="VanDerPol", states=[start, "v"], parameters=[mu_], outputs=["position"]
    )


def test_a_users_model_is_saved_with_its_equations_as_text(tmp_path: Path) -> None:
    model, file = van_der_pol().with_values({"mu": 4.0 / 3.0}), tmp_path / "m.json"
    psa.save_model(model, file)
    content, result = json.loads(file.read_text("utf-8")), psa.load_model(file)
    assert content["components"] == ["VanDerPol"]
    entry = content["own"]["VanDerPol"]
    assert entry["equations"] == {
        "der": {"x": "v", "v": "mu * (1 - x ** 2) * v - x"}, "out": {"position": "x"},
    }  # fmt: skip
    assert entry["states"][0]["start"] == entry["states"][0]["nominal"] == 2.0
    assert entry["parameters"][0]["bounds"] == [0.1, 10.0]
    assert dict(result.values) == {"mu": 4.0 / 3.0}
    psa.save_model(result, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == file.read_bytes()
    time = np.linspace(0.0, 20.0, 201)
    x0, none = np.array([2.0, 0.0]), np.zeros((201, 0))
    one, other = (psa.run(m, time, none, x0).y for m in (model, result))
    np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12)
    fmus = [psa.export_fmu(m, tmp_path / f"{k}.fmu") for k, m in enumerate((model, result))]
    assert fmus[0].read_bytes() == fmus[1].read_bytes()
    assert "passed all" in done("check", fmus[0]).words
    out = tmp_path / "m.mo"
    done("export", "modelica", "--model", file, "-o", out)
    assert "der(v) = mu*(1 - x^2)*v - x" in out.read_text("utf-8")
    done("export", "c", "--model", file, "--step", "10ms", "-o", tmp_path / "c")


def test_a_file_of_a_users_model_is_simulated_and_no_stacks_command_takes_it(
    tmp_path: Path,
) -> None:
    x, force, k = ca.SX.sym("x"), ca.SX.sym("force"), ca.SX.sym("k")
    model = psa.ode_model(
        {"x": x, "u": force, "p": k, "ode": force - k * x, "y": x}, name="lag", values={"k": 2.5},
        states=[psa.State("x", "m", "place", 1.0, start=0.1)],
        inputs=[psa.Input("force", "N", "force")],
        outputs=[psa.Output("place", "m", "place", display_unit="mm")],
    )  # fmt: skip
    psa.save_model(model, tmp_path / "m.json")
    time = np.linspace(0.0, 4.0, 401)
    ramp = write(tmp_path / "u.csv", {"time [ms]": 1e3 * time, "force [mN]": 1e3 * time})
    plan = ("simulate", "--model", tmp_path / "m.json", "--input", ramp, "-o", tmp_path / "x.csv")
    done(*plan)
    columns = table(tmp_path / "x.csv")
    decay = np.exp(-2.5 * time)
    expected = 0.1 * decay + time / 2.5 - (1.0 - decay) / 2.5**2
    np.testing.assert_allclose(columns["place [mm]"], 1e3 * expected, rtol=1e-5)
    np.testing.assert_allclose(columns["force [N]"], time, rtol=1e-12)
    changes = ["--hold", "zero", "--start", "x=0.3", "--value", "k=5", "--figure"]
    text = done(*plan, *changes, tmp_path / "p.png").words
    assert "start: the start values of the model, but for x = 0.3 m" in text
    held = [0.3]
    for u in time[:-1]:  # x' = u - 5 x with u constant over 0.01 s
        held.append(held[-1] * np.exp(-0.05) + u / 5.0 * (1.0 - np.exp(-0.05)))
    places = table(tmp_path / "x.csv")["place [mm]"]
    np.testing.assert_allclose(places, 1e3 * np.array(held), rtol=1e-5)
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    text = refused(*plan, "--start", "y=1", folder=tmp_path)
    assert "no state or input 'y' to start from" in text
    assert "give NAME=VALUE" in refused(*plan, "--value", "k", folder=tmp_path)
    for words in (("web", "-o", tmp_path / "w.html"), ("export", "ssp", "-o", tmp_path / "w.ssp")):
        text = refused(*words, "--model", tmp_path / "m.json", folder=tmp_path)
        assert "Other models are for `psa identify`," in text


def test_equations_of_a_model_file_run_no_code(tmp_path: Path) -> None:
    file, trace = tmp_path / "m.json", tmp_path / "ran"
    psa.save_model(van_der_pol(), file)
    plain = json.loads(file.read_text("utf-8"))
    code = f"__import__('pathlib').Path({str(trace)!r}).touch() or x"
    for text, words in (
        (code, "has a Python Call"),
        ("x.real", "has a Python Attribute"),
        ("open(x)", "calls open of 1"),
        ("9" * 10_000, "at most 8000 are read"),
        ("(" * 5_000, "which is no expression"),
    ):
        plain["own"]["VanDerPol"]["equations"]["der"]["v"] = text
        file.write_text(json.dumps(plain), encoding="utf-8")
        message = refused("export", "modelica", "--model", file, "-o", tmp_path / "x.mo")
        assert words in message
        assert "'own.VanDerPol.equations.der.v'" in message
    assert not trace.exists()


def test_a_users_model_runs_as_scipy_runs_it_and_is_identified() -> None:
    time = np.linspace(0.0, 10.0, 1001)
    plant = solve_ivp(
        lambda _, q: [q[1], 2.3 * (1 - q[0] ** 2) * q[1] - q[0]], (0.0, 10.0), [2.0, 0.0],
        t_eval=time, rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    model = van_der_pol()
    truth = model.with_values({"mu": 2.3})
    result = psa.run(truth, time, np.empty((1001, 0)), np.array([2.0, 0.0]), rtol=1e-9).y[:, 0]
    np.testing.assert_allclose(result, plant.y[0], atol=1e-6)
    noise = 2e-3 * np.random.default_rng(1).standard_normal(1001)
    record = {"time": time, "position": plant.y[0] + noise}
    fitted = psa.identify(model, record, starts=2)
    assert abs(fitted.model.values["mu"] - 2.3) < 4.0 * fitted.errors["mu"]
    assert fitted.errors["mu"] < 0.01
    assert fitted.rms["position"] == pytest.approx(2e-3, rel=0.1)


def test_a_record_of_another_model_is_refused_in_sentences() -> None:
    with pytest.raises(psa.InputError, match="no output of the model 'VanDerPol'"):
        psa.identify(van_der_pol(), {"time": np.arange(50.0), "force": np.arange(50.0)})
    with pytest.raises(psa.InputError, match="model comes first"):
        psa.diagnose({"time": [0.0], "position": [0.0]}, van_der_pol())  # type: ignore[call-overload]


def test_a_model_is_a_casadi_function() -> None:
    model = psa.stack_model(STACK)
    dae, values = model.casadi(), model.values
    rates = ca.Function("rates", [dae["x"], dae["u"], dae["p"]], [dae["ode"], dae["y"]])
    x = np.array([40.0, -5.0, 200.0, 1e-6, 0.02, 4e-6, 0.03])
    ode, y = rates(x, [50.0, 7.0], model.parameter_vector())
    u_rate = (values["G"] * 50.0 - 40.0) / (values["R_s"] * values["C_p"])
    forces = values["k_L"] * 40.0 - 5.0 - 200.0
    by_name = dict(zip(model.state_names, np.array(ode).ravel(), strict=True))
    assert by_name["u"] == pytest.approx(u_rate, rel=1e-12)
    assert by_name["f_out"] == pytest.approx(forces / values["tau"], rel=1e-12)
    assert by_name["x"] == pytest.approx(0.03, rel=1e-12)
    assert float(y[model.output_names.index("displacement")]) == pytest.approx(4e-6, rel=1e-12)


def test_parts_are_connected_by_their_ports() -> None:
    stage = psa.part_model("flexure_stage", m_f=0.5, k_f=1e7)
    wires = {
        "stack.displacement": "stage.tip_position", "stack.velocity": "stage.tip_velocity",
        "stage.reaction_force": "stack.load_force",
    }  # fmt: skip
    parts = {"stack": psa.stack_model(STACK).plant(), "stage": stage}
    whole = psa.connect(parts, list(wires.items()), name="loaded")
    assert whole.input_names == ("stack_voltage",)
    time = np.linspace(0.0, 0.2, 2001)
    u = np.clip(2e4 * (time - 1e-3), 0.0, 100.0)
    y = psa.run(whole, time, u[:, None], np.zeros(len(whole.state_names)), hold="linear").y[-1]
    result = dict(zip(whole.output_names, y, strict=True))
    contact, tip = stage.values["k_c"], result["stack_displacement"]
    series = 1.0 / (1.0 / contact + 1e-7)  # contact and flexure of 1e7 N/m
    free = 15.96e-6 / (1.0 + series / psa.stack_model(STACK).values["k_B"])
    assert tip == pytest.approx(free, rel=5e-3)
    position = tip * contact / (contact + 1e7)
    assert result["stage_stage_position"] == pytest.approx(position, rel=1e-3)


def test_a_closed_loop_follows_its_reference() -> None:
    model = psa.nanopositioner(STACK).model()
    time = np.linspace(0.0, 0.08, 1601)
    wanted = 4e-6 * np.minimum(time / 0.02, 1.0)
    inputs = np.array([[w if n == "reference" else 0.0 for n in model.input_names] for w in wanted])
    starts = np.array([s.start for s in model.structure.states])
    result = psa.run(model, time, inputs, starts, hold="linear").y
    position = result[:, model.output_names.index("stage_position")]
    assert position[-1] == pytest.approx(4e-6, rel=1e-3)
    assert position.max() < 4.2e-6


def test_models_and_trajectories_are_cells_of_a_notebook() -> None:
    time, voltage, _ = reference_run()
    model = psa.stack_model(STACK)
    cell = model._repr_html_()
    assert "<table>" in cell
    assert "k_L" in cell
    run = psa.simulate(model, time, voltage)
    assert "data:image/png;base64," in run._repr_html_()
    frame = run.to_frame()
    np.testing.assert_array_equal(frame["displacement [m]"], run.displacement)
    again = psa.record_from(frame[["time [s]", "voltage [V]", "displacement [m]"]])
    np.testing.assert_array_equal(again.displacement, run.displacement)
