"""Linearised models: matrices by hand and by SciPy, margins, a Kalman filter that runs."""

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.io import loadmat
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.cli.app import app
from psa_casadi.common.units import FloatArray
from psa_casadi.simulation.start import linear_part

#: A mass on a spring that hardens: v' = (F - c v - k x - e x^3) / m.
M, C, K, E = 0.5, 0.4, 200.0, 3e4


def mass() -> psa.Model:
    x, v, force = (ca.SX.sym(n) for n in ("x", "v", "force"))
    return psa.ode_model(
        {
            "x": [x, v], "u": force, "y": [x, v + 0.1 * force],
            "ode": [v, (force - C * v - K * x - E * x**3) / M],
        },
        name="mass", outputs=["place", "speed"],
    )  # fmt: skip


def test_matrices_are_those_of_the_equations_at_rest() -> None:
    result = psa.linearize(mass(), {"force": 5.0})
    x = float(result.x[0])
    assert K * x + E * x**3 == pytest.approx(5.0, rel=1e-9)
    slope = -(K + 3 * E * x**2) / M
    assert result.a == pytest.approx(np.array([[0, 1], [slope, -C / M]]), rel=1e-6)
    assert result.b == pytest.approx(np.array([[0], [1 / M]]))
    assert result.d == pytest.approx(np.array([[0], [0.1]]))
    assert np.abs(result.rates) == pytest.approx(0.0, abs=1e-6)
    hertz = np.sqrt(-slope) / (2 * np.pi)
    assert f"mode {hertz:.6g} Hz" in repr(result)
    at = 2j * np.pi * 3.0
    response = result.response(np.array([6 * np.pi]))[0, 0, 0]
    assert response == pytest.approx(1 / (M * at**2 + C * at - slope * M), rel=1e-6)


def test_a_point_need_not_rest_and_names_are_checked() -> None:
    moving = psa.linearize(mass(), states={"x": 0.01, "v": 1.0})
    assert moving.rates[0] == 1.0
    with pytest.raises(psa.InputError, match=r"has no input 'voltage'; it has 'force'"):
        psa.linearize(mass(), {"voltage": 1.0})
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    runaway = psa.ode_model({"x": x, "u": u, "ode": 1.0 + x**2}, name="runaway")
    with pytest.raises(psa.InputError, match="rest of 'runaway'"):
        psa.linearize(runaway)


def test_a_stack_is_its_linear_part() -> None:
    stack = psa.stack_model("P-885.51")
    result = psa.linearize(stack)
    part, row = linear_part(stack), result.output_names.index("displacement")
    omega = 2 * np.pi * np.array([1.0, 300.0, 8000.0])
    column = result.input_names.index("voltage")
    assert result.response(omega)[:, row, column] == pytest.approx(part.response(omega), rel=1e-9)
    assert "f_H" in result.held


def test_an_fmu_has_the_matrices_of_its_model(tmp_path: Path) -> None:
    path = psa.export_fmu(mass(), tmp_path / "mass.fmu")
    item, there = (psa.linearize(m, {"force": 5.0}) for m in (mass(), psa.fmu_model(path, free={})))
    for name in "abcd":
        assert getattr(there, name) == pytest.approx(getattr(item, name), rel=1e-5, abs=1e-6)
    whole = psa.fmu_model(path, free={}, interface="co-simulation")
    with pytest.raises(psa.InputError, match="run as a whole has no equations"):
        psa.linearize(whole)


def test_margins_are_those_of_a_known_loop() -> None:
    """G = 1/(s + 1)^3 with the gain 4: a gain margin of 2 at sqrt(3) rad/s."""
    x = [ca.SX.sym(f"x{k}") for k in range(3)]
    u = ca.SX.sym("u")
    rates = [u - x[0], x[0] - x[1], x[1] - x[2]]
    lags = psa.ode_model({"x": x, "u": u, "ode": rates, "y": x[2]}, name="lags")
    values = psa.margins(psa.linearize(lags), ([4.0], [1.0]))
    assert values["gain_margin"] == pytest.approx(2.0, rel=1e-6)
    assert values["gain_margin_at"] == pytest.approx(np.sqrt(3) / (2 * np.pi), rel=1e-6)
    assert values["stable"] == 1.0
    assert psa.margins(psa.linearize(lags), ([9.0], [1.0]))["stable"] == 0.0


