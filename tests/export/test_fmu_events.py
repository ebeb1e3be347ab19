"""The voltage's reversal as an event: located by an importer, harmless where nobody looks."""

import html
import re
from dataclasses import replace
from functools import cache
from itertools import pairwise

import fmpy
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.reference_run import SHARE, STEPS_PER_PERIOD, reference_inputs
from psa_casadi.export.importer.fmu import (
    CO_SIMULATION,
    ERROR,
    MODEL_EXCHANGE,
    Fmu,
    FmuError,
    Instance,
)
from psa_casadi.export.importer.masters import Signals, co_simulate
from tests.contract.helpers import samples
from tests.export.fmi3_instances import Instance3, loaded, restore, saved
from tests.export.fmu_models import entries, exported, model_named
from tests.tiers import slow, slow_but

STACK = "P-885.51"


def _rate(u: float, voltage: float) -> float:
    """Return u' of the drive stage (V - u) / (R_s C_p)."""
    values = model_named(STACK).values
    return (voltage - u) / (values["R_s"] * values["C_p"])


def _margin(tolerance: float = 1e-5) -> float:
    """Return 5 tolerances of what the voltage's nominal value moves its rate by [V/s]."""
    values = model_named(STACK).values
    nominal = next(v.nominal for v in variable_table(model_named(STACK)) if v.name == "u")
    return 5.0 * tolerance * float(nominal or 0.0) / (values["R_s"] * values["C_p"])


