"""Several outputs of one run, by both ways; what an effect adds along a model's course."""

import casadi as ca
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.model.ports import ports_of, with_ports
from psa_casadi.simulation.exact.split import split_of
from psa_casadi.simulation.simulate import EXACT, STEPPER, Traced, Way, input_samples, trace
from psa_casadi.simulation.start import start_for, start_on
from psa_casadi.simulation.tangent import answer, course_of, law_of, opened
from tests.any_model import own_models
from tests.any_model.own_models import oscillator
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
    "relay and gain": 0.2 * FORCE + ca.sign(FORCE),
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


_WAY = Way(1e-8, 1e-8)


def _both(
    base: psa.Model, effect: psa.Component, t: FloatArray, u: FloatArray,
    output: str = "measured_displacement", *, step: float = 0.0,
) -> tuple[FloatArray, FloatArray, float]:  # fmt: skip
    """Return what an effect adds (n,) along the course and in a simulation, and the error."""
    model = base.with_effect(effect).with_values({effect.gain or "": step})
    law = law_of(model.structure, effect)
    assert law is not None
    start = {s.name: 0.0 for s in model.structure.states if s.memory}
    table = {n: v for n, v in start.items() if n in base.state_names}
    course = course_of(base, t, u, table, way=_WAY, hold="linear", outputs=[output])
    result = answer(
        opened(base, [law]), law, model, course, u, start,
        finite=step != 0.0, way=_WAY, outputs=[output],
    )  # fmt: skip
    begin = start_for(model, t, u, start)
    column = model.parameter_names.index(effect.gain or "")
    whole = trace(
        model, t, u, begin.x, way=_WAY, outputs=[output], unknowns=[effect.gain or ""],
        s0=begin.by_parameter[:, [column]],
    )  # fmt: skip
    simulated = whole.y[:, 0] if step else whole.sensitivity[:, 0, 0]
    return result.y[:, 0, 0], simulated, result.error


#: Of a current limit the derivative at 0 is 0.
_LAWS = [
    e for e in psa.EFFECTS.values()
    if not (e.inputs or e.needs_column or e.trial_starts or e.name == "current_limit")
    and law_of(psa.compose([*psa.BASE, e]).structure, e) is not None
]  # fmt: skip


def _drive() -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0.0, 2.0, 2001)
    swing = np.sin(2 * np.pi * 1.7 * t) + 0.3 * np.sin(2 * np.pi * 11.0 * t)
    return t, input_samples(psa.compose(psa.BASE), t.size, {"voltage": 50.0 + 30.0 * swing})


def _measured_displacement(model: psa.Model, t: FloatArray, u: FloatArray) -> FloatArray:
    x0 = start_for(model, t, u, {}).x
    return trace(model, t, u, x0, way=_WAY, outputs=["measured_displacement"]).y[:, 0]


@pytest.mark.parametrize("effect", _LAWS, ids=lambda e: e.name)
def test_derivatives_along_the_course_are_those_of_the_whole_model(effect: psa.Component) -> None:
    t, u = _drive()
    added, simulated, error = _both(psa.compose(psa.BASE), effect, t, u)
    size = np.std(simulated)
    assert size > 0.0
    assert np.std(added - simulated) < max(4e-3, error) * size


def test_most_effects_of_the_table_need_no_separate_simulation() -> None:
    names = {e.name for e in _LAWS}
    assert len(names) >= 16
    assert not names & {"backlash", "hysteresis_memory", "rate_independent_asymmetry"}


@pytest.mark.parametrize(
    ("name", "size"), [("charge_leakage", 0.3), ("sensor_lag", 6e-3), ("drive_lag", 6e-3)]
)
def test_finite_gains_are_those_of_the_whole_model(name: str, size: float) -> None:
    t, u = _drive()
    added, simulated, error = _both(psa.compose(psa.BASE), psa.EFFECTS[name], t, u, step=size)
    effect = np.std(simulated - _measured_displacement(psa.compose(psa.BASE), t, u))
    assert np.std(added - simulated) < max(5e-3, error) * effect


def test_steps_that_the_samples_do_not_show_raise_the_error() -> None:
    """Self-heating by the voltage's way within a sample, and a lag of a millisecond."""
    t = np.linspace(0.0, 2.0, 201)
    steps = 50.0 + 30.0 * np.sign(np.sin(2 * np.pi * 3.0 * t))
    u = input_samples(psa.compose(psa.BASE), t.size, {"voltage": steps})
    for name in ("self_heating", "drive_lag"):
        *_, error = _both(psa.compose(psa.BASE), psa.EFFECTS[name], t, u)
        assert error > 0.1


def test_an_effect_with_states_at_two_ports_of_any_model() -> None:
    model = oscillator()
    names = {p.balance: p for p in ports_of(model)}
    rate = next(p for b, p in names.items() if b.startswith("rate_"))
    output = next(p for b, p in names.items() if b.startswith("shown_"))

    def equations(s: psa.Symbols) -> psa.Equations:
        x = getattr(s, model.state_names[0])
        return psa.Equations(
            der={"warmth": x**2 - s.warmth / s.cooling},
            add={rate.balance: -s.softening * s.warmth * x, output.balance: s.softening * s.warmth},
        )

    effect = psa.Component(
        name="softening", description="it softens with what it has moved", source="a test",
        equations=equations, gain="softening",
        parameters=(
            psa.Parameter("softening", 0.0, "1", (-1e3, 1e3), "size", scale=1.0),
            psa.Parameter("cooling", 0.7, "s", (1e-3, 1e3), "time"),
        ),
        states=(psa.State("warmth", "1", "what it remembers", 1.0),),
    )  # fmt: skip
    t = np.linspace(0.0, 6.0, 3001)
    u = np.stack([np.sin(3.0 * t + k) for k in range(len(model.input_names))], axis=1)
    added, simulated, error = _both(with_ports(model), effect, t, u, model.output_names[0])
    assert np.std(added - simulated) < max(1e-3, error) * np.std(simulated) > 0.0
