"""Models that are FMUs: derivatives, parameters identified, defects named that a plant hides."""

import hashlib
import json
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.model.ports import ports_of, with_ports
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.start import start_state
from tests.export.supplied import pendulum

FREE = {"length": (0.1, 5.0), "damping": (1e-3, 1.0)}
TRUE = {"length": 0.62, "damping": 0.11}
AT = (0.3, -0.7)
T = np.linspace(0.0, 5.99, 600)
#: Effects that the search leaves out, to be quick.
REST = (
    "bend", "constant", "loss", "friction", "drag", "curve", "stop", "hysteresis", "zero", "drift",
    "lag_of_speed", "delay_of_speed", "saturation_of_speed", "dead_zone", "lag_of_reach",
)  # fmt: skip


def _rate(
    phi: float, w: float, torque: float, length: float, damping: float, gravity: float = 9.81
) -> float:
    """Return the pendulum's angular acceleration [rad/s2]."""
    return float((torque - damping * w - gravity * length * np.sin(phi)) / length**2)


@cache
def _record(most: float = np.inf) -> dict[str, FloatArray]:
    """Return what a pendulum shows whose torque goes no further than `most` [N.m]."""
    rng = np.random.default_rng(3)
    torque = sum(np.sin(2 * np.pi * f * T + rng.uniform(0, 6)) for f in (0.4, 0.9, 1.7, 2.6))

    def plant(t: float, q: FloatArray) -> list[float]:
        inputs = float(np.clip(np.interp(t, T, torque), -most, most))
        return [q[1], _rate(q[0], q[1], inputs, *TRUE.values())]

    phi = solve_ivp(plant, (0, T[-1]), [0.1, 0], t_eval=T, rtol=1e-8, max_step=0.01).y[0]
    reach = TRUE["length"] * np.sin(phi) + 1e-3 * rng.standard_normal(len(T))
    return {"time": T, "torque": torque, "reach": reach}


def test_rates_outputs_and_their_derivatives_are_those_of_the_fmu() -> None:
    model = psa.fmu_model(pendulum(), free=FREE)
    s, p = model.structure, {n: model.values[n] for n in FREE}
    xdot, y = (np.array(v)[:, 0] for v in s.f(0.0, AT, 1.3, model.parameter_vector()))
    assert xdot == pytest.approx([-0.7, _rate(*AT, 1.3, **p)], rel=1e-14)
    assert y == pytest.approx([0.5 * np.sin(0.3), -0.7], rel=1e-14)
    by = ca.vertcat(s.x, s.u, s.p)
    slopes = ca.Function("slopes", s.arguments, [s.jacobian(s.xdot, by), s.jacobian(s.y, by)])
    rates, outputs = (np.array(v) for v in slopes(0.0, AT, 1.3, model.parameter_vector()))
    exact = [-9.81 * np.cos(0.3) / 0.5, -0.05 / 0.25, 4.0, np.nan, 0.7 / 0.25]
    held = 1.3 + 0.05 * 0.7
    exact[3] = -2.0 * held / 0.5**3 + 9.81 * np.sin(0.3) / 0.5**2
    assert rates[1] == pytest.approx(exact, rel=1e-7)
    assert rates[0] == pytest.approx([0, 1, 0, 0, 0])
    assert outputs[0] == pytest.approx(
        [0.5 * np.cos(0.3), 0, 0, np.sin(0.3), 0], rel=1e-7, abs=1e-9
    )


def test_the_variables_are_those_of_the_description() -> None:
    model = psa.fmu_model(pendulum(), values={"gravity": 1.62, "length": 0.8})
    assert model.state_names == ("body_phi", "body_w")
    assert [s.start for s in model.structure.states] == [0.1, 0.0]
    assert model.output_names == ("reach", "speed")
    assert (model.input_names, model.structure.inputs[0].unit) == (("torque",), "N.m")
    assert dict(model.values) == {"length": 0.8}
    assert model.parameter("length").bounds == (0.1, 5.0)
    assert model.parameter("length").log
    places = {(p.kind, p.variable) for p in ports_of(model)}
    assert places == {
        ("input", "torque"), ("rate", "body_w"), ("output", "reach"), ("output", "speed"),
    }  # fmt: skip
    rate = model.structure.f(0.0, AT, 0.0, [0.8])[0]
    assert float(rate[1]) == pytest.approx(_rate(*AT, 0.0, 0.8, 0.05, 1.62), rel=1e-14)


