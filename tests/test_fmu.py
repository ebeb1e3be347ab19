"""FMUs of several models against computations that share no code with them."""

from collections.abc import Callable
from itertools import pairwise

import fmpy
import numpy as np
import pytest

from psa_casadi.export.check.agreement import has_reference
from psa_casadi.export.check.check import check_fmu
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.export.importer.masters import FloatArray, Signals, co_simulate
from psa_casadi.reference import from_samples, simulate
from tests.fmu_models import exported, model_named
from tests.tiers import slow, slow_but

STACK = "P-885.51"
MODELS = (
    "PTBS200", "WYDS0808020", STACK, "manipulator", "single_mass", "slow_creep", "flexure",
    "every_effect",
)  # fmt: skip


#: The two versions are two faces of one core: each kind of model in one of them, one in both. Other
#: stacks are checked in `test_cli_commands` and played in `test_fmu_accuracy`.
CHECKED = (
    (STACK, 3), ("flexure", 3), (STACK, 2), ("single_mass", 2), ("slow_creep", 2),
    ("every_effect", 3),
)  # fmt: skip


@pytest.mark.parametrize(("name", "fmi"), slow_but(CHECKED[:1], CHECKED))
def test_check_passes(name: str, fmi: int) -> None:
    report = check_fmu(exported(name, fmi), model_named(name))
    assert report.compared
    assert not report.failures, "\n".join(
        f"{r.name}: {r.figure} {r.remark}" for r in report.failures
    )
    steps = [r for r in report.rows if r.name.startswith("co-simulation, step")]
    assert len(steps) == 4
    assert all(r.limit == 1e-6 for r in steps)
    against = "reference" if has_reference(model_named(name)) else "simulator"
    assert all(r.remark.endswith(f"against the {against}") for r in steps)


def _sine(t: FloatArray) -> FloatArray:
    return 60.0 - 60.0 * np.cos(2 * np.pi * 100.0 * t)


def _multisine(t: FloatArray) -> FloatArray:
    tones = ((50.0, 40.0, 0.0), (130.0, 12.0, 1.0), (310.0, 4.0, 2.0))
    return sum((a * (np.sin(2 * np.pi * f * t + p) - np.sin(p)) for f, a, p in tones), 0.0 * t)


@pytest.mark.parametrize("signal", [_sine, _multisine])
def test_smooth_inputs(signal: Callable[[FloatArray], FloatArray]) -> None:
    """The input is linear over steps of 1 us; for 310 Hz that is off by 5e-7 of its amplitude."""
    times = np.round(1e-6 * np.arange(12001), 12)
    command = signal(times)
    inputs = Signals(("voltage",), times, command[:, None])
    model = model_named(STACK)
    truth = simulate(model.values, lambda t: float(signal(np.array(t))), times).displacement
    with Fmu(exported(STACK)) as fmu:
        found = co_simulate(fmu, times, inputs, ["displacement"], tolerance=1e-10)[:, 0]
    assert np.max(np.abs(found - truth)) < 1e-6 * np.ptp(truth)


@pytest.mark.parametrize("step", slow_but([1e-4], [1e-6, 1e-4, 1e-3, 1e-2]))
def test_jump_of_the_voltage(step: float) -> None:
    """The voltage jumps at 10 ms and back at 20 ms; inputs are held over a communication step."""
    count = min(round(3e-2 / step), 30000) if step > 1e-6 else 2000
    begin = 0.0 if step > 1e-6 else 9e-3
    times = begin + np.round(step * np.arange(count + 1), 12)
    truth = simulate(
        model_named(STACK).values,
        lambda t: 100.0 if 1e-2 <= t < 2e-2 else 0.0,
        np.union1d([0.0], times),
        breakpoints=(1e-2, 2e-2),
    ).displacement[-len(times) :]
    with Fmu(exported(STACK)) as fmu, fmu.start(CO_SIMULATION, tolerance=1e-10) as slave:
        if begin > 0.0:
            slave.step(0.0, begin)
        found = [0.0]
        for now, following in pairwise(times):
            middle = 0.5 * (now + following)
            slave.set({"voltage": 100.0 if 1e-2 <= middle < 2e-2 else 0.0})
            slave.step(float(now), float(following - now))
            found.append(float(slave.get(["displacement"])[0]))
    scale = 100.0 / 120.0 * 18e-6
    assert np.max(np.abs(np.array(found) - truth)) < 1e-6 * scale


