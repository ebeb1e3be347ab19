"""Records that one simulation cannot follow: unstable, chaotic and integrating plants."""

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.notes import Note
from psa_casadi.units import FloatArray

Table = dict[str, FloatArray]


def _near(found: Mapping[str, float], truth: Mapping[str, float], rel: float = 0.04) -> None:
    for name, value in truth.items():
        assert found[name] == pytest.approx(value, rel=rel), name


def _codes(notes: Any) -> set[str]:
    return {n.code for n in notes if isinstance(n, Note)}


def _pendulum(drag: float = 0.0, seed: int = 0) -> tuple[psa.Model, Table, Mapping[str, float]]:
    """An upright pendulum that a controller holds, its torque constant over 10 ms."""
    rng, n, dt = np.random.default_rng(seed), 1600, 0.01
    truth = {"a": 9.81 / 0.4, "J": 0.05, "b": 0.02}
    t, q, angle, torque = dt * np.arange(n), np.array([0.1, 0.0]), np.zeros(n), np.zeros(n)
    wanted = 0.4 * np.sign(np.sin(2 * np.pi * 0.3 * t)) + 0.2 * np.sin(2 * np.pi * 1.1 * t)
    for k in range(n):
        angle[k] = q[0] + 0.002 * rng.standard_normal()
        torque[k] = -3.0 * (angle[k] - wanted[k]) - 0.5 * q[1]

        def rates(_: float, z: FloatArray, u: float = float(torque[k])) -> list[float]:
            lost = truth["b"] * z[1] + drag * z[1] * abs(z[1])
            return [z[1], truth["a"] * np.sin(z[0]) + (u - lost) / truth["J"]]

        q = solve_ivp(rates, (0.0, dt), q, rtol=1e-8, atol=1e-10).y[:, -1]
    a, w, u, *p = (ca.SX.sym(n) for n in ("angle", "w", "torque", "a", "J", "b"))
    rate = p[0] * ca.sin(a) + (u - p[2] * w) / p[1]
    model = psa.ode_model(
        {"x": [a, w], "u": u, "p": p, "ode": [w, rate], "y": a},
        name="pendulum",
        outputs=["shown"],
        parameters=[
            psa.Parameter("a", 15.0, "1", (1.0, 200.0), "g over length", log=True),
            psa.Parameter("J", 0.1, "1", (0.005, 1.0), "inertia", log=True),
            psa.Parameter("b", 0.1, "1", (1e-3, 3.0), "damping", log=True),
        ],
    )
    return model, {"time": t, "torque": torque, "shown": angle}, truth


def _duffing() -> tuple[psa.Model, Table, Mapping[str, float]]:
    """Chaos in two wells: Guckenheimer and Holmes 1983, section 2.2."""
    rng, t = np.random.default_rng(3), 0.05 * np.arange(2000)
    truth = {"d": 0.3, "a": -1.0, "b": 1.0}

    def rates(s: float, z: FloatArray) -> list[float]:
        return [z[1], -0.3 * z[1] + z[0] - z[0] ** 3 + 0.5 * np.cos(1.2 * s)]

    x = solve_ivp(rates, (0.0, t[-1]), [0.5, 0.0], t_eval=t, rtol=1e-9, atol=1e-11).y[0]
    q, v, u, *p = (ca.SX.sym(n) for n in ("q", "v", "force", "d", "a", "b"))
    model = psa.ode_model(
        {"x": [q, v], "u": u, "p": p, "ode": [v, u - p[0] * v - p[1] * q - p[2] * q**3], "y": q},
        name="duffing",
        outputs=["x"],
        parameters=[
            psa.Parameter("d", 0.1, "1", (0.01, 3.0), "damping", log=True),
            psa.Parameter("a", -0.5, "1", (-5.0, 5.0), "linear stiffness"),
            psa.Parameter("b", 0.5, "1", (0.02, 10.0), "cubic stiffness", log=True),
        ],
    )
    noisy = x + 0.02 * rng.standard_normal(t.size)
    return model, {"time": t, "force": 0.5 * np.cos(1.2 * t), "x": noisy}, truth


def test_parts_find_the_parameters_of_an_unstable_plant_and_that_its_input_is_held() -> None:
    model, record, truth = _pendulum()
    found = psa.identify(model, record)
    _near(found.model.values, truth)
    assert found.rms["shown"] == pytest.approx(0.002, rel=0.05)
    assert {"in_parts", "hold_found"} <= _codes(found.notes)
    assert len(found.experiments) > 4
    assert all(e.record.hold == "zero" for e in found.experiments)


def test_parts_find_the_parameters_of_chaos() -> None:
    model, record, truth = _duffing()
    found = psa.identify(model, record)
    _near(found.model.values, truth, rel=0.02)
    assert found.rms["x"] == pytest.approx(0.02, rel=0.05)
    assert "hold_found" not in _codes(found.notes)


def test_what_is_missing_in_an_unstable_plant_is_named() -> None:
    model, record, truth = _pendulum(drag=0.05)
    d = psa.diagnose(model, record)
    assert [c.effect for c in d.causes] == ["drag_in_w"]
    assert d.verdict == "cause_named"
    _near(d.model.values, truth, rel=0.1)
    at = d.model.values["drag_in_w_range"]
    drag = d.model.values["drag_in_w_size"] * d.model.values["J"] / at**2
    assert drag == pytest.approx(0.05, rel=0.04)
    assert d.errors[0].extended == pytest.approx(0.002, rel=0.15)


@pytest.mark.slow
def test_what_an_integrator_lacks_is_named_and_judged_on_the_whole_record() -> None:
    """A slide on a guide with dry friction and a slope, of which nothing pulls it back."""
    rng, t = np.random.default_rng(5), 0.01 * np.arange(1500)
    wanted = 0.1 * np.sin(2 * np.pi * 0.35 * t) + 0.05 * np.sin(2 * np.pi * 0.9 * t + 1.0)
    force, x = np.zeros(t.size), np.zeros((t.size, 2))

    def rates(_: float, z: FloatArray, u: float) -> list[float]:
        return [z[1], (u - 100.0 * z[1] - 15.0 * np.tanh(z[1] / 2e-3) - 4.0) / 50.0]

    for k in range(t.size - 1):
        force[k] = 6e3 * (wanted[k] - x[k, 0]) - 600.0 * x[k, 1]
        step = solve_ivp(rates, (0.0, 0.01), x[k], args=(force[k],), method="LSODA", rtol=1e-8)
        x[k + 1] = step.y[:, -1]
    record = {"time": t, "force": force, "shown": x[:, 0] + 1e-5 * rng.standard_normal(t.size)}
    q, v, u, *p = (ca.SX.sym(n) for n in ("q", "v", "force", "M", "c"))
    model = psa.ode_model(
        {"x": [q, v], "u": u, "p": p, "ode": [v, (u - p[1] * v) / p[0]], "y": q},
        name="slide",
        outputs=["shown"],
        parameters=[
            psa.Parameter("M", 30.0, "1", (5.0, 500.0), "mass", log=True),
            psa.Parameter("c", 60.0, "1", (1.0, 2000.0), "viscous friction", log=True),
        ],
    )
    d = psa.diagnose(model, record)
    assert "friction_in_v" in {c.effect for c in d.causes}
    assert len(d.experiments) == 1
    _near(d.model.values, {"M": 50.0, "c": 100.0}, rel=0.1)
    assert d.model.values["friction_in_v_size"] * d.model.values["M"] == pytest.approx(
        15.0, rel=0.1
    )
    assert d.errors[0].extended < 0.1 * d.errors[0].base
