"""The stepper: accuracy, order, stability, cost, independence of the samples; starts and errors."""

import numpy as np
import pytest
from scipy.linalg import expm

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.start.ordinary import chosen_start
from psa_casadi.model.components.stack import drive
from psa_casadi.model.structure import structure_of
from psa_casadi.model.variables import Provenance
from psa_casadi.simulation.compiler import fingerprint, generate_c
from psa_casadi.simulation.simulate import input_samples
from psa_casadi.simulation.start import start_state
from psa_casadi.simulation.stepper import SimulationError
from tests.model.stack_models import LINEAR, jacobian, sine, stack


@pytest.mark.parametrize(
    ("model", "factor"),
    [
        (stack("P-885.51", **LINEAR), 10.0),
        (stack("P-885.51"), 30.0),  # a step over a reversal errs by more than its estimate
        (stack("PTBS200"), 150.0),  # a light resonance adds up the errors of its many periods
    ],
    ids=["linear", "hysteresis", "ringing"],
)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_result_does_not_depend_on_how_the_time_is_cut(
    model: psa.Model, factor: float, rtol: float
) -> None:
    t = np.linspace(0.0, 2e-2, 41)
    v = sine(t, 100.0)
    whole = psa.simulate(model, t, v, rtol=rtol)
    for seed in range(3):
        cuts = np.random.default_rng(seed).uniform(0.0, t[-1], 300)
        cut = np.union1d(t, cuts)
        pieces = psa.simulate(model, cut, np.interp(cut, t, v), rtol=rtol)
        difference = pieces.displacement[np.isin(cut, t)] - whole.displacement
        assert pieces.steps > whole.steps + 100
        assert np.abs(difference).max() < factor * rtol * np.ptp(whole.displacement)


def stepped(model: psa.Model, t: FloatArray, voltage: FloatArray) -> int:
    """Steps of the stepper at 1e-6 from rest at zero."""
    u = input_samples(model, t.size, {"voltage": voltage})
    start = start_state(model, [0.0, 0.0]).x
    return psa.run(model, t, u, start, rtol=1e-6).steps


@pytest.mark.parametrize("form", ["sine 1 Hz", "sine 5 Hz", "triangle", "steps"])
def test_a_fast_resonance_costs_no_more_steps_than_a_slow_stack(form: str) -> None:
    """200 Hz for 10 s: 21 kHz, damping 0.03, against a lag of 20 ms on overdamped mechanics."""
    t = np.arange(2000) / 200.0
    voltage = {
        "sine 1 Hz": sine(t, 1.0),
        "sine 5 Hz": sine(t, 5.0),
        "triangle": 120.0 * (1.0 - np.abs(2.0 * (t % 1.0) - 1.0)),
        "steps": np.where((2 * t).astype(int) % 2, 80.0, 20.0),
    }[form]
    ringing, slow = stack("PTBS200"), stack("WYDS0808020", tau=2e-2)
    poles = np.linalg.eigvals(jacobian(ringing))
    light = max(poles, key=lambda pole: abs(pole.imag) / max(abs(pole), 1.0))
    assert 2 * np.pi * 19e3 < np.abs(light) < 2 * np.pi * 23e3
    assert -light.real / np.abs(light) < 0.04
    steps = [stepped(model, t, voltage) for model in (ringing, slow)]
    assert steps[0] < 1.2 * steps[1]
    assert steps[0] < 3.3 * len(t)  # a step ends at every reversal, two in 40 samples at 5 Hz
    if form in ("sine 1 Hz", "triangle"):
        assert steps[0] > 0.8 * steps[1]


