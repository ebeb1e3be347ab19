"""Exact steps against the stepper and the reference, and their exp and log to the last place."""

import ctypes
import re
from collections.abc import Iterator
from functools import cache
from importlib import resources

import casadi as ca
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.structure import structure_of
from psa_casadi.reference import Mechanics
from psa_casadi.simulation import stepper
from psa_casadi.simulation.compiler import FLAGS_VARIABLE, shared_library, vector_flags, zig_command
from psa_casadi.simulation.exact import run as exact
from psa_casadi.simulation.exact.run import run_exact, why_not
from psa_casadi.simulation.exact.split import Split, split_of
from psa_casadi.simulation.simulate import EXACT, STEPPER, accurate, record_inputs
from psa_casadi.simulation.start import start_on
from tests.export.c_host.build import tool
from tests.model.sampled_models import loop
from tests.model.stack_models import stack
from tests.model.test_reference import plant_values
from tests.simulation.exact_cases import (
    BEAT,
    CUBIC,
    FEEDBACK,
    JUMP,
    KINK,
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
from tests.tiers import slow

RTOL = 1e-6
SAMPLES = 1500
#: A few of the stack's lags in a sample, and many of them.
SAMPLE_TIMES = (2e-5, 1e-3)
NAMES = ("base", *psa.EFFECTS)


def compare(
    model: psa.Model, t: FloatArray, relative: FloatArray, rtol: float = RTOL, hold: str = "linear"
) -> tuple[float, str]:
    """Return the error of a run over the range, by a stepper that is far finer, and the way."""
    u = inputs(model, t, relative)
    x0 = start_on(model, t, u).x
    steps, way = accurate(model, t, u, x0, rtol=rtol, hold=hold)
    measured = steps.y[:, model.output_names.index(OUTPUT)]
    fine = max(1e-4 * rtol, 1e-12)
    return error(measured, stepped(model, t, u, x0, rtol=fine, hold=hold)), way


@pytest.mark.parametrize("name", NAMES)
def test_a_composite_record_agrees_with_the_stepper(name: str) -> None:
    """A sine, a ramp, a hold and a step; the stepper takes its 1500 steps and more."""
    result, way = compare(with_effect(name), times(SAMPLES, 1e-4), composite(SAMPLES))
    assert result <= RTOL
    # thresholds that follow the rate fall within a microsecond at a reversal: no step is so short
    assert way == EXACT or name == "rate_dependent_hysteresis"


@slow
@pytest.mark.parametrize("turn", range(len(NAMES)), ids=NAMES)
def test_every_stack_and_voltage_agrees_with_the_stepper(turn: int) -> None:
    """Every effect with three stacks in turn, and any two of stack, voltage and sample time.

    Voltage and sample time go round with effect and stack. One of the runs of an effect may be
    stepped: play behind a light resonance turns at every swing. Two where the loop follows the
    rate, whose notch at a turn only the finest steps show.
    """
    ways = []
    names = sorted(psa.STACKS)
    for k, stack_name in ((k, names[(turn + k) % len(names)]) for k in range(3)):
        kind = VOLTAGES[(turn + k) % len(VOLTAGES)]
        step = SAMPLE_TIMES[(turn // len(VOLTAGES) + k) % len(SAMPLE_TIMES)]
        share = np.linspace(0.0, 1.0, SAMPLES)
        model = with_effect(NAMES[turn], stack_name)
        result, way = compare(model, times(SAMPLES, step), voltage(kind, share))
        # where the stepper was taken it may err by what its 0.0005 rtol a step adds up to
        assert result <= (RTOL if way == EXACT else 3 * RTOL), (stack_name, kind, step)
        ways.append(way)
    stepped_ones = 2 if NAMES[turn] == "rate_dependent_hysteresis" else 1
    assert ways.count(EXACT) >= len(ways) - stepped_ones


@pytest.mark.parametrize("rtol", [1e-5, *(pytest.param(r, marks=slow) for r in (1e-7, 1e-8))])
@pytest.mark.parametrize("name", ["base", "hysteresis_memory", "load_stiffness", "drive_lag"])
def test_the_error_keeps_to_other_tolerances(name: str, rtol: float) -> None:
    """Exact steps do not know their error to less than 1e-6: then the stepper is taken."""
    relative = np.concatenate([composite(300), voltage("triangle", np.linspace(0.0, 1.0, 300))])
    result, way = compare(with_effect(name), times(600, 1e-4), relative, rtol)
    assert result <= rtol
    assert way == (EXACT if rtol >= 1e-6 else STEPPER)


_EVEN, _SLOW = times(600, 1e-4), times(200, 1e-3)
_UNEVEN = np.cumsum(np.repeat([1e-4, 1e-3, 2.5e-5], 200))
_JUMPING = voltage("steps", np.linspace(0.0, 1.0, 600)) + 0.05 * composite(600)
#: Effect or component, times, voltage over the rated one, hold.
CASES: list[tuple[str | psa.Component, FloatArray, FloatArray, str]] = [
    *((n, _EVEN, _JUMPING, "zero") for n in ("base", "backlash", "voltage_saturation")),
    *((n, _UNEVEN, voltage("sine", _UNEVEN / _UNEVEN[-1]), "linear") for n in ("base", "backlash")),
    *(
        (n, _EVEN, 0.4 * (1.0 - np.cos(300.0 * _EVEN + shift)), "linear")
        for n in ("base", "slow_creep", "sensor_delay")
        for shift in (np.pi / 2, np.pi)  # in motion, at the top
    ),
    *((c, _SLOW, voltage("sine", _SLOW / _SLOW[-1]), "linear") for c in (LAG, CUBIC, JUMP)),
]


@pytest.mark.parametrize(("what", "t", "relative", "hold"), CASES, ids=range(len(CASES)))
def test_held_inputs_few_time_steps_any_start_and_user_components_agree(
    what: str | psa.Component, t: FloatArray, relative: FloatArray, hold: str
) -> None:
    """The stepper is taken for a corner of the clip at every jump, and where equations jump."""
    if isinstance(what, psa.Component):
        model, most = psa.compose((*psa.BASE, what), stack("P-885.51").values), 2 * RTOL
    else:
        model, most = with_effect(what), RTOL
    result, way = compare(model, t, relative, hold=hold)
    assert result <= most  # the stepper does not look for the jump
    assert way == (STEPPER if what is JUMP else EXACT) or what == "voltage_saturation"


def test_an_irregular_time_base_is_stepped_and_that_is_reported() -> None:
    model, rng = stack("P-885.51"), np.random.default_rng(3)
    t = 1e-3 * (np.arange(300) + 0.01 * rng.standard_normal(300))
    v = 60.0 * (1.0 - np.cos(20.0 * t))
    result = psa.simulate(model, t, v)
    assert result.way == STEPPER
    regular = psa.simulate(model, times(300, 1e-3), v)
    assert regular.way == EXACT
    # clocks have a few digits only: that is no other step
    rounded = np.round(times(300, 1e-3), 9) + 1.0e-3 * 2e-7 * rng.standard_normal(300)
    assert psa.simulate(model, rounded, v).way == EXACT


TONES = [2.5e-4, *(pytest.param(q, marks=slow) for q in (3.1e-4, 1.25e-4, 6.25e-5))]


@pytest.mark.parametrize("period", TONES)
def test_a_tone_whose_period_divides_a_sample_is_resolved(period: float) -> None:
    """It looks constant at start, quarter, half and end of a sample."""
    values = {**stack("P-885.51").values, "beat_period": period}
    t = times(200, 1e-3)
    result, _ = compare(psa.compose((*psa.BASE, BEAT), values), t, voltage("sine", t / t[-1]))
    assert result <= RTOL


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
    """Corners at samples, which the reference has as breakpoints; by exact steps and the stepper.

    The stepper has the corners and every tenth sample only.
    """
    p = plant_values(stack_name, mechanics)
    corners = np.array([0.0, 0.05, 0.1, 0.101, 0.15, 0.35, 0.4])
    levels = np.array([0.0, 0.7, 0.7, 0.2, 0.2, 0.9, -0.1]) * p["u_rated"]
    t = times(401, 1e-3)
    model = psa.compose(psa.BASE if mechanics == "cascade" else psa.SIMPLIFIED, p)
    result = psa.simulate(model, t, np.interp(t, corners, levels), from_rest_at_zero=True)
    # its asymmetry goes on while the voltage comes to rest, which only the finest steps see
    assert result.way == EXACT or stack_name == "micromanipulator"
    path = reference.from_samples(corners, levels)
    every = slice(None, None, 10)
    true = reference.simulate(
        p, path, t[every], mechanics=mechanics, breakpoints=list(corners), rtol=1e-9
    )
    assert error(result.outputs["displacement"][every], true.displacement) <= RTOL
    few = np.union1d(t[every], corners)
    path_at_corners = np.interp(few, corners, levels)
    rare = psa.simulate(model, few, path_at_corners, from_rest_at_zero=True, rtol=1e-10)
    assert rare.way == STEPPER
    displacement = rare.outputs["displacement"][np.isin(few, t[every])]
    assert error(displacement, true.displacement) <= RTOL


def test_a_record_with_many_kinks_errs_by_less_than_a_step_may() -> None:
    """At the demonstration's kinks, halving a step once where it errs by far is not enough."""
    with resources.as_file(resources.files("psa_casadi").joinpath("data", "demo.csv")) as path:
        record = psa.read_record(path)
    model, t = starting_model([record]), np.asarray(record.time - record.time[0])
    u = record_inputs(model, record, record.n)
    x0 = start_on(model, t, u).x
    rough, fine = (
        run_exact(model, t, u, x0, tolerance=q, outputs=(OUTPUT,)).requested for q in (1e-5, 1e-8)
    )
    assert np.max(np.abs(rough - fine)) <= 1e-5 * np.ptp(fine)


#: Force that the hysteresis softens: what it multiplies lies in a loop.
SOFTER = psa.Component(
    name="softer",
    description="a spring that the hysteresis softens",
    source="test",
    equations=lambda s: psa.Equations(add={"tip_force": -1e3 * s.f_H * s.x}),
)


@pytest.mark.parametrize("base", [psa.BASE, psa.SIMPLIFIED], ids=["cascade", "single mass"])
def test_every_effect_splits(base: tuple[psa.Component, ...]) -> None:
    present = {c.name for c in base}
    whole = [e for e in psa.EFFECTS.values() if set(e.needs) <= present]
    assert len(whole) >= len(psa.EFFECTS) - 1
    for components in (base, *((*base, e) for e in whole), (*base, *whole)):
        split = split_of(structure_of(components))
        assert isinstance(split, Split), split
        assert sorted((*split.linear, *split.along)) == list(range(len(split.structure.states)))


@pytest.mark.parametrize(
    ("component", "reason"),
    [
        (KINK, r"another kink \(contact\)"),
        (FEEDBACK, r"another kink \(voltage_reversal\)"),  # u' is a driver's rate no more
        (SOFTER, "a hysteresis lies in a loop"),
        (JUMP, "jump"),  # its derivative is 0 wherever there is one
    ],
    ids=lambda c: getattr(c, "name", ""),
)
def test_what_does_not_split_reports_why(component: psa.Component, reason: str) -> None:
    structure = psa.compose((*psa.BASE, component)).structure
    result = split_of(structure)
    assert isinstance(result, str)
    assert re.search(reason, result)
    assert why_not(structure, (OUTPUT,)) == result


def test_sampled_states_do_not_split() -> None:
    assert split_of(loop().structure) == "it has sampled states"


def test_a_function_that_the_c_code_does_not_have_is_named() -> None:
    """The text is printed only where there is no library yet, so that it fails there."""
    bent = psa.Component(
        name="bent",
        description="a force by the inverse of a hyperbolic sine",
        source="test",
        equations=lambda s: psa.Equations(add={"free_force": ca.asinh(s.u / 10.0)}),
    )
    reason = why_not(psa.compose((*psa.BASE, bent)).structure, (OUTPUT,))
    assert reason is not None
    assert reason.startswith("operation")


def _clear() -> None:
    """Forget the libraries that are loaded."""
    exact._compiled.cache_clear()
    exact._library.cache_clear()
    stepper._library.cache_clear()


@pytest.fixture
def _plain_vectors(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Compile without this processor's vectors, in separate libraries."""
    _clear()
    monkeypatch.setattr(exact, "vector_flags", lambda: ())
    yield
    _clear()


def _case() -> tuple[psa.Model, FloatArray, FloatArray]:
    """Return a stack with backlash, times and inputs."""
    model, t = with_effect("backlash"), times(400, 1e-4)
    return model, t, inputs(model, t, composite(400))


def results() -> list[FloatArray]:
    """Return displacement, derivatives, states and outputs of a run."""
    model, t, u = _case()
    unknowns: list[str | int] = ["k_L", "A", "R_s", "tau", "k_P"]
    exact_steps = exact.run_exact(
        model, t, u, start_on(model, t, u).x, tolerance=1e-7, unknowns=unknowns,
        outputs=(OUTPUT,), everything=True,
    )  # fmt: skip
    return [exact_steps.requested, exact_steps.sensitivity, exact_steps.x, exact_steps.y]


@pytest.mark.skipif(not vector_flags(), reason="this processor has no wide vectors")
def test_wide_vectors_do_not_change_a_bit(request: pytest.FixtureRequest) -> None:
    wide = results()
    request.getfixturevalue("_plain_vectors")
    for ours, theirs in zip(wide, results(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_every_compiler_gives_the_same_bits(
    compiler: str, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Where `ziglang` is not installed, the system's compiler takes its place."""
    request.addfinalizer(_clear)
    monkeypatch.delenv(FLAGS_VARIABLE, raising=False)
    runs = []
    for command in ([tool(compiler)], zig_command()):
        _clear()
        monkeypatch.setenv("CC", " ".join(command))
        runs.append(results())
    for ours, theirs in zip(*runs, strict=True):
        np.testing.assert_array_equal(ours, theirs)


@slow
def test_what_the_tests_compile_with_gives_the_bits_of_what_users_have(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Exact steps of one set and of four side by side, and the stepper: -Og, -O1 or -O3, -O2."""
    request.addfinalizer(_clear)
    monkeypatch.setenv("CC", tool("gcc"))
    runs = []
    for flags in ("-Og", ""):
        _clear()
        monkeypatch.setenv(FLAGS_VARIABLE, flags)
        runs.append([*results(), *_side_by_side(), *_stepped()])
    assert len(runs[0]) == 7
    for ours, theirs in zip(*runs, strict=True):
        np.testing.assert_array_equal(ours, theirs)
        assert np.ptp(ours) > 0.0


def _side_by_side() -> list[FloatArray]:
    """Return the displacement (n, 4) of four sets of parameters in lanes."""
    model, t, u = _case()
    sets = [model.with_values({"k_L": share * model.values["k_L"]}) for share in (1, 1.1, 1.2, 1.3)]
    p = np.array([[m.values[n] for m in sets] for n in model.parameter_names])
    x0, nominal = (
        np.column_stack(columns)
        for columns in zip(*((start_on(m, t, u).x, m.state_nominals()) for m in sets), strict=True)
    )
    task = exact.Task(model.structure, "measured_displacement", t, u, np.zeros(len(t)), 1e-7)
    return [exact.run_sets(task, exact.Numbers(p, x0, nominal))]


def _stepped() -> list[FloatArray]:
    """Return outputs and derivatives of the stepper."""
    model, t, u = _case()
    result = stepper.run(model, t, u, start_on(model, t, u).x, unknowns=["k_L", "A"])
    return [result.y, result.sensitivity]


LAST_PLACE = 2.0**-52
CODE = """
#include "exact_math.h"
#define EACH(name)                                                                                \\
    __attribute__((visibility("default"))) void each_##name(long n, const double *x, double *y) { \\
        for (long i = 0; i < n; ++i) {                                                            \\
            const real z = x[i] + REAL(0.0);                                                      \\
            const real found = name(z);                                                           \\
            y[i] = LANE(found, PSA_LANES - 1);                                                    \\
        }                                                                                         \\
    }
EACH(v_exp)
EACH(v_log)
EACH(v_log_of_base)
"""


@cache
def library(lanes: int) -> ctypes.CDLL:
    flags = ("-std=gnu99", f"-DPSA_LANES={lanes}")
    return ctypes.CDLL(str(shared_library({"math.c": CODE}, (), flags)))


def each(name: str, x: FloatArray, lanes: int = 1) -> FloatArray:
    y = np.empty_like(x)
    doubles = ctypes.POINTER(ctypes.c_double)
    call = getattr(library(lanes), f"each_{name}")
    call(ctypes.c_long(x.size), x.ctypes.data_as(doubles), y.ctypes.data_as(doubles))
    return y


def arguments(name: str) -> FloatArray:
    if name == "v_exp":
        return np.concatenate([np.linspace(-708.0, 709.0, 100_003), np.linspace(-1, 1, 10_001)])
    return np.concatenate([np.geomspace(1e-300, 1e300, 100_003), np.linspace(0.7, 1.5, 10_001)])


@pytest.mark.parametrize("lanes", [1, 4])
@pytest.mark.parametrize(
    ("name", "smallest", "places"),
    [("v_exp", 1e-320, 1.0), ("v_log", 1e-320, 1.0), ("v_log_of_base", 1.0, 2.0)],
)
def test_relative_error_is_a_last_place(
    name: str, smallest: float, places: float, lanes: int
) -> None:
    """The logarithm of a base errs by little enough for powers."""
    x = arguments(name)
    exact = (np.exp if name == "v_exp" else np.log)(x.astype(np.longdouble))
    error = np.abs(each(name, x, lanes) - exact)
    assert np.max(error / np.maximum(np.abs(exact), smallest)) <= places * LAST_PLACE


def test_ends() -> None:
    assert each("v_exp", np.array([-1e4, 0.0, 1e4])).tolist() == [
        pytest.approx(np.exp(-708.0)),
        1.0,
        pytest.approx(np.exp(709.0)),
    ]
    for name in ("v_log", "v_log_of_base"):
        assert each(name, np.array([1.0])).tolist() == [0.0]
        assert np.isnan(each(name, np.array([0.0, -1.0]))).all()
