"""Reciprocal coupling: Newton's third law at gain 1, the paper's cascade at 0, stable between."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.records import time_grid
from tests.model.random_models import random_model, random_point
from tests.model.stack_models import PAPER_STACKS, stack
from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.mechanics import two_masses
from tests.studies.plants.stack import Stack

EFFECT = psa.EFFECTS["reciprocal_coupling"]
FASTEST = 1e-7


def reciprocal(name: str, gain: float, **changes: float) -> psa.Model:
    return stack(name, **changes).with_effect(EFFECT, {"reciprocal_gain": gain})


def plant(name: str, **changes: float) -> Stack:
    p = {key: figure.value for key, figure in psa.STACKS[name].values.items()} | changes
    table = {q: p[q] for q in ("u_rated", "beta", "gamma", "delta", "n", "h_ref", "tau")}
    return Stack(
        r_s=p["R_s"], c_p_el=p["C_p"], k_l=p["k_L"], a=p["A"], m_p=p["m_P"], c_p=p["c_P"],
        k_p=p["k_P"], m_b=p["m_B"], c_b=p["c_B"], k_b=p["k_B"], **table,
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
    result, one_way = (
        psa.simulate(reciprocal(name, g), run.times, run.command, from_rest_at_zero=True, rtol=1e-8)
        for g in (1.0, 0.0)
    )
    size = np.ptp(truth)
    assert np.abs(result.displacement - truth).max() < 2e-5 * size
    assert np.abs(one_way.displacement - run.displacement).max() < 2e-5 * np.ptp(run.displacement)
    ratio = truth[-1] / run.displacement[-1]
    assert np.abs(truth - ratio * run.displacement).max() > 2e-3 * size


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