@pytest.mark.parametrize(
    ("rtol", "counts", "order"), [(4e-6, (32, 64, 128), 4), (1e6, (64, 128, 256), 2)]
)
def test_order_of_the_method_at_its_tolerances(
    rtol: float, counts: tuple[int, ...], order: int
) -> None:
    """A linear stack on a ramp, equal steps: the error against the matrix exponential."""
    model = stack("P-885.51", **LINEAR)
    a = jacobian(model)
    p, end, rate = model.parameter_vector(), 1e-3, 1e5
    nx = len(a)
    b = np.array(model.structure.f(0.0, np.zeros(nx), [rate, 0.0], p)[0]).ravel()
    whole = np.zeros((nx + 2, nx + 2))  # x' = a x + b s, s' = 1
    whole[:nx, :nx], whole[:nx, nx], whole[nx, nx + 1] = a, b, 1.0
    truth = (expm(whole * end) @ np.eye(nx + 2)[-1])[:nx]
    t, u = np.array([0.0, end]), np.array([[0.0, 0.0], [rate * end, 0.0]])
    errors = []
    for count in counts:
        steps = psa.run(model, t, u, np.zeros(nx), rtol=rtol, max_step=end / count * (1 + 1e-9))
        assert count <= steps.steps <= 1.1 * count
        errors.append(np.abs(steps.x[-1] - truth)[5] / truth[5])
    assert errors[0] < 1e-3
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all((orders > order - 0.4) & (orders < order + 0.6)), orders


def test_a_step_far_longer_than_the_drive_does_not_ring() -> None:
    """One step of 10^5 R_s C_p: L-stable methods forget the start, a trapezoid flips its sign."""
    model = psa.compose((drive,), {"R_s": 10.0, "C_p": 1e-6})
    t = np.arange(4.0)
    steps = psa.run(model, t, np.zeros((4, 1)), np.array([100.0]), rtol=1e9)
    assert steps.steps == 3
    assert np.all(np.abs(steps.x[1:]) < 1e-2)
    rising = psa.run(model, t, np.full((4, 1), 70.0), np.array([0.0]), rtol=1e9)
    np.testing.assert_allclose(rising.x[1:, 0], 70.0, rtol=0, atol=1e-2)


def test_zero_order_hold_is_the_drive_s_exponential() -> None:
    model = stack("PTBS200")
    t = np.arange(31) * 1e-5
    v = np.where(t < 1e-4, 50.0, -20.0)
    result = psa.simulate(model, t, v, hold="zero", from_rest_at_zero=True, rtol=1e-9).states["u"]
    rc = model.values["R_s"] * model.values["C_p"]
    u = [0.0]
    for level in v[:-1]:
        u.append(level + (u[-1] - level) * np.exp(-1e-5 / rc))
    np.testing.assert_allclose(result, u, rtol=0, atol=1e-6)


def test_load_force_meets_the_bonding_layers() -> None:
    model = stack("PTBS200")
    t = np.linspace(0.0, 0.1, 11)
    held = psa.simulate(model, t, np.zeros(11), load_force=np.full(11, 300.0))
    np.testing.assert_allclose(held.displacement, 300.0 / model.values["k_B"], rtol=1e-9)
    assert not held.states["y"].any()
    step = psa.simulate(
        model, t, np.zeros(11), load_force=np.full(11, 300.0), from_rest_at_zero=True, rtol=1e-9
    )
    assert step.displacement[0] == 0.0
    assert step.displacement[-1] == pytest.approx(300.0 / model.values["k_B"], rel=1e-6)


def test_a_failure_names_state_and_time() -> None:
    model = stack("PTBS200", A=-5.0, beta=-40.0, gamma=0.0, n=2.0)
    t = np.linspace(0.0, 1.0, 11)
    where = r"t = 0\.0\d+ s in state 'f_(H|out)'.*loosen the tol"
    with pytest.raises(SimulationError, match=where):
        psa.simulate(model, t, 2000.0 * t)


def test_a_limit_of_steps_stops_a_costly_trial() -> None:
    model = stack("PTBS200")
    t = np.array([0.0, 1.0])
    u = np.array([[0.0, 0.0], [100.0, 0.0]])
    done = psa.run(model, t, u, np.zeros(7))
    assert done.steps > 5
    with pytest.raises(SimulationError, match="too many steps"):
        psa.run(model, t, u, np.zeros(7), steps_limit=5)


