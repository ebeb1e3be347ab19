"""The state at the start of a record, its derivatives, and how they go on into a run."""

import numpy as np
import pytest

from psa_casadi.effects import EFFECTS
from psa_casadi.model.stacks import STACKS
from psa_casadi.simulation.simulate import simulate
from psa_casadi.simulation.start import initial_slope, start_state
from psa_casadi.simulation.stepper import run
from tests.stack_models import FloatArray, jacobian, sine, stack
from tests.tiers import slow


@pytest.mark.parametrize(
    "effects", [(), pytest.param(tuple(EFFECTS), marks=slow)], ids=["base", "all"]
)
@pytest.mark.parametrize("name", sorted(STACKS))
def test_rest_is_rest(name: str, effects: tuple[str, ...]) -> None:
    model = stack(name)
    gains = {"creep_gain": 0.05, "mode_gain": 0.1, "memory_gain": 0.1, "sensor_delay": 1e-3}
    for effect in effects:
        model = model.with_effect(EFFECTS[effect])
    model = model.with_values({k: v for k, v in gains.items() if k in model.values})
    memory = {"f_H": 0.3 * model.values["h_ref"]}
    inputs = [{"voltage": 80.0, "load_force": 50.0}.get(n, 293.15) for n in model.input_names]
    start = start_state(model, inputs, memory=memory)
    rate = np.array(model.structure.f(0.0, start.x, inputs, model.parameter_vector())[0])
    size = model.state_nominals()
    assert start.x[model.state_names.index("u")] == pytest.approx(80.0, rel=1e-12)
    assert start.x[model.state_names.index("f_H")] == memory["f_H"]
    fastest = np.abs(np.linalg.eigvals(jacobian(stack(name)))).max()
    assert np.all(np.abs(rate.ravel()) < 1e-9 * fastest * size)
    held = simulate(model, [0.0, 0.1, 2.0], [80.0] * 3, load_force=[50.0] * 3, memory=memory)
    assert np.ptp(held.displacement) < 1e-9 * held.displacement[0]


def test_a_memory_that_relaxes_in_a_bent_model_leaves_the_others_at_rest() -> None:
    """They only follow it."""
    gains = {"saturation_gain": 0.1, "leak_gain": 0.1}
    model = stack("P-885.51")
    for effect in ("saturation_of_strain", "charge_leakage"):
        model = model.with_effect(EFFECTS[effect])
    model = model.with_values(gains)
    start = start_state(model, [60.0, 0.0], memory={"leak_voltage": 9.0})
    rate = np.array(model.structure.f(0.0, start.x, [60.0, 0.0], model.parameter_vector())[0])
    shares = np.abs(rate.ravel()) / model.state_nominals()
    fast = np.array([not s.memory for s in model.structure.states])
    assert shares[model.state_names.index("leak_voltage")] > 1e-2
    assert np.max(shares[fast]) < 1e-2


@pytest.mark.parametrize("name", sorted(STACKS))
def test_a_record_that_starts_in_motion_starts_without_a_transient(name: str) -> None:
    """The start on a ramp is the state that a long ramp has led to."""
    model = stack(name)
    p = model.values
    end = max(0.04, 200 * p["tau"])
    rate = 0.5 * p["u_rated"] / end
    bend = p["tau"] * abs(p["delta"]) / (p["k_L"] + p["A"])  # delta bends the ramp of the force
    t = np.linspace(0.0, end, 41)
    led = simulate(model, t, rate * t, from_rest_at_zero=True, rtol=1e-10)
    memory = {"f_H": float(led.states["f_H"][-1])}
    moving = start_state(model, [rate * t[-1], 0.0], [rate, 0.0], memory, t[-1]).x
    still = start_state(model, [rate * t[-1], 0.0], None, memory, t[-1]).x
    for k, state in enumerate(model.state_names):
        off, lag = (abs(x[k] - led.states[state][-1]) for x in (moving, still))
        assert off <= (1e-3 + bend) * lag + 1e-9 * model.state_nominals()[k], state
    assert abs(still[0] - led.states["u"][-1]) > 1e-5 * p["u_rated"]


def test_start_derivatives_are_differences_of_starts() -> None:
    model = stack("WYDS0808020").with_effect(EFFECTS["slow_creep"], {"creep_gain": 0.05})
    inputs, rates, memory = [60.0, 20.0], [3e3, 0.0], {"f_H": -30.0, "z_c2": 2e-7}
    start = start_state(model, inputs, rates, memory)
    for k, name in enumerate(model.parameter_names):
        step = 1e-5 * model.parameter(name).typical(model.values)
        ends = [
            start_state(model.with_values({name: model.values[name] + h}), inputs, rates, memory).x
            for h in (step, -step)
        ]
        found = (ends[0] - ends[1]) / (2 * step) * model.parameter(name).typical(model.values)
        exact = start.by_parameter[:, k] * model.parameter(name).typical(model.values)
        assert np.all(np.abs(found - exact) <= 1e-7 * (np.abs(exact) + model.state_nominals()))
    names = ("f_H", "z_c1", "z_c2", "z_c3")
    assert start.by_memory.shape == (len(start.x), len(names))
    for k, name in enumerate(names):
        size = model.state_nominals()[model.state_names.index(name)]
        moved = [{**memory, name: memory.get(name, 0.0) + h * size} for h in (1e-5, -1e-5)]
        ends = [start_state(model, inputs, rates, m).x for m in moved]
        found = (ends[0] - ends[1]) / 2e-5
        exact = start.by_memory[:, k] * size
        assert np.all(np.abs(found - exact) <= 1e-7 * (np.abs(exact) + model.state_nominals()))


def test_sensitivity_to_a_start_is_the_difference_of_runs() -> None:
    model = stack("P-885.51")
    t = np.linspace(0.0, 1e-3, 2001)
    u = np.column_stack([sine(t, 700.0), 0.0 * t])
    start: FloatArray = 0.1 * model.state_nominals()
    unknowns = [model.state_names.index(n) for n in ("f_H", "f_out", "x")]
    exact = run(model, t, u, start, rtol=1e-8, unknowns=unknowns).sensitivity
    assert exact is not None
    for column, k in enumerate(unknowns):
        step: FloatArray = 1e-3 * np.eye(len(start))[k] * model.state_nominals()
        ends = [run(model, t, u, start + sign * step, rtol=1e-8).y[:, -1] for sign in (1, -1)]
        found = (ends[0] - ends[1]) / (2 * step[k])
        size = np.abs(exact[:, column]).max()
        np.testing.assert_allclose(found, exact[:, column], rtol=0, atol=1e-4 * size)


def test_initial_slope_sees_motion_and_no_step() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    assert initial_slope(t, np.array([1.0, 1.3, 1.5, 1.9, 0.0])) == pytest.approx(2.0)
    assert initial_slope(t, np.array([1.0, 0.7, 0.5, 0.1, 9.0])) == pytest.approx(-2.0)
    assert initial_slope(t, np.array([1.0, 5.0, 5.0, 5.0, 5.0])) == 0.0
    assert initial_slope(t, np.array([1.0, 1.1, 1.0, 1.1, 1.0])) == 0.0
