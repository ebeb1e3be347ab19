"""Exact steps against the stepper and against the paper's equations in plain NumPy.

The stepper at 1e-10 errs by up to 9e-8 of the range over a record (PTBS200), at 1e-12 by 5e-9.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi import reference
from psa_casadi.component import Component
from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.effects import EFFECTS
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.stacks import STACKS
from psa_casadi.reference import Mechanics
from psa_casadi.simulation.exact.run import run_exact
from psa_casadi.simulation.simulate import EXACT, STEPPER, accurate, simulate
from psa_casadi.simulation.start import start_on
from tests.benchmarks.fits import demonstration
from tests.exact_cases import (
    BEAT,
    CUBIC,
    JUMP,
    LAG,
    OUTPUT,
    VOLTAGES,
    composite,
    error,
    inputs,
    stepped,
    times,
    voltage,
    with_effect,
)
from tests.stack_models import stack
from tests.test_agreement import stack_values

FloatArray = NDArray[np.float64]

RTOL = 1e-6
SAMPLES = 1500
#: A few of the stack's lags in a sample, and many of them.
SAMPLE_TIMES = (2e-5, 1e-3)
NAMES = ("base", *EFFECTS)
slow = pytest.mark.slow


def compare(
    model: Model, t: FloatArray, relative: FloatArray, rtol: float = RTOL, hold: str = "linear"
) -> tuple[float, str]:
    """Return the error of a run over the range, by a stepper that is far finer, and the way."""
    u = inputs(model, t, relative)
    x0 = start_on(model, t, u).x
    steps, way = accurate(model, t, u, x0, rtol=rtol, hold=hold)
    shown = steps.y[:, model.output_names.index(OUTPUT)]
    fine = max(1e-4 * rtol, 1e-12)
    return error(shown, stepped(model, t, u, x0, rtol=fine, hold=hold)), way


@pytest.mark.parametrize("name", NAMES)
def test_a_composite_record_agrees_with_the_stepper(name: str) -> None:
    """A sine, a ramp, a hold and a step; the stepper takes its 1500 steps and more."""
    found, way = compare(with_effect(name), times(SAMPLES, 1e-4), composite(SAMPLES))
    assert found <= RTOL
    # thresholds that follow the rate fall within a microsecond at a reversal: no step is so short
    assert way == EXACT or name == "rate_dependent_hysteresis"


@slow
@pytest.mark.parametrize("turn", range(len(NAMES)), ids=NAMES)
def test_every_stack_and_voltage_agrees_with_the_stepper(turn: int) -> None:
    """Every effect with three stacks in turn, and any two of stack, voltage and sample time.

    Voltage and sample time go round with effect and stack. One of the runs of an effect may be
    stepped: play behind a light resonance turns at every swing. Two where the loop follows the
    rate, whose notch at a turn is seen only by the finest steps.
    """
    ways = []
    names = sorted(STACKS)
    for k, stack_name in ((k, names[(turn + k) % len(names)]) for k in range(3)):
        kind = VOLTAGES[(turn + k) % len(VOLTAGES)]
        step = SAMPLE_TIMES[(turn // len(VOLTAGES) + k) % len(SAMPLE_TIMES)]
        share = np.linspace(0.0, 1.0, SAMPLES)
        model = with_effect(NAMES[turn], stack_name)
        found, way = compare(model, times(SAMPLES, step), voltage(kind, share))
        # where the stepper was taken it may err by what its own 0.0005 rtol a step adds up to
        assert found <= (RTOL if way == EXACT else 3 * RTOL), (stack_name, kind, step)
        ways.append(way)
    stepped_ones = 2 if NAMES[turn] == "rate_dependent_hysteresis" else 1
    assert ways.count(EXACT) >= len(ways) - stepped_ones


@pytest.mark.parametrize("rtol", [1e-5, *(pytest.param(r, marks=slow) for r in (1e-7, 1e-8))])
@pytest.mark.parametrize("name", ["base", "hysteresis_memory", "load_stiffness", "drive_lag"])
def test_the_error_keeps_to_other_tolerances(name: str, rtol: float) -> None:
    """Exact steps do not know their error to less than 1e-6: then the stepper is taken."""
    relative = np.concatenate([composite(300), voltage("triangle", np.linspace(0.0, 1.0, 300))])
    found, way = compare(with_effect(name), times(600, 1e-4), relative, rtol)
    assert found <= rtol
    assert way == (EXACT if rtol >= 1e-6 else STEPPER)


@pytest.mark.parametrize("name", ["base", "backlash", "voltage_saturation"])
def test_held_inputs_agree(name: str) -> None:
    """Every sample begins with a jump."""
    relative = voltage("steps", np.linspace(0.0, 1.0, 600)) + 0.05 * composite(600)
    found, way = compare(with_effect(name), times(600, 1e-4), relative, hold="zero")
    assert found <= RTOL
    assert way == EXACT or name == "voltage_saturation"  # a corner of the clip at every jump


@pytest.mark.parametrize("name", ["base", "backlash"])
def test_a_few_time_steps_in_one_record(name: str) -> None:
    t = np.cumsum(np.repeat([1e-4, 1e-3, 2.5e-5], 200))
    relative = voltage("sine", t / t[-1])
    found, way = compare(with_effect(name), t, relative)
    assert found <= RTOL
    assert way == EXACT


def test_an_irregular_time_base_is_stepped_and_says_so() -> None:
    model, rng = stack("P-885.51"), np.random.default_rng(3)
    t = 1e-3 * (np.arange(300) + 0.01 * rng.standard_normal(300))
    v = 60.0 * (1.0 - np.cos(20.0 * t))
    found = simulate(model, t, v)
    assert found.way == STEPPER
    regular = simulate(model, times(300, 1e-3), v)
    assert regular.way == EXACT
    # clocks tell times to a few digits only: that is no other step
    rounded = np.round(times(300, 1e-3), 9) + 1.0e-3 * 2e-7 * rng.standard_normal(300)
    assert simulate(model, rounded, v).way == EXACT


@pytest.mark.parametrize("name", ["base", "slow_creep", "sensor_delay"])
@pytest.mark.parametrize("shift", [np.pi / 2, np.pi], ids=["in motion", "at the top"])
def test_a_record_may_start_anywhere(name: str, shift: float) -> None:
    t = times(600, 1e-4)
    found, way = compare(with_effect(name), t, 0.4 * (1.0 - np.cos(300.0 * t + shift)))
    assert found <= RTOL
    assert way == EXACT


@pytest.mark.parametrize(
    ("component", "expected"),
    [(LAG, EXACT), (CUBIC, EXACT), (JUMP, STEPPER)],
    ids=["lag", "spring", "jump"],
)
def test_a_component_of_one_s_own_agrees_or_is_stepped(component: Component, expected: str) -> None:
    model = compose((*BASE, component), stack("P-885.51").values)
    t = times(200, 1e-3)
    found, way = compare(model, t, voltage("sine", t / t[-1]))
    assert found <= 2 * RTOL  # the stepper does not look for the jump
    assert way == expected


TONES = [2.5e-4, *(pytest.param(q, marks=slow) for q in (3.1e-4, 1.25e-4, 6.25e-5))]


@pytest.mark.parametrize("period", TONES)
def test_a_tone_whose_period_divides_a_sample_is_seen(period: float) -> None:
    """It looks constant at start, quarter, half and end of a sample."""
    values = {**stack("P-885.51").values, "beat_period": period}
    t = times(200, 1e-3)
    found, _ = compare(compose((*BASE, BEAT), values), t, voltage("sine", t / t[-1]))
    assert found <= RTOL


#: The quick tier has one stack with both mechanics, the full one every stack, in turn with either.
RAMPED = [
    ("P-885.51", "cascade"), ("P-885.51", "single_mass"),
    *(pytest.param(n, m, marks=slow) for n, m in (
        ("PTBS200", "cascade"), ("WYDS0808020", "single_mass"), ("demo", "single_mass"),
        ("micromanipulator", "cascade"),
    )),
]  # fmt: skip


@pytest.mark.parametrize(("stack_name", "mechanics"), RAMPED)
def test_ramps_and_holds_agree_with_the_reference(stack_name: str, mechanics: Mechanics) -> None:
    """Corners at samples, given to the reference as breakpoints; by exact steps and the stepper.

    The stepper is given the corners and every tenth sample only.
    """
    p = stack_values(stack_name, mechanics)
    corners = np.array([0.0, 0.05, 0.1, 0.101, 0.15, 0.35, 0.4])
    levels = np.array([0.0, 0.7, 0.7, 0.2, 0.2, 0.9, -0.1]) * p["u_rated"]
    t = times(401, 1e-3)
    model = compose(BASE if mechanics == "cascade" else SIMPLIFIED, p)
    found = simulate(model, t, np.interp(t, corners, levels), from_rest_at_zero=True)
    # its asymmetry goes on while the voltage comes to rest, which only the finest steps see
    assert found.way == EXACT or stack_name == "micromanipulator"
    path = reference.from_samples(corners, levels)
    every = slice(None, None, 10)
    true = reference.simulate(
        p, path, t[every], mechanics=mechanics, breakpoints=list(corners), rtol=1e-9
    )
    assert error(found.outputs["displacement"][every], true.displacement) <= RTOL
    few = np.union1d(t[every], corners)
    path_at_corners = np.interp(few, corners, levels)
    own = simulate(model, few, path_at_corners, from_rest_at_zero=True, rtol=1e-10)
    assert own.way == STEPPER
    shown = own.outputs["displacement"][np.isin(few, t[every])]
    assert error(shown, true.displacement) <= RTOL


def test_a_record_with_many_kinks_errs_by_less_than_a_step_may() -> None:
    """At the demonstration's kinks steps that were halved once where they err by far missed it."""
    task = demonstration()
    x0, _ = task.start(task.model)
    rough, fine = (
        run_exact(task.model, task.time, task.inputs, x0, tolerance=q, output=OUTPUT).shown
        for q in (1e-5, 1e-8)
    )
    assert np.max(np.abs(rough - fine)) <= 1e-5 * np.ptp(fine)