def test_the_steps_of_a_whole_run_are_bounded() -> None:
    """As many as it takes are enough, one less is not."""
    model = stack("P-885.51", **LINEAR)
    t = np.linspace(0.0, 1e-2, 101)
    u = np.column_stack([50.0 * np.sin(600.0 * t), np.zeros_like(t)])
    x0 = np.zeros(len(model.state_names))
    whole = psa.run(model, t, u, x0)
    taken = whole.steps + whole.rejected
    assert psa.run(model, t, u, x0, steps_most=taken).steps == whole.steps
    with pytest.raises(SimulationError, match="too many steps"):
        psa.run(model, t, u, x0, steps_most=taken - 1)


def test_bad_samples_are_named() -> None:
    model, t = stack("PTBS200"), np.array([0.0, 0.1, 0.1])
    with pytest.raises(psa.InputError) as caught:
        psa.simulate(model, t, [0.0, np.nan, 1.0], load_force=[1.0])
    for words in ("do not strictly increase", "voltage has samples", "load_force has 1 samples"):
        assert words in str(caught.value)
    with pytest.raises(psa.InputError, match="no input 'load_force'"):
        psa.simulate(psa.compose((drive,)), [0.0, 1.0], [0.0, 1.0], load_force=[0.0, 0.0])
    with pytest.raises(psa.InputError) as caught:
        psa.run(model, np.array([0.0, 1.0]), np.zeros((2, 1)), np.zeros(3), hold="cubic")
    for words in ("array u has the shape (2, 1)", "array x0", "hold 'cubic'"):
        assert words in str(caught.value)


def test_a_fingerprint_differs_where_the_generated_text_does() -> None:
    structures = [structure_of(psa.BASE), structure_of(psa.BASE[:2])]
    structures += [structure_of((*psa.BASE, e)) for e in psa.EFFECTS.values() if not e.needs]
    prints = [fingerprint(s) for s in structures]
    texts = [repr(generate_c(s, sensitivities=True)) for s in structures]
    assert len(set(prints)) == len(set(texts)) == len(structures)
    assert fingerprint(structure_of.__wrapped__(psa.BASE)) == prints[0]


TIME = np.linspace(0.0, 0.02, 400)
VOLTAGE = 50.0 * (1.0 - np.cos(2 * np.pi * 100.0 * TIME))
RECORD = psa.Record(name="r", time=TIME, voltage=VOLTAGE, displacement=1e-7 * VOLTAGE)


def _extended() -> psa.Model:
    names = ("structural_mode", "hysteresis_memory", "load_stiffness", "slow_creep")
    stack = psa.stack_model("P-885.51")
    model = stack.with_components((*stack.components, *(psa.EFFECTS[n] for n in names)))
    return model.with_values({str(c.gain): 0.05 for c in model.effects})


@pytest.mark.parametrize(
    "model", [_extended(), psa.compose(psa.SIMPLIFIED)], ids=["extended cascade", "one mass"]
)
def test_another_stiffness_changes_forces_and_no_displacement(model: psa.Model) -> None:
    stiffness = "k_B" if "k_B" in model.values else "k"
    moved = chosen_start([], model, 3.0 * model.values[stiffness])[0]
    assert moved.values[stiffness] == pytest.approx(3.0 * model.values[stiffness])
    before, after = psa.simulate(model, TIME, VOLTAGE), psa.simulate(moved, TIME, VOLTAGE)
    size = np.ptp(before.displacement)
    assert np.max(np.abs(after.displacement - before.displacement)) < 1e-6 * size
    ratio = np.ptp(after.outputs["blocked_force"]) / np.ptp(before.outputs["blocked_force"])
    assert ratio == pytest.approx(3.0, rel=1e-4)


def test_a_start_states_whether_its_force_scale_is_known() -> None:
    stack = psa.stack_model("P-885.51")
    assumed = stack.with_values({}, provenance=Provenance(force_scale="assumed"))
    model = stack.with_values({}, provenance=Provenance(force_scale="given"))
    assert chosen_start([RECORD], None, None)[1] is False
    assert chosen_start([RECORD], None, 6e7)[1] is True
    assert chosen_start([RECORD], assumed, None) == (assumed, False)
    assert chosen_start([RECORD], model, None) == (model, True)
    both, known = chosen_start([RECORD], assumed, 6e7)
    assert known
    assert both.values["k_B"] == pytest.approx(6e7)
