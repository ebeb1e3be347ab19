"""The FMU keeps the tolerance that its importer asks for, whatever the input and the step.

Errors are shares of the output's range, or of its nominal where that is larger (a stack that hardly
moves is not asked for more digits than its absolute tolerance holds).
"""

from collections.abc import Callable
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from psa_casadi.export.check.agreement import expected_outputs
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu, Instance
from psa_casadi.export.importer.masters import FloatArray, Signals, co_simulate, communicate
from psa_casadi.reference import simulate
from psa_casadi.simulation.stepper import run
from psa_casadi.variables import nominal_value
from tests.benchmarks.work_precision_methods import STEP_SHARE, TIGHTEST_STEP
from tests.fmu_models import exported, model_named
from tests.tiers import slow_but

STACKS = ("PTBS200", "WYDS0808020", "P-885.51", "manipulator", "slow_creep")
#: The one of the quick tier.
ONE = "P-885.51"
TOLERANCES = (1e-3, 1e-5, 1e-7)
FACTOR = 10.0


def _grid(end: float, step: float) -> FloatArray:
    return np.array([round(k * step, 12) for k in range(round(end / step) + 1)])


def _ramps(top: float) -> Signals:
    """Up, down, held and reversed: four kinks, two reversals, one of them within a step."""
    times = np.array([0.0, 4e-3, 7e-3, 1e-2, 1.05e-2, 2e-2])
    shape = np.array([0.0, 1.0, 0.3, 0.3, 0.9, 0.1])
    return _both(times, top * shape)


def _sampled(top: float) -> Signals:
    """Sum of sines as a recorder keeps it: 10 kHz, rounded, a kink at every sample."""
    times = _grid(2e-2, 1e-4)
    tones = ((50.0, 0.30, 0.0), (170.0, 0.12, 1.0), (610.0, 0.05, 2.0))
    wave = sum((a * (np.sin(2 * np.pi * f * times + p) - np.sin(p)) for f, a, p in tones),
               0.0 * times)  # fmt: skip
    return _both(times, np.round(top * (0.5 * np.minimum(times / 5e-3, 1.0) + 0.5 * wave), 2))


def _whisper(top: float) -> Signals:
    """A reversing voltage of a ten-thousandth of the rated one."""
    times = np.array([0.0, 3e-3, 6e-3, 9e-3, 2e-2])
    return _both(times, 1e-4 * top * np.array([0.0, 1.0, -1.0, 0.5, -0.5]))


def _both(times: FloatArray, voltage: FloatArray) -> Signals:
    return Signals(
        ("voltage", "load_force"), times, np.column_stack([voltage, 0.0 * voltage])
    )  # fmt: skip


SIGNALS: dict[str, Callable[[float], Signals]] = {
    "ramps": _ramps,
    "sampled": _sampled,
    "whisper": _whisper,
}


def _signals(name: str, kind: str) -> Signals:
    return SIGNALS[kind](model_named(name).values["u_rated"])


@cache
def _expected(name: str, kind: str) -> FloatArray:
    """Return the displacement every 0.1 ms by a computation at 1e-10 or tighter."""
    model = model_named(name).plant()
    found = expected_outputs(model, _grid(2e-2, 1e-4), _signals(name, kind))
    column: FloatArray = found[:, model.output_names.index("displacement")]
    return column


def _scale(name: str, expected: FloatArray) -> float:
    model = model_named(name).plant()
    nominal = model.output_nominals()[model.output_names.index("displacement")]
    return float(max(np.ptp(expected), nominal))


#: One stack with every signal and tolerance, the others with any two of the three.
PLAYED = [(ONE, kind, tolerance) for kind in SIGNALS for tolerance in TOLERANCES]
IN_TURN = [
    (name, kind, TOLERANCES[(k + j) % 3])
    for k, name in enumerate(n for n in STACKS if n != ONE) for j, kind in enumerate(SIGNALS)
]  # fmt: skip


@pytest.mark.parametrize(("name", "kind", "tolerance"), slow_but(PLAYED, [*PLAYED, *IN_TURN]))
def test_error_is_within_ten_tolerances(name: str, kind: str, tolerance: float) -> None:
    expected = _expected(name, kind)
    with Fmu(exported(name)) as fmu:
        found = co_simulate(
            fmu, _grid(2e-2, 1e-4), _signals(name, kind), ["displacement"], tolerance=tolerance
        )[:, 0]
    error = np.max(np.abs(found - expected)) / _scale(name, expected)
    assert error < FACTOR * tolerance


def _held(instance: Instance, times: FloatArray, levels: FloatArray) -> FloatArray:
    """Hold each level from one time to the next; return the displacement at the ends."""
    found = []
    for (begin, end), level in zip(pairwise(times), levels, strict=True):
        instance.set({"voltage": float(level)})
        instance.step(float(begin), float(end - begin))
        found.append(float(instance.get(["displacement"])[0]))
    return np.array(found)


#: Within this time [s] of a constant voltage each of the stacks has come to rest.
_REST = 0.3
_SIZES = np.array([1e-6, 1e-2, 1e-5, 1e-3, 1e-4, 10.0, 1e-6, 3e-5, 1000.0])
_SHARES = np.array([1.0, 0.0, 0.6, -0.1, 0.8, 0.2, 1.0, 0.1, 0.5])


