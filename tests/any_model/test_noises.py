"""Clean records whose noise is no sensor's white one: nothing is named, and where it enters is."""

import casadi as ca
import numpy as np
import pytest
from numpy.random import Generator
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.notes import Note
from psa_casadi.common.units import FloatArray

TIME = np.linspace(0.0, 60.0, 1500)
STIFFNESS, DAMPING = 10.0, 0.8


def mass(*, speed: bool = False) -> psa.Model:
    x, v, u, k, d = (ca.SX.sym(n) for n in ("x", "v", "force", "k", "d"))
    return psa.ode_model(
        {
            "x": [x, v],
            "u": u,
            "p": [k, d],
            "y": [x, v] if speed else x,
            "ode": [v, u - k * x - d * v],
        },
        name="mass",
        states=[psa.State("x", "m", "position", 0.1), psa.State("v", "m/s", "speed", 0.3)],
        inputs=[psa.Input("force", "N", "force over 1 kg")],
        outputs=[
            psa.Output("position", "m", "position"),
            *([psa.Output("speed", "m/s", "speed")] if speed else []),
        ],
        parameters=[
            psa.Parameter("k", 8.0, "N/m", (1.0, 100.0), "stiffness", log=True),
            psa.Parameter("d", 1.0, "N.s/m", (0.05, 10.0), "damping", log=True),
        ],
    )


def force(rng: Generator) -> FloatArray:
    w, phase = 2.0 * np.pi * rng.uniform(0.05, 1.0, 12), rng.uniform(0.0, 2.0 * np.pi, 12)
    return np.asarray(np.sum(np.sin(np.outer(TIME, w) + phase), axis=1) / np.sqrt(6.0))


def moved(force: FloatArray, friction: float = 0.0) -> FloatArray:
    def rates(t: float, x: FloatArray) -> list[float]:
        item = friction * np.tanh(x[1] / 0.005)
        return [x[1], np.interp(t, TIME, force) - STIFFNESS * x[0] - DAMPING * x[1] - item]

    span = TIME[0], TIME[-1]
    result = solve_ivp(rates, span, [0.0, 0.0], t_eval=TIME, max_step=0.04, rtol=1e-8, atol=1e-10)
    return np.asarray(result.y[0])


def followed(rng: Generator, correlation: float) -> FloatArray:
    """Noise of first order with variance 1."""
    values, new = np.zeros(TIME.size), rng.standard_normal(TIME.size)
    for k in range(1, TIME.size):
        values[k] = correlation * values[k - 1] + np.sqrt(1.0 - correlation**2) * new[k]
    return values


def record(force: FloatArray, y: FloatArray, rng: Generator) -> dict[str, FloatArray]:
    white = 0.01 * np.std(y) * rng.standard_normal(y.size)
    return {"time": TIME, "force": force, "position": y + white}


def entering(d: psa.Diagnosis) -> list[Note]:
    return [n for n in d.remarks if isinstance(n, Note) and n.code == "noise_enters"]


@pytest.mark.parametrize("correlation", [0.9, 0.98])
def test_coloured_noise_of_a_sensor_is_noise(correlation: float) -> None:
    rng = np.random.default_rng(7)
    u = force(rng)
    y = moved(u)
    d = psa.diagnose(mass(), record(u, y + 0.02 * np.std(y) * followed(rng, correlation), rng))
    assert d.verdict == "adequate"
    assert not entering(d)


def test_an_output_that_no_state_reaches_may_have_noise_of_a_colour() -> None:
    x, inputs, gain = (ca.SX.sym(n) for n in ("x", "u", "gain"))
    model = psa.ode_model(
        {"x": x, "u": inputs, "p": gain, "ode": inputs - x, "y": gain * inputs},
        name="follower", inputs=["u"], outputs=["y"],
        parameters=[psa.Parameter("gain", 1.0, "1", (0.1, 10.0), "gain", log=True)],
    )  # fmt: skip
    rng = np.random.default_rng(9)
    u = force(rng)
    y = 2.0 * u + 0.02 * followed(rng, 0.95)
    d = psa.diagnose(model, {"time": TIME, "u": u, "y": y})
    assert d.verdict == "adequate"
    assert not entering(d)


def test_outliers_in_held_out_samples_are_noise() -> None:
    rng = np.random.default_rng(8)
    u = force(rng)
    y = moved(u)
    y = y + np.where(rng.random(y.size) < 0.01, 0.5 * np.std(y) * rng.standard_normal(y.size), 0.0)
    assert psa.diagnose(mass(), record(u, y, rng)).verdict == "adequate"


@pytest.mark.parametrize("seed", [11, 12])
def test_a_random_load_is_reported_with_its_place_and_size(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u = force(rng)
    d = psa.diagnose(mass(), record(u, moved(u + 0.1 * followed(rng, 0.99)), rng))
    assert d.verdict == "adequate"
    (output,) = entering(d)
    assert output.values["place"] in ("force", "v")
    assert 0.03 < output.values["rms"][0] < 0.3
    assert output.values["time"] > 0.2
    assert "is likelier" in str(output)


@pytest.mark.slow
def test_noise_that_is_read_at_an_input_is_reported_there() -> None:
    rng = np.random.default_rng(13)
    u = force(rng)
    read = u + 0.1 * np.std(u) * rng.standard_normal(u.size)
    d = psa.diagnose(mass(), record(read, moved(u), rng))
    assert d.verdict == "adequate"
    smoothed = [n for n in d.remarks if isinstance(n, Note) and n.code == "inputs_smoothed"]
    assert smoothed or [n.values["place"] for n in entering(d)] == ["force"]


@pytest.mark.slow
def test_friction_is_named_next_to_a_random_load() -> None:
    rng = np.random.default_rng(14)
    u = force(rng)
    d = psa.diagnose(mass(), record(u, moved(u + 0.05 * followed(rng, 0.99), 0.3), rng))
    assert [c.effect for c in d.causes] == ["friction_in_v"]


@pytest.mark.slow
def test_friction_is_named_next_to_outliers_of_one_output() -> None:
    """Samples that are masked in one output count in the others."""
    rng = np.random.default_rng(15)
    u = force(rng)
    y = moved(u, 0.3)
    speed = np.gradient(y, TIME)
    y = y + np.where(rng.random(y.size) < 0.01, np.std(y) * rng.standard_normal(y.size), 0.0)
    item = record(u, y, rng)
    item["speed"] = speed + 0.02 * np.std(speed) * rng.standard_normal(y.size)
    d = psa.diagnose(mass(speed=True), item)
    assert "friction_in_v" in [c.effect for c in d.causes]
    assert any("spikes" in str(n) for n in d.remarks)