def test_units_that_are_no_si_units_are_kept(tmp_path: Path) -> None:
    x, room, k = (ca.SX.sym(n) for n in ("x", "room", "k"))
    plate = psa.ode_model(
        {"x": x, "u": room, "p": k, "ode": k * (room - x), "y": x},
        name="plate",
        inputs=[psa.Input("room", "degC", "room")],
        outputs=[psa.Output("plate", "degC", "plate")],
        parameters=[psa.Parameter("k", 0.5, "1/min", (0.05, 5.0), "rate")],
    )
    model = psa.fmu_model(psa.export_fmu(plate, tmp_path / "plate.fmu"))
    assert (model.structure.inputs[0].unit, model.structure.outputs[0].unit) == ("degC", "degC")
    assert model.parameter("k").unit == "1/min"


def test_changed_parameters_are_identified() -> None:
    result = psa.identify(psa.fmu_model(pendulum(), free=FREE), _record(), starts=2)
    for name, value in TRUE.items():
        assert abs(result.model.values[name] - value) < 4.0 * result.errors[name]
        assert result.errors[name] < 0.01 * value
    assert result.rms["reach"] == pytest.approx(1e-3, rel=0.05)


@pytest.mark.slow
def test_a_torque_that_goes_no_further_is_named() -> None:
    d = psa.diagnose(psa.fmu_model(pendulum(), free=FREE), _record(1.2), starts=1, leave_out=REST)
    assert (d.verdict, [c.effect for c in d.causes]) == ("cause_named", ["saturation_of_torque"])
    values = d.model.values
    assert values["saturation_of_torque_level"] == pytest.approx(1.2, rel=0.01)
    assert values["length"] == pytest.approx(TRUE["length"], rel=0.01)


def test_an_exported_model_is_the_same_model(tmp_path: Path) -> None:
    x, u, k = (ca.SX.sym(n) for n in ("x", "voltage", "k"))
    k_ = psa.Parameter("k", 3.0, "1/s", (0.1, 30.0), "rate", log=True)
    cubic = psa.ode_model(
        {"x": x, "u": u, "p": k, "ode": k * (u - x**3), "y": x + u}, name="cubic", parameters=[k_]
    )
    path = psa.export_fmu(cubic, tmp_path / "cubic.fmu", fmi=3)
    there = psa.fmu_model(path)
    assert dict(there.values) == {"k": 3.0}
    u_: FloatArray = np.sin(np.arange(300) * 0.1)[:, None]

    def run(model: psa.Model) -> FloatArray:
        steps = psa.run(model, 4 * T[:300], u_, np.zeros(1), unknowns=["k"], outputs=["y"])
        return np.hstack([steps.y, steps.sensitivity[:, 0]])

    assert run(there) == pytest.approx(run(cubic), rel=1e-6, abs=1e-7)
    simulated = psa.simulate(there, 4 * T[:300], u_[:, 0], rtol=1e-7)
    assert simulated.outputs["y"] == pytest.approx(run(cubic)[:, 0], rel=1e-6, abs=1e-6)
    with pytest.raises(psa.InputError, match="can only begin at its start values"):
        start_state(there, [0.0])
    values = [{"k": v} for v in np.linspace(1.0, 9.0, 40)]
    models = [there.with_values(v) for v in values]
    assert np.array_equal(side_by_side(run, models), [run(m) for m in models])


def test_what_is_no_differential_equation_is_refused_in_sentences(tmp_path: Path) -> None:
    for whole in (pendulum(indicators=2), pendulum(once="true")):
        assert psa.fmu_model(whole, free=FREE).structure.played
    with pytest.raises(psa.InputError, match=r"'damping' has no bounds.*\(low, high\)"):
        psa.fmu_model(pendulum(), free=["damping"])
    with pytest.raises(psa.InputError, match=r"'mass', which is no real parameter"):
        psa.fmu_model(pendulum(), free={"mass": (0.0, 1.0)})
    with pytest.raises(psa.InputError, match=r"'length' is 0.5 in the FMU, outside \[1, 2\]"):
        psa.fmu_model(pendulum(), free={"length": (1.0, 2.0)})
    with pytest.raises(psa.InputError, match=r"cannot be initialised \(fmi2ExitInitializationMode"):
        psa.fmu_model(pendulum(), free={"damping": (0, 1)}, values={"length": -1.0})
    with pytest.raises(psa.InputError, match=r"cannot be read"):
        psa.fmu_model(tmp_path / "none.fmu")