@cache
def _after_jumps(name: str) -> FloatArray:
    """Return the displacement at the end of every level; the reference does not wait past rest."""
    model = model_named(name)
    times = np.concatenate([[0.0], np.cumsum(np.minimum(_SIZES, _REST))])
    levels = model.values["u_rated"] * _SHARES

    def voltage(t: float) -> float:
        level = int(np.searchsorted(times, t, side="right")) - 1
        return float(levels[min(level, len(levels) - 1)])

    return simulate(model.values, voltage, times, breakpoints=list(times)).displacement[1:]


@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize("name", slow_but(["PTBS200"], ["PTBS200", ONE, "manipulator"]))
def test_jumps_and_steps_from_a_microsecond_to_a_quarter_hour(name: str, tolerance: float) -> None:
    """The voltage jumps at every communication point; the steps span nine decades."""
    expected = _after_jumps(name)
    times = np.concatenate([[0.0], np.cumsum(_SIZES)])
    levels = model_named(name).values["u_rated"] * _SHARES
    with Fmu(exported(name)) as fmu, fmu.start(CO_SIMULATION, tolerance=tolerance) as instance:
        found = _held(instance, times, levels)
    error = np.max(np.abs(found - expected)) / _scale(name, expected)
    assert error < FACTOR * tolerance


def test_input_derivatives_raise_the_order() -> None:
    """The error of a held sine falls with the step; with slopes, with its square."""

    def signal(t: FloatArray) -> FloatArray:
        return 60.0 - 60.0 * np.cos(2 * np.pi * 50.0 * t)

    fine = _grid(2e-2, 2.5e-5)
    truth = simulate(model_named("P-885.51").values, lambda t: float(signal(np.array(t))), fine)
    errors: dict[bool, list[float]] = {False: [], True: []}
    with Fmu(exported("P-885.51")) as fmu:
        for rates, found in errors.items():
            for step in (2e-4, 1e-4, 5e-5):
                times = _grid(2e-2, step)
                inputs = Signals(("voltage",), times, signal(times)[:, None])
                x = co_simulate(fmu, times, inputs, ["displacement"], tolerance=1e-8, rates=rates)[
                    :, 0
                ]
                known = truth.displacement[np.searchsorted(fine, times - 1e-9)]
                found.append(float(np.max(np.abs(x - known)) / np.ptp(truth.displacement)))
    held, sloped = errors[False], errors[True]
    assert all(1.8 < a / b < 2.4 for a, b in pairwise(held))
    assert all(a / b > 3.4 for a, b in pairwise(sloped))
    assert sloped[0] < held[0] / 30.0


@pytest.mark.parametrize("name", slow_but([ONE], ["PTBS200", ONE, "slow_creep", "flexure"]))
def test_output_derivatives_are_those_of_the_outputs(name: str) -> None:
    """Against differences of fourth order over 4 us of a run with the same ramps as inputs."""
    model = model_named(name).plant()
    outputs, at, h = model.output_names, 1.3e-3, 1e-6
    slopes = 2e3 * np.array([nominal_value(i.nominal, model.values)
                             for i in model.structure.inputs])  # fmt: skip
    times = np.array([0.0, at - 2 * h, at - h, at, at + h, at + 2 * h])
    inputs = Signals(model.input_names, times, np.outer(times, slopes))
    with Fmu(exported(name)) as fmu:
        y = co_simulate(fmu, times, inputs, outputs, tolerance=1e-9)
        with fmu.start(CO_SIMULATION, tolerance=1e-9) as instance:
            communicate(instance, times[:4], inputs.on(times[:4]), outputs)
            rates = instance.output_rates(outputs)
    expected = (8.0 * (y[4] - y[2]) - (y[5] - y[1])) / (12.0 * h)
    size = np.maximum(np.abs(expected), np.max(np.abs(y), axis=0) / at)
    assert np.all(np.abs(rates - expected) < 1e-4 * size)


def test_every_solver_step_gets_a_share_of_the_tolerance() -> None:
    """The work that the bench tells is that of the FMU: as many steps as the simulator's."""
    name, tolerance = "P-885.51", 1e-5
    times, inputs = _grid(2e-2, 1e-4), _signals("P-885.51", "sampled")
    with Fmu(exported(name)) as fmu, fmu.start(CO_SIMULATION, tolerance=tolerance) as instance:
        instance.require("SetDebugLogging", 1, 0, None)
        communicate(instance, times, inputs, ["displacement"])
        told = [m for m in instance.messages if "solver steps" in m]
    steps = sum(int(m.partition(": ")[2].split()[0]) for m in told)
    model = model_named(name).plant()
    u = np.zeros((len(times), len(model.input_names)))
    u[:, model.input_names.index("voltage")] = inputs.at(times)[:, 0]
    again = run(
        model, times, u, np.zeros(len(model.state_names)),
        rtol=max(STEP_SHARE * tolerance, TIGHTEST_STEP),
    )  # fmt: skip
    assert len(told) == len(times) - 1
    assert steps == again.steps