@pytest.mark.parametrize("interface", slow_but(["CoSimulation"], ["CoSimulation", "ModelExchange"]))
def test_fmpy_agrees(interface: str) -> None:
    """fmpy's own co-simulation master, and its CVode for model exchange, on two jumps."""
    rows = [(0.0, 0.0), (5e-3, 0.0), (5e-3, 100.0), (15e-3, 100.0), (15e-3, 20.0), (30e-3, 20.0)]
    table = np.array(
        [(t, v, 0.0) for t, v in rows],
        dtype=[(n, float) for n in ("time", "voltage", "load_force")],
    )
    result = fmpy.simulate_fmu(
        str(exported(STACK)), stop_time=0.03, fmi_type=interface, relative_tolerance=1e-9,
        output_interval=1e-3, input=table, output=["displacement"],
    )  # fmt: skip
    times, first = np.unique(result["time"], return_index=True)
    truth = simulate(
        model_named(STACK).values,
        lambda t: 0.0 if t < 5e-3 else 100.0 if t < 15e-3 else 20.0,
        times,
        breakpoints=(5e-3, 15e-3),
    ).displacement
    assert len(times) >= 31
    assert np.max(np.abs(result["displacement"][first] - truth)) < 1e-6 * np.ptp(truth)


def test_input_derivatives_reduce_the_error() -> None:
    times = np.round(1e-4 * np.arange(301), 12)
    inputs = Signals(("voltage",), times, _sine(times)[:, None])
    truth = simulate(model_named(STACK).values, lambda t: float(_sine(np.array(t))), times)
    with Fmu(exported(STACK)) as fmu:
        errors = [
            np.max(np.abs(co_simulate(fmu, times, inputs, ["displacement"], rates=r)[:, 0]
                          - truth.displacement))
            for r in (False, True)
        ]  # fmt: skip
    assert errors[1] < errors[0] / 30.0


@slow
def test_tolerance_is_the_accuracy() -> None:
    """The error, as a share of the range, is a few times the tolerance an importer asks for.

    The stack is the underdamped one, which rings 600 times in this record.
    """
    knots = np.array([0.0, 0.01, 0.02, 0.03])
    inputs = Signals(("voltage",), knots, np.array([0.0, 180.0, 40.0, 150.0])[:, None])
    times = np.round(1e-4 * np.arange(301), 12)
    voltage = from_samples(inputs.times, inputs.values[:, 0])
    model = model_named("PTBS200")
    truth = simulate(model.values, voltage, times, breakpoints=list(knots)).displacement
    errors = []
    with Fmu(exported("PTBS200")) as fmu:
        for tolerance in (1e-3, 1e-5, 1e-7, 1e-9):
            found = co_simulate(fmu, times, inputs, ["displacement"], tolerance=tolerance)[:, 0]
            errors.append(np.max(np.abs(found - truth)) / np.ptp(truth))
            assert errors[-1] < 5.0 * tolerance
    assert errors[-1] < 1e-3 * errors[0]


@pytest.mark.parametrize("name", MODELS)
def test_nominal_values_of_parameters_are_within_their_bounds(name: str) -> None:
    for v in variable_table(model_named(name)):
        if v.kind == "parameter" and v.bounds and v.bounds[1] > 0.0:
            assert v.nominal is not None
            assert v.bounds[0] <= v.nominal <= v.bounds[1], v