def test_indicator_faces_the_other_way_after_an_event_and_noise_makes_none() -> None:
    """Beyond the margin an event update turns it round; within the margin it does not."""
    values = model_named(STACK).values
    step = 2.0 * _margin() * values["R_s"] * values["C_p"]  # [V], two margins of the rate
    with Instance3(loaded(STACK), MODEL_EXCHANGE) as instance:
        instance.start({"u": 50.0, "voltage": 50.0})
        for share, facing in ((0.2, 1.0), (1.0, -1.0), (-0.2, -1.0), (-1.0, 1.0)):
            instance.require("EnterEventMode")
            instance.set({"voltage": 50.0 - share * step})
            assert instance.update_discrete_states() == [False] * 5
            instance.require("EnterContinuousTimeMode")
            expected = facing * _rate(50.0, 50.0 - share * step) + _margin()
            assert instance.vector("GetEventIndicators", 1)[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_held_voltage_makes_no_events(fmi: int) -> None:
    path = fmpy.simulate_fmu(
        str(exported(STACK, fmi)), fmi_type="ModelExchange", output=["displacement"],
        input=samples(time=(0.0, 1e-3, 5e-2), voltage=(0.0, 50.0, 50.0)),
        stop_time=5e-2, output_interval=1e-4, relative_tolerance=1e-5,
    )  # fmt: skip
    assert np.count_nonzero(np.diff(path["time"]) == 0.0) <= 4


@cache
def fmu(fmi: int) -> Fmu:
    return Fmu(exported(STACK, fmi))


def errors(
    name: str, fmi: int, times: list[float], shares: list[float], interval: float
) -> dict[str, float]:
    """Return the largest errors of fmpy's CVode over the range of an output; times may jump."""
    model = model_named(name)
    volts = model.values["u_rated"] * np.array(shares)
    result = fmpy.simulate_fmu(
        str(exported(name, fmi)), fmi_type="ModelExchange", stop_time=times[-1],
        output_interval=interval, input=samples(time=times, voltage=volts), record_events=False,
        solver="CVode", output=["displacement", "velocity"],
    )  # fmt: skip
    t = np.array(times)
    jumps = t[1:][np.diff(t) == 0.0]
    t[:-1][np.diff(t) == 0.0] -= 1e-12
    grid = np.unique(np.concatenate([result["time"], t, jumps]))
    true = psa.simulate(model.plant(), grid, np.interp(grid, t, volts), rtol=1e-9, as_exported=True)
    at = np.searchsorted(grid, result["time"])
    return {
        n: float(np.max(np.abs(result[n] - true.outputs[n][at])) / np.ptp(true.outputs[n]))
        for n in ("displacement", "velocity")
    }


@pytest.mark.parametrize(
    ("name", "fmi", "interval"),
    slow_but(
        [(STACK, 2, 0.02), ("demo", 3, 0.002)],
        [(n, f, i) for n in (STACK, "PTBS200", "WYDS0808020", "demo", "slow_creep")
         for f in (2, 3) for i in (0.02, 0.002)],
    ),
)  # fmt: skip
def test_a_ramp_in_fmpy_at_its_default_tolerance(name: str, fmi: int, interval: float) -> None:
    """Each step of CVode was a jump to it: it gave up, or the velocity erred by its range."""
    result = errors(name, fmi, [0.0, 0.1, 0.2], [0.0, 0.8, 0.0], interval)
    assert result["displacement"] < 3e-4
    assert result["velocity"] < 0.03


@pytest.mark.parametrize("name", slow_but(["demo"], [STACK, "PTBS200", "demo", "slow_creep"]))
def test_a_jump_in_fmpy_at_its_default_tolerance(name: str) -> None:
    """The tolerance of a velocity is a tenth of what it was, and 33 % of its range were wrong."""
    result = errors(name, 2, [0.0, 2e-3, 2e-3, 0.02], [0.0, 0.0, 0.8, 0.8], 1e-4)
    assert result["displacement"] < 1e-3
    assert result["velocity"] < 0.05


def rates(fmi: int, text: str, *, jump: bool = False, last: float | None = None) -> FloatArray:
    """Return the derivatives at 2 ms of an importer that gave 10 V at 0 and 30 V at 1 ms.

    Where it gave them it `text` for the "indicators", the "rates" or both; `jump` is an event at
    1 ms, `last` is what it gives at 2 ms.
    """
    rate = "GetDerivatives" if fmi == 2 else "GetContinuousStateDerivatives"
    with fmu(fmi).start(MODEL_EXCHANGE) as instance:
        for time, volts in ((0.0, 10.0), (1e-3, 30.0)):
            instance.require("SetTime", time)
            if jump and time > 0.0:
                instance.require("EnterEventMode")
            instance.set({"voltage": volts})
            if jump and time > 0.0:
                instance.require("EnterContinuousTimeMode")
            for what in text.split(" and "):
                if what == "rates":
                    instance.vector(rate, len(fmu(fmi).states()))
                elif what == "indicators":
                    instance.vector("GetEventIndicators", 1)
        instance.require("SetTime", 2e-3)
        if last is not None:
            instance.set({"voltage": last})
        return instance.vector(rate, len(fmu(fmi).states()))


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_importer_that_reads_rates_where_it_sets_inputs_has_them_held(fmi: int) -> None:
    """CasADi, Euler's method, masters that hold inputs: values are what they were set to."""
    held, moved = (rates(fmi, "rates", last=v) for v in (30.0, 50.0))
    assert not np.array_equal(held, moved)
    for requested in ("rates", "indicators and rates", "rates and indicators", "nothing"):
        assert np.array_equal(rates(fmi, requested), held), requested
    assert np.array_equal(rates(fmi, "indicators", jump=True), held)
    assert np.array_equal(rates(fmi, "indicators", last=30.0), held)
    np.testing.assert_allclose(rates(fmi, "indicators"), moved, rtol=1e-12)


def _named_step(fmi: int) -> float:
    page = html.unescape(entries(STACK, fmi)["documentation/index.html"].decode())
    result = re.search(r"a step of (\S+) s keeps the error to (\S+) % of", " ".join(page.split()))
    assert result is not None
    assert float(result[2]) <= 100.0 * SHARE
    return float(result[1])


@slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_step_on_the_page_keeps_the_fmu_within_a_thousandth_and_twice_it_does_not(
    fmi: int,
) -> None:
    times, inputs = reference_inputs(model_named(STACK).plant())
    kinks = Signals(("voltage", "load_force"), times, inputs)

    def displacement(step: float, *, held: bool) -> FloatArray:
        grid = np.linspace(0.0, times[-1], round(times[-1] / step) + 1)
        arguments = replace(kinks.on(grid), held=held)
        with Fmu(exported(STACK, 2 if not held else fmi)) as fmu:
            values = co_simulate(fmu, grid, arguments, ["displacement"], settled=True)
        return np.interp(times, grid, values[:, 0])

    truth = displacement(float(times[1]), held=False)
    step, span = _named_step(fmi), float(np.ptp(truth))
    errors = [np.abs(displacement(k * step, held=True) - truth).max() / span for k in (1.0, 2.0)]
    assert errors[0] <= 1.02 * SHARE
    assert SHARE < errors[1] < 4.0 * SHARE


@pytest.mark.parametrize(("name", "frequency"), [(STACK, 100.0), ("PTBS200", 20.0)])
def test_a_sine_over_the_whole_range_needs_the_steps_that_the_page_names(
    name: str, frequency: float
) -> None:
    model = model_named(name).plant()
    grid = np.arange(STEPS_PER_PERIOD + 1) / (STEPS_PER_PERIOD * frequency)
    voltage = 60.0 * (1.0 - np.cos(2 * np.pi * frequency * grid))
    u = np.column_stack([voltage, np.zeros_like(voltage)])
    at_rest, column = np.zeros(len(model.state_names)), model.output_names.index("displacement")
    truth = psa.run(model, grid, u, at_rest, rtol=1e-8).y[:, column]
    for every, limits in ((1, (0.25, 1.0)), (2, (1.0, 2.5))):
        rows = slice(None, None, every)
        result = psa.run(model, grid[rows], u[rows], at_rest, rtol=1e-8, hold="zero").y[:, column]
        error = np.abs(result - truth[rows]).max() / np.ptp(truth)
        assert limits[0] * SHARE < error <= limits[1] * SHARE, (every, error)


FREQUENCY = 50.0
END = 2.0 / FREQUENCY
VERSIONS = pytest.mark.parametrize("fmi", [2, 3])


def _signal(t: FloatArray) -> FloatArray:
    return 60.0 - 60.0 * np.cos(2 * np.pi * FREQUENCY * t)


@pytest.fixture(scope="module")
def truth() -> dict[float, float]:
    """Displacement at the ends of all steps that are tried, by an independent computation."""
    times = np.linspace(0.0, END, 2 * 3200 + 1)
    exact = reference.simulate(
        model_named(STACK).values, lambda t: float(_signal(np.array(t))), times
    )
    return dict(zip(np.round(times, 9).tolist(), exact.displacement.tolist(), strict=True))


def _run(slave: Instance, count: int, first: int = 0, end: int | None = None) -> FloatArray:
    """Hold samples of the signal over steps; return the displacements at their ends."""
    times = np.linspace(0.0, END, count + 1)
    items = []
    for begin, stop in pairwise(times[first : end and end + 1]):
        slave.set({"voltage": float(_signal(begin))})
        slave.step(float(begin), float(stop - begin))
        items.append(slave.get(["displacement"])[0])
    return np.array(items)


def _error(fmu: Fmu, count: int, line: float, truth: dict[float, float]) -> float:
    """Return the largest error over the second period, as a share of the range."""
    with fmu.start(CO_SIMULATION, tolerance=1e-8, values={"input_line": line}) as slave:
        result = _run(slave, count)
    ends = np.round(np.linspace(0.0, END, count + 1)[1:], 9)
    known = np.array([truth[t] for t in ends.tolist()])
    return float(np.abs(result - known)[count // 2 :].max() / np.ptp(list(truth.values())))


@VERSIONS
def test_coarse_steps(fmi: int, truth: dict[float, float]) -> None:
    """Steps of a 100th to a 400th of a period: held the error falls with the step, else faster."""
    with Fmu(exported(STACK, fmi)) as fmu:
        held, line = ([_error(fmu, n, x, truth) for n in (200, 400, 800)] for x in (0.0, 1.0))
    assert all(1.8 < a / b < 2.4 for a, b in pairwise(held))
    assert all(a / b > 3.5 for a, b in pairwise(line))
    assert held[0] > 0.015
    assert line[0] < held[0] / 3.5
    assert line[1] < held[1] / 10.0


@VERSIONS
def test_a_value_that_is_not_set_again_is_held(fmi: int) -> None:
    """What an importer leaves alone does not drift on, nor does a long step go far on its line."""
    with Fmu(exported(STACK, fmi)) as fmu:
        for line in (0.0, 0.5, 1.0):
            with fmu.start(CO_SIMULATION, values={"input_line": line}) as slave:
                _run(slave, 200, end=20)
                last = float(_signal(np.array(19 * END / 200)))
                slave.set({"voltage": 40.0})
                items = []
                for k in range(4):
                    slave.step(20 * END / 200 + k * 0.2, 0.2)
                    items.append(slave.get(["voltage"])[0])
            assert items == pytest.approx([40.0 + line * (40.0 - last), 40.0, 40.0, 40.0])


@VERSIONS
def test_the_line_is_part_of_the_state(fmi: int) -> None:
    with Fmu(exported(STACK, fmi)) as fmu:
        with fmu.start(CO_SIMULATION, values={"input_line": 1.0}) as slave:
            _run(slave, 100, end=10)
            data = saved(slave)
            first = _run(slave, 100, first=10, end=20)
            restore(slave, data)
            assert np.array_equal(_run(slave, 100, first=10, end=20), first)
            slave.require("Reset")
            slave.setup()
            assert slave.get(["input_line"])[0] == 0.0
        with fmu.open(CO_SIMULATION) as other:
            with pytest.raises(FmuError, match="'input_line' cannot be set to 2: it must") as error:
                other.set({"input_line": 2.0})
            assert error.value.status == ERROR
            restore(other, data)
            assert np.array_equal(_run(other, 100, first=10, end=20), first)
            with pytest.raises(FmuError, match="'input_line' can be set only before the first"):
                other.set({"input_line": 0.0})


def test_a_jump_in_event_mode_starts_a_new_line() -> None:
    """FMI 3.0: the step after event mode is held, whatever was set before."""
    with Fmu(exported(STACK, 3)) as fmu:
        ends = []
        for line in (0.0, 1.0):
            with Instance3(fmu, events=True).start({"input_line": line}) as slave:
                slave.require("EnterStepMode")
                for k, voltage in enumerate((20.0, 20.0, 90.0)):
                    if k == 2:
                        slave.require("EnterEventMode")
                        slave.update_discrete_states()
                    slave.set({"voltage": voltage})
                    if k == 2:
                        slave.require("EnterStepMode")
                    slave.step(k * 1e-3, 1e-3)
                ends.append(slave.get(["displacement", "voltage"]))
    assert np.array_equal(ends[0], ends[1])
    assert ends[0][1] == 90.0
