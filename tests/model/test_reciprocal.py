"""Reciprocal coupling: Newton's third law at gain 1, the paper's cascade at 0, stable between."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.records import time_grid
from tests.model.random_models import random_model, random_point
from tests.model.stack_models import LINEAR, PAPER_STACKS, jacobian, stack
from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.mechanics import two_masses
from tests.studies.plants.stack import Stack

EFFECT = psa.EFFECTS["reciprocal_coupling"]
FASTEST = 1e-7


def reciprocal(name: str, gain: float, **changes: float) -> psa.Model:
    return stack(name, **changes).with_effect(EFFECT, {"reciprocal_gain": gain})


def plant(name: str, **changes: float) -> Stack:
    p = {key: figure.value for key, figure in psa.STACKS[name].values.items()} | changes
    own = {q: p[q] for q in ("u_rated", "beta", "gamma", "delta", "n", "h_ref", "tau")}
    return Stack(
        r_s=p["R_s"], c_p_el=p["C_p"], k_l=p["k_L"], a=p["A"], m_p=p["m_P"], c_p=p["c_P"],
        k_p=p["k_P"], m_b=p["m_B"], c_b=p["c_B"], k_b=p["k_B"], **own,
    )  # fmt: skip


def driven(name: str, duration: float, samples: int) -> Run:
    """A plant under a step, a hold and a slower swing."""
    s = plant(name)
    time = time_grid(duration, duration / samples)
    phase = time / duration
    swing = 0.3 * np.sin(6.0 * np.pi * np.clip(phase - 0.4, 0.0, 0.5)) ** 2
    voltage = s.u_rated * np.where(phase > 0.0, 0.5 + swing, 0.0)
    return simulate_base(s, time, voltage, 8)


@pytest.mark.parametrize("gain", [0.0, 0.4, 1.0])
def test_the_equations_are_those_of_remark_1(gain: float) -> None:
    """At any state; at 1 the forces between the masses are equal and opposite."""
    generator = np.random.default_rng(8)
    for _ in range(5):
        model = random_model((EFFECT,), generator, gains=False)
        model = model.with_values({"reciprocal_gain": gain})
        point = random_point(model, generator)
        p = model.values
        rate = np.array(
            model.structure.f(point.time, point.x, point.u, model.parameter_vector())[0]
        ).ravel()
        z = dict(zip(model.state_names, point.x, strict=True))
        dz = dict(zip(model.state_names, rate, strict=True))
        pull = p["c_B"] * (z["v_x"] - z["v_y"]) + p["k_B"] * (z["x"] - z["y"])
        elastic = p["c_P"] * z["v_y"] + p["k_P"] * z["y"]
        size = abs(z["f_out"]) + abs(pull) + abs(elastic) + abs(point.u[1])
        wafers = p["m_P"] * dz["v_y"] + elastic - z["f_out"] - gain * pull
        tip = p["m_B"] * dz["v_x"] + pull - (1 - gain) * elastic - point.u[1]
        assert abs(wafers) < 1e-12 * size
        assert abs(tip) < 1e-12 * size
        assert (dz["y"], dz["x"]) == (z["v_y"], z["v_x"])
        if gain == 1.0:
            whole_stack = p["m_P"] * dz["v_y"] + p["m_B"] * dz["v_x"]
            assert whole_stack == pytest.approx(z["f_out"] - elastic + point.u[1], abs=1e-11 * size)


@pytest.mark.parametrize("name", PAPER_STACKS)
def test_a_step_is_that_of_two_masses_with_action_and_reaction(name: str) -> None:
    """With hysteresis, against matrices and an exponential; the cascade is far away."""
    run = driven(name, 2e-3, 2000)
    truth = two_masses(run)
    found, one_way = (
        psa.simulate(reciprocal(name, g), run.times, run.command, from_rest_at_zero=True, rtol=1e-8)
        for g in (1.0, 0.0)
    )
    size = np.ptp(truth)
    assert np.abs(found.displacement - truth).max() < 2e-5 * size
    assert np.abs(one_way.displacement - run.displacement).max() < 2e-5 * np.ptp(run.displacement)
    ratio = truth[-1] / run.displacement[-1]
    assert np.abs(truth - ratio * run.displacement).max() > 2e-3 * size


@pytest.mark.parametrize("gain", [0.0, 0.5, 1.0])
def test_the_static_gain_is_what_the_equations_say(gain: float) -> None:
    """x/u = k_L (1 + (1-g) k_P/k_B) / (k_P (1 - g + g^2)): series compliance at 0, 1/k_P at 1."""
    model = reciprocal("P-885.51", gain, **LINEAR)
    p = model.values
    time = time_grid(4e-3, 2e-6)
    x = psa.simulate(model, time, np.where(time > 0.0, 100.0, 0.0), from_rest_at_zero=True)
    expected = (1 + (1 - gain) * p["k_P"] / p["k_B"]) / (p["k_P"] * (1 - gain + gain**2))
    assert x.displacement[-1] == pytest.approx(100.0 * p["k_L"] * expected, rel=1e-5)
    if gain == 0.0:
        assert expected == pytest.approx(1 / p["k_P"] + 1 / p["k_B"])


@pytest.mark.parametrize("gain", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", ["PTBS200", "P-885.51"])
def test_the_blocked_force_holds_the_output_at_zero(name: str, gain: float) -> None:
    """Applied against the output as a load, it keeps x at 0, also while the stack rings."""
    model = reciprocal(name, gain)
    time = time_grid(1e-3, FASTEST)
    voltage = 100.0 * (1.0 - np.cos(4e3 * np.pi * time))
    free = psa.simulate(model, time, voltage, from_rest_at_zero=True, rtol=1e-8)
    force = free.outputs["blocked_force"]
    held = psa.simulate(model, time, voltage, load_force=-force, from_rest_at_zero=True, rtol=1e-8)
    assert np.abs(held.displacement).max() < 1e-4 * np.ptp(free.displacement)
    same = held.outputs["blocked_force"]
    np.testing.assert_allclose(same, force, rtol=0, atol=1e-4 * np.ptp(force))


@pytest.mark.parametrize("seed", range(5))
def test_every_gain_from_0_to_1_is_stable(seed: int) -> None:
    """Masses, dampings and stiffnesses over decades: every pole lies on the left."""
    rng = np.random.default_rng(seed)
    for _ in range(8):
        span = 10.0 ** rng.uniform(-1.5, 1.5, 6)
        names = ("m_P", "c_P", "k_P", "m_B", "c_B", "k_B")
        base = stack("PTBS200").values
        changes = {n: base[n] * f for n, f in zip(names, span, strict=True)}
        for gain in (0.0, rng.uniform(), 1.0, min(1.2, 1.0 + changes["m_B"] / changes["m_P"])):
            poles = np.linalg.eigvals(jacobian(reciprocal("PTBS200", gain, **changes)))
            decaying = poles[np.abs(poles) > 1e-3 * np.abs(poles).max()]
            slowest = np.sort(np.abs(poles))[1]  # f_H, without hysteresis, is the one at zero
            assert decaying.real.max() < 0.0
            assert poles.real.max() < 1e-9 * slowest


def test_energy_is_only_lost_in_the_dampers() -> None:
    """After a pulse the energy never grows at gain 1; the one-way cascade lets wafers pump."""
    grown = {}
    for gain in (1.0, 0.0):
        model = reciprocal("PTBS200", gain, **LINEAR, R_s=0.1, tau=1e-6)
        time = time_grid(2e-4, FASTEST)
        pulse = np.where(time < 8e-6, 100.0, 0.0)
        run = psa.simulate(model, time, pulse, from_rest_at_zero=True, rtol=1e-9)
        p, z = model.values, run.states
        energy = 0.5 * (
            p["m_P"] * z["v_y"] ** 2
            + p["m_B"] * z["v_x"] ** 2
            + p["k_P"] * z["y"] ** 2
            + p["k_B"] * (z["x"] - z["y"]) ** 2
        )
        free = energy[time > 3e-5]
        grown[gain] = np.diff(free).max() / free[0]
        assert free[-1] < 0.9 * free[0]
    assert grown[1.0] < 1e-8
    assert grown[0.0] > 1e-3