def test_what_has_no_equations_is_not_exported(tmp_path: Path) -> None:
    model = psa.fmu_model(pendulum())
    for export in (psa.export_fmu, psa.export_modelica):
        with pytest.raises(psa.InputError, match=r"has an FMU in it \('Pendulum': pendulum.fmu"):
            export(model, tmp_path / "again")
    with pytest.raises(psa.InputError, match=r"has an FMU in it"):
        psa.export_c(model, tmp_path, step=1e-3)


def test_model_json_names_the_fmu_by_its_hash(tmp_path: Path) -> None:
    fmu, file = tmp_path / "swing.fmu", tmp_path / "model.json"
    fmu.write_bytes(pendulum().read_bytes())
    model = psa.fmu_model(fmu, free=FREE, values={"gravity": 1.62}, name="swing")
    model = with_ports(model.with_values({"length": 1.0 / 3.0}))
    psa.save_model(model, file)
    used = json.loads(file.read_text("utf-8"))["own"]["swing"]["fmu"]
    assert used == {
        "file": "swing.fmu", "sha256": hashlib.sha256(fmu.read_bytes()).hexdigest(),
        "parameters": ["length", "damping"], "values": {"gravity": 1.62},
    }  # fmt: skip
    result = psa.load_model(file)
    assert dict(result.values) == dict(model.values)
    assert result.structure.parameters == model.structure.parameters
    assert result.changed_starts() == model.changed_starts() == {"body_phi": 0.1}
    assert ports_of(result) == ports_of(model)
    at = (0.2, AT, 1.3, model.parameter_vector())
    for mine, its in zip(model.structure.f(*at), result.structure.f(*at), strict=True):
        np.testing.assert_array_equal(np.array(its), np.array(mine))
    psa.save_model(result, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == file.read_bytes()


def test_a_saved_model_finds_its_fmu_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fmu, folder = tmp_path / "swing.fmu", tmp_path / "models"
    fmu.write_bytes(pendulum().read_bytes())
    folder.mkdir()
    psa.save_model(psa.fmu_model(fmu, free=FREE), folder / "swing.json")
    with pytest.raises(psa.InputError, match=r"models.swing\.fmu is not there"):
        psa.load_model(folder / "swing.json")
    monkeypatch.chdir(tmp_path)
    assert psa.load_model(folder / "swing.json").output_names == ("reach", "speed")


def test_another_fmu_than_the_saved_one_is_refused(tmp_path: Path) -> None:
    fmu, file = tmp_path / "swing.fmu", tmp_path / "model.json"
    fmu.write_bytes(pendulum().read_bytes())
    psa.save_model(psa.fmu_model(fmu, free=FREE), file)
    (tmp_path / "there").mkdir()
    moved = fmu.rename(tmp_path / "there" / "other.fmu")
    with pytest.raises(psa.InputError, match=r"swing\.fmu is not there; .*type psa\.load_model"):
        psa.load_model(file)
    assert psa.load_model(file, fmu=moved).output_names == ("reach", "speed")
    fmu.write_bytes(moved.read_bytes() + b" ")
    with pytest.raises(psa.InputError, match="is another FMU than the one it was saved with"):
        psa.load_model(file)
    moved.rename(tmp_path / "there" / "swing.fmu")
    assert psa.load_model(file, fmu=tmp_path / "there").state_names == ("body_phi", "body_w")
    content = json.loads(file.read_text("utf-8"))
    content["own"]["Pendulum"]["fmu"]["file"] = "there/swing.fmu"
    file.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(psa.InputError, match=r"'there/swing\.fmu', which is not opened from here"):
        psa.load_model(file)
