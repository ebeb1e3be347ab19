"""Intermediates as ports: forces between two bodies, what lags inside a model, and formulas."""

import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from fmpy import simulate_fmu
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.model.ports import (
    is_place,
    kinematic,
    ports_of,
    seen_by,
    variables_at,
    with_ports,
)
from psa_casadi.units import FloatArray
from tests.any_model.own_plants import multisine


def two_bodies() -> psa.Model:
    """Two carts with a spring and a damper between them, the first one also on a spring."""
    x1, v1, x2, v2, stretch, slip, spring, held, force = (
        ca.SX.sym(n) for n in ("x1", "v1", "x2", "v2", "stretch", "slip", "spring", "held", "force")
    )
    k, c, m1, m2 = (ca.SX.sym(n) for n in ("k", "c", "m1", "m2"))
    return psa.ode_model(
        {
            "x": [x1, v1, x2, v2], "u": force, "p": [k, c, m1, m2], "y": [x1, x2],
            "w": [stretch, slip, spring, held],
            "wdef": [x1 - x2, v1 - v2, k * stretch + c * slip, 400.0 * x1 + 2.0 * v1],
            "ode": [v1, (force - spring - held) / m1, v2, (spring - 0.5 * v2) / m2],
        },
        name="two", outputs=["y1", "y2"],
        intermediates=[
            psa.Output("stretch", "m", "stretch of the spring"),
            psa.Output("slip", "m/s", "rate of the stretch"),
            psa.Output("spring", "N", "force between the carts"),
            psa.Output("held", "N", "force of the first spring"),
        ],
        parameters=[
            psa.Parameter("k", 700.0, "N/m", (70.0, 7e3), "stiffness", log=True),
            psa.Parameter("c", 2.0, "N.s/m", (0.2, 20.0), "damping", log=True),
            psa.Parameter("m1", 1.7, "kg", (0.17, 17.0), "mass of the first", log=True),
            psa.Parameter("m2", 1.4, "kg", (0.14, 14.0), "mass of the second", log=True),
        ],
    )  # fmt: skip


@pytest.mark.slow
def test_a_force_between_two_bodies_is_named_at_the_force_with_its_values() -> None:
    """900 N/m, 3 N.s/m and 1.2e6 N/m3 between 2 and 1.2 kg."""
    rng, t = np.random.default_rng(0), 2e-3 * np.arange(2000, dtype=np.float64)
    u = 20.0 * multisine(t, np.linspace(0.5, 12.0, 24, dtype=np.float64), rng)

    def rates(s: float, q: FloatArray) -> list[float]:
        d, w = q[0] - q[2], q[1] - q[3]
        spring = 900.0 * d + 1.2e6 * d**3 + 3.0 * w
        first = (np.interp(s, t, u) - spring - 2.0 * q[1] - 400.0 * q[0]) / 2.0
        return [q[1], first, q[3], (spring - 0.5 * q[3]) / 1.2]

    q = solve_ivp(rates, (0.0, t[-1]), [0.0] * 4, t_eval=t, rtol=1e-9, atol=1e-11, max_step=2e-3).y
    noise = 2e-5 * rng.standard_normal((2, len(t)))
    record = {"time": t, "force": u, "y1": q[0] + noise[0], "y2": q[2] + noise[1]}
    d = psa.diagnose(two_bodies(), record, hold="linear", leave_out=["hysteresis"])
    assert [c.effect for c in d.causes] == ["curve_of_stretch_in_spring"]
    assert d.causes[0].port == "the intermediate spring"
    values, name = d.model.values, "curve_of_stretch_in_spring"
    cubic = values[f"{name}_size"] * np.sin(values[f"{name}_angle"]) / values[f"{name}_range"] ** 3
    assert -cubic == pytest.approx(1.2e6, rel=0.02) or cubic == pytest.approx(1.2e6, rel=0.02)
    assert values["k"] == pytest.approx(900.0, rel=0.01)
    assert all(e.extended < 1.1 * e.noise < 0.05 * e.base for e in d.errors)


def test_the_places_of_intermediates() -> None:
    """A definition has no port, and what only adds to one rate is no place beside that rate."""
    model = two_bodies()
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
    for plain, same in zip(model.structure.f(*at), opened.structure.f(*at), strict=True):
        np.testing.assert_allclose(np.array(same), np.array(plain), rtol=1e-15)


def grazing(seed: int) -> tuple[psa.Model, dict[str, FloatArray]]:
    """Prey that predators eat, fewer per head the more there are: Holling's second type.

    The model lacks h = 0.02: it has a flow eaten = a x y between the two.
    """
    rng, t = np.random.default_rng(seed), 0.05 * np.arange(2000, dtype=np.float64)
    tones = np.linspace(0.02, 0.6, 12, dtype=np.float64)
    light, harvest = 1.0 + 0.3 * multisine(t, tones, rng), 0.08 + 0.04 * multisine(t, tones, rng)

    def rates(s: float, q: FloatArray) -> list[float]:
        x, y = q
        eaten = 0.05 * x * y / (1.0 + 0.02 * x)
        grown = np.interp(s, t, light) * x * (1.0 - x / 110.0)
        return [grown - eaten, 0.25 * eaten - (0.15 + np.interp(s, t, harvest)) * y]

    q = solve_ivp(
        rates, (0.0, t[-1]), [45.0, 15.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.05
    ).y
    prey, hunters = q + np.array([[0.5], [0.15]]) * rng.standard_normal(q.shape)
    x, y, eaten, *u = (ca.SX.sym(n) for n in ("x", "y", "eaten", "light", "harvest"))
    a, e, d, k = p = [ca.SX.sym(n) for n in ("a", "e", "d", "k")]
    rate = [u[0] * x * (1 - x / k) - eaten, e * eaten - (d + u[1]) * y]
    model = psa.ode_model(
        {"x": [x, y], "u": u, "p": p, "y": [x, y], "w": eaten, "wdef": a * x * y, "ode": rate},
        name="grazing",
        outputs=["prey", "hunters"],
        states=[psa.State("x", "1", "prey", 45.0, 45.0), psa.State("y", "1", "y", 15.0, 15.0)],
        parameters=[
            psa.Parameter("a", 0.04, "1", (0.004, 0.4), "eaten per head", log=True),
            psa.Parameter("e", 0.2, "1", (0.02, 2.0), "what of it is gained", log=True),
            psa.Parameter("d", 0.2, "1", (0.02, 2.0), "losses", log=True),
            psa.Parameter("k", 90.0, "1", (20.0, 900.0), "most that live", log=True),
        ],
    )
    record = {"time": t, "light": light, "harvest": harvest, "prey": prey, "hunters": hunters}
    return model, record


@pytest.mark.slow
def test_a_law_that_no_effect_of_the_table_has_is_told_as_a_formula(tmp_path: Path) -> None:
    model, record = grazing(0)
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
    patched = psa.patched_model(d)
    assert patched.values["a"] == pytest.approx(0.05, rel=0.02)
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
