"""Several outputs of one run: both ways give the same, columns are those of separate runs.

And exact steps where equations jump by the input, which is known at every instant of a step.
"""

import casadi as ca
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.simulation.exact.split import split_of
from psa_casadi.simulation.simulate import EXACT, STEPPER, Traced, Way, trace
from psa_casadi.simulation.start import start_on
from tests.any_model import own_models
from tests.simulation.exact_cases import composite, inputs, times, with_effect

SAMPLES = 300
Unknowns = list[str | int]
Case = tuple[psa.Model, tuple[str, ...], Unknowns, FloatArray, FloatArray, FloatArray]


def _motor() -> Case:
    """Current before speed, which is not the model's order; from a start amid motion."""
    model = own_models.motor()
    u = np.random.default_rng(7).standard_normal((SAMPLES, 1))
    unknowns: Unknowns = ["R", "J", 0, "b", 1]
    return model, ("i", "w"), unknowns, times(SAMPLES, 1e-3), u, np.array([0.3, -2.0])


def _stack() -> Case:
    """What the current depends on, too: the resistor, the capacitance, the stack's voltage."""
    model, t = with_effect("base"), times(SAMPLES, 1e-4)
    u = inputs(model, t, composite(SAMPLES))
    unknowns: Unknowns = ["C_p", model.state_names.index("u"), "R_s"]
    outputs = ("measured_displacement", "current", "charge")
    return model, outputs, unknowns, t, u, start_on(model, t, u).x


CASES = {"motor": _motor, "stack": _stack}


def _traced(case: Case, outputs: tuple[str, ...], hold: str, *, stepped: bool) -> Traced:
    """Run without `s0`: columns of initial states are one at their state."""
    model, _, unknowns, t, u, x0 = case
    way = Way(1e-8, 1e-10, stepped=stepped)
    return trace(model, t, u, x0, way=way, outputs=outputs, unknowns=unknowns, hold=hold)


def _off(values: FloatArray, true: FloatArray) -> float:
    """Return the largest difference of a column over its largest value."""
    size = np.abs(true).max(axis=0)
    assert (size > 0.0).all()
    return float((np.abs(values - true).max(axis=0) / size).max())


@pytest.mark.parametrize("hold", ["linear", "zero"])
@pytest.mark.parametrize("name", CASES)
def test_both_ways_give_the_same_outputs_and_sensitivities(name: str, hold: str) -> None:
    case = CASES[name]()
    exact, stepped = (_traced(case, case[1], hold, stepped=q) for q in (False, True))
    assert (exact.way, stepped.way) == (EXACT, STEPPER)
    assert exact.y.shape == stepped.y.shape == (SAMPLES, len(case[1]))
    shape = (SAMPLES, len(case[1]), len(case[2]))
    assert exact.sensitivity.shape == stepped.sensitivity.shape == shape
    assert _off(exact.y, stepped.y) < 1e-5
    assert _off(exact.sensitivity, stepped.sensitivity) < 1e-3


@pytest.mark.parametrize("stepped", [False, True], ids=[EXACT, STEPPER])
@pytest.mark.parametrize("name", CASES)
def test_a_column_has_the_bits_of_a_run_by_itself(name: str, stepped: bool) -> None:
    case = CASES[name]()
    together = _traced(case, case[1], "linear", stepped=stepped)
    for k, output in enumerate(case[1]):
        alone = _traced(case, (output,), "linear", stepped=stepped)
        np.testing.assert_array_equal(alone.y[:, 0], together.y[:, k])
        np.testing.assert_array_equal(alone.sensitivity[:, 0], together.sensitivity[:, k])


@pytest.mark.parametrize("stepped", [False, True], ids=[EXACT, STEPPER])
def test_columns_are_differences_of_runs(stepped: bool) -> None:
    case = _motor()
    model, outputs, unknowns, t, u, x0 = case
    result = _traced(case, outputs, "linear", stepped=stepped).sensitivity
    rows = [model.output_names.index(n) for n in outputs]
    for column, unknown in enumerate(unknowns):
        ends = []
        for sign in (1.0, -1.0):
            values, start = dict(model.values), x0.copy()
            if isinstance(unknown, str):
                values[unknown] *= 1.0 + 1e-4 * sign
            else:
                start[unknown] += 1e-2 * sign
            ends.append(psa.run(model, t, u, start, rtol=1e-11, values=values).y[:, rows])
        step = 1e-4 * model.values[unknown] if isinstance(unknown, str) else 1e-2
        assert _off(result[:, :, column], (ends[0] - ends[1]) / (2.0 * step)) < 1e-5, unknown


FORCE = ca.SX.sym("f")
#: Of a force in [-1, 1]: a corner behind a dead zone, jumps, and one next to a straight part.
BY_INPUT = {
    "dead zone": ca.sign(FORCE) * ca.fmax(ca.fabs(FORCE) - 0.3, 0.0),
    "branch": ca.if_else(FORCE > 0.3, FORCE - 0.3, 0.0),
    "relay": ca.sign(FORCE),
    "relay beside a gain": 0.2 * FORCE + ca.sign(FORCE),
}


def _driven_by(force: ca.SX) -> psa.Model:
    x, v, k = (ca.SX.sym(n) for n in "xvk")
    return psa.ode_model(
        {
            "x": [x, v], "u": FORCE, "p": k, "y": [v, x],
            "ode": [v, k * force - 4.0 * x - 0.3 * v],
        },
        name="driven",
        outputs=["speed", "place"],
        parameters=[psa.Parameter("k", 1.0, "1", (0.1, 10.0), "gain")],
    )  # fmt: skip


@pytest.mark.parametrize("hold", ["linear", "zero"])
@pytest.mark.parametrize("name", BY_INPUT)
def test_equations_that_jump_by_the_input_take_exact_steps(name: str, hold: str) -> None:
    """The stepper at the same tolerance errs by 5e-5 to 4e-4 where the force is linear."""
    model, t, x0 = _driven_by(BY_INPUT[name]), times(400, 0.05), np.zeros(2)
    u = np.sin(1.3 * t)[:, None]
    unknowns: Unknowns = ["k"]
    case = (model, ("place", "speed"), unknowns, t, u, x0)
    way = Way(1e-6, 1e-6)
    traced = trace(model, t, u, x0, way=way, outputs=case[1], unknowns=unknowns, hold=hold)
    fine = _traced(case, case[1], hold, stepped=True)
    assert traced.way == EXACT
    assert np.max(np.abs(traced.y - fine.y) / np.ptp(fine.y, axis=0)) < 1e-5
    assert _off(traced.sensitivity, fine.sensitivity) < 1e-5


def test_equations_that_jump_by_a_state_or_the_time_do_not_split() -> None:
    x, time = ca.SX.sym("x"), ca.SX.sym("time")
    for jump in (ca.sign(x), ca.if_else(time > 1.0, FORCE, 0.0)):
        model = psa.ode_model(
            {"x": x, "u": FORCE, "t": time, "ode": FORCE - jump, "y": x}, name="j"
        )
        assert split_of(model.structure) == "its equations jump"