def test_an_observer_follows_what_is_not_measured(tmp_path: Path) -> None:
    """Its filter in an FMU, with a plant with noise; white noise of known size comes down."""
    rng, n, step = np.random.default_rng(2), 20_000, 1e-3
    t = step * np.arange(n, dtype=float)
    force = 0.5 * rng.standard_normal(n)
    plant = psa.run(mass(), t, force[:, None], np.zeros(2), hold="zero")
    values: FloatArray = plant.y[:, 0] + 1e-4 * rng.standard_normal(n)
    point = psa.linearize(mass())
    made = psa.observer(point, input_noise={"force": 0.5}, output_noise={"place": 1e-4}, step=step)
    path = psa.export_fmu(made, tmp_path / "observer.fmu")
    there = psa.fmu_model(path, free={})
    u = np.column_stack([np.zeros(n), values])
    result = psa.run(there, t, u, np.zeros(2), hold="zero").y
    names = [o.removeprefix("estimated_") for o in there.output_names]
    place, speed = (result[:, names.index(q)] for q in ("x", "v"))
    settled = slice(n // 10, None)
    errors = [np.std((a - b)[settled]) for a, b in zip((place, speed), plant.x.T, strict=True)]
    assert errors[0] < 0.6e-4  # less than the sensor's
    assert errors[1] < 0.3 * np.std(plant.x[settled, 1])
    with pytest.raises(psa.InputError, match="noise of one measured output"):
        psa.observer(point, input_noise={}, output_noise={}, step=step)


@pytest.mark.parametrize(
    ("stack", "noise"),
    [("P-885.51", {"voltage": 0.01}), ("WYDS0808020", {"load_force": 1.0}), ("PTBS200", {})],
)
def test_the_observer_of_a_stack_forgets_its_start(stack: str, noise: dict[str, float]) -> None:
    point = psa.linearize(psa.stack_model(stack), {"voltage": 60.0})
    made = psa.observer(
        point, input_noise={"voltage": 0.1, **noise}, output_noise={"displacement": 1e-8}, step=1e-5
    )
    values = {
        **dict(zip(point.input_names, point.u, strict=True)),
        "measured_displacement": point.y[point.output_names.index("displacement")],
    }
    filtered = psa.linearize(made, values, states=dict.fromkeys(made.state_names, 0.0))
    assert max(filtered.poles.real) < min(0.0, 0.5 * max(point.poles.real))
    for size in (0.0, -1.0):
        with pytest.raises(psa.InputError, match="give a positive number"):
            psa.observer(point, input_noise=noise, output_noise={"displacement": size}, step=1e-5)


def test_a_controller_that_is_none_is_refused() -> None:
    for controller in ([2.0, 50.0], [1.0]), ([1.0], []):
        with pytest.raises(psa.InputError, match="no transfer function"):
            psa.margins(psa.linearize(mass()), controller, output="place")


def test_the_command_writes_what_others_read(tmp_path: Path) -> None:
    files = [tmp_path / n for n in ("lin.mat", "lin.json", "bode.png", "observer.fmu")]
    for output in files[:2]:
        result = CliRunner().invoke(
            app,
            [
                "linearize", "--stack", "P-885.51", "--at", "voltage=60", "-o", str(output),
                "--figure", str(files[2]), "--controller", "20 8e7 / 1 0", "--from", "voltage",
                "--to", "displacement", "--observer", str(files[3]), "--noise", "voltage=0.01",
                "--noise", "displacement=1e-9", "--step", "10us",
            ],
        )  # fmt: skip
        assert result.exit_code == 0, result.output
        assert "the closed loop is stable" in result.output
    read, content = loadmat(files[0]), json.loads(files[1].read_text("utf-8"))
    assert read["A"] == pytest.approx(np.array(content["A"]))
    assert [str(c[0][0]) for c in read["x_name"]] == [s["name"] for s in content["states"]]
    assert content["u"][content["inputs"].index({"name": "voltage", "unit": "V"})] == 60.0
    assert all(f.stat().st_size > 1000 for f in files)
    system = psa.linearize(psa.stack_model("P-885.51"), {"voltage": 60.0}).to_control()
    assert pytest.approx(read["A"]) == system.A
    bad = CliRunner().invoke(app, ["linearize", "--stack", "P-885.51", "--controller", "one"])
    assert bad.exit_code == 2
    assert "give coefficients" in bad.output
