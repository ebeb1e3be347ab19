"""Sampled states: their declaration, simulation, FMUs and Modelica, against plain recursions."""

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rumoca

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.importer.fmu import (
    CO_SIMULATION,
    DISCARD,
    ERROR,
    MODEL_EXCHANGE,
    Fmu,
    FmuError,
)
from psa_casadi.export.importer.masters import Signals, co_simulate, integrate
from psa_casadi.export.modelica.package import modelica_text, package_name
from tests.export.fmu_models import exported, model_named
from tests.export.modelica_runs import load
from tests.model.sampled_models import (
    ALONE,
    CONTROLLER,
    PERIOD,
    PLANT,
    controller,
    expected,
    grid,
    loop,
)
from tests.tiers import slow_but

#: Times whose steps divide the period, do not divide it, exceed it, and start between instants.
GRIDS = {
    "a quarter": grid(121, 0.25),
    "the period": grid(31, 1.0),
    "no divisor": grid(44, 0.7),
    "longer": grid(13, 2.5),
    "between": grid(40, 0.75, 0.4),
    "before zero": grid(40, 0.75, -3.3),
}


def inputs(times: FloatArray, slope: float) -> FloatArray:
    return np.column_stack([np.zeros_like(times), 1.0 + slope * times])


@pytest.mark.parametrize("name", GRIDS)
def test_the_loop_follows_the_exact_recursion(name: str) -> None:
    times, slope = GRIDS[name], 30.0
    truth = expected(times, 1.0, slope)
    steps = psa.run(loop(), times, inputs(times, slope), np.zeros(1), rtol=1e-12)
    assert np.abs(steps.x[:, 0] - truth.position).max() < 1e-9
    assert np.abs(steps.z - truth.z).max() < 1e-9
    assert np.abs(steps.y - np.column_stack([truth.position, truth.voltage])).max() < 1e-9
    assert np.ptp(truth.voltage) > 0.2  # the loop is at work


def test_a_held_input_is_sampled_after_its_jump() -> None:
    times = grid(4, 1.0)
    reference = np.array([0.0, 0.0, 1.0, 1.0])
    u = np.column_stack([np.zeros(4), reference])
    z = psa.run(loop(), times, u, np.zeros(1), hold="zero").z
    assert z[1, 1] == 0.0
    assert z[2, 1] == loop().values["k_p"]


def test_a_model_of_sampled_states_only() -> None:
    model, times = controller(), grid(41, 0.25)
    u = np.column_stack([np.ones_like(times), 0.3 * np.sin(400.0 * times)])
    steps = psa.run(model, times, u, np.zeros(0))
    integral, command, rows = 0.0, 0.0, []
    for k, (reference, position) in enumerate(u):
        if k % 4 == 0:
            error = reference - position
            command = integral + model.values["k_p"] * error
            integral += model.values["k_i"] * model.values["T_s"] * error
        rows.append([integral, command])
    assert steps.x.shape == (41, 0)
    assert np.abs(steps.z - np.array(rows)).max() < 1e-14


def test_balances_in_next_are_those_before_the_instant() -> None:
    """A sampled state that adds to a balance and reads it: z_k = 1 + z_(k-1)."""
    counter = psa.Component(
        "counter", "counts instants", "none",
        lambda s: psa.Equations(add={"displacement": s.count}, next={"count": s.displacement + 1}),
        parameters=(psa.Parameter("T_s", PERIOD, "s", (1e-6, 1.0), "sample period"),),
        sampled=(psa.State("count", "m", "number of instants", nominal=1.0),), sample_period="T_s",
    )  # fmt: skip
    steps = psa.run(psa.compose([counter]), grid(4, 1.0), np.zeros((4, 0)), np.zeros(0))
    assert steps.z[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]


def _second(**changes: object) -> psa.Component:
    """Return a sampled counter with another period, with changes."""
    second = replace(
        ALONE, name="second", sample_period="T_2", inputs=(), outputs=(),
        parameters=(psa.Parameter("T_2", 1.0, "s", (0.1, 1.0), "period"),),
        sampled=(psa.State("more", "1", "more", nominal=1.0),),
        equations=lambda s: psa.Equations(next={"more": s.more}),
    )  # fmt: skip
    return replace(second, **changes)  # type: ignore[arg-type]  # of its fields


_ZERO = replace(PLANT, name="p", parameters=(psa.Parameter("T_0", 1.0, "s", (0.0, 1.0), "period"),))


@pytest.mark.parametrize(
    ("components", "match"),
    [
        ((PLANT, replace(CONTROLLER, sampled=())), "declares only one of"),
        ((PLANT, replace(CONTROLLER, sample_period="T_none")),
         "'T_none' of component 'sampled_pi' is no parameter"),
        ((_ZERO, replace(CONTROLLER, sample_period="T_0")), "'T_0' may be 0 by its bounds"),
        ((PLANT, CONTROLLER, _second()), r"different periods \(T_2, T_s\)"),
        ((PLANT, replace(CONTROLLER, equations=lambda s: psa.Equations(
            out={"voltage": s.command}))),
         "lacks the next value of the sampled state 'command'"),
        ((PLANT, replace(CONTROLLER, outputs=(), equations=lambda s: psa.Equations(
            next={"integral": s.integral, "command": s.command, "gain": 1.0}))),
         "sampled state 'gain', which it does not declare"),
        ((PLANT, ALONE), "Two components declare 'position'"),
    ],
)  # fmt: skip
def test_mistakes_of_a_declaration_are_named(components: Any, match: str) -> None:
    with pytest.raises(psa.InputError, match=match):
        psa.compose(components)


def test_two_components_share_a_period() -> None:
    same = psa.compose((PLANT, CONTROLLER, _second(parameters=(), sample_period="T_s")))
    assert same.sampled_names == ("integral", "command", "more")


def test_sensitivities_are_refused() -> None:
    times = grid(4, 1.0)
    with pytest.raises(psa.InputError, match="Sensitivities of a model with sampled states"):
        psa.run(loop(), times, inputs(times, 0.0), np.zeros(1), unknowns=["k_p"])


VERSIONS = pytest.mark.parametrize("fmi", [2, 3])


@VERSIONS
def test_starts_of_sampled_states(fmi: int) -> None:
    with Fmu(exported("controller", fmi)) as fmu:
        with fmu.open(CO_SIMULATION) as slave:
            slave.setup(values={"integral": 0.4, "command": 5.0}, start_time=0.5 * PERIOD)
            assert slave.get(["integral", "command", "voltage"]) == pytest.approx([0.4, 5.0, 5.0])
            with pytest.raises(FmuError, match="can be set only before the first step"):
                slave.set({"integral": 1.0})
            with pytest.raises(FmuError, match="'T_s' cannot be set to 0: it must be at least"):
                slave.set({"T_s": 0.0})
        with fmu.open(CO_SIMULATION) as slave:
            slave.setup(values={"integral": 0.4, "command": 5.0})
            assert slave.get(["integral", "command"]) == pytest.approx([0.4, 0.4])


@VERSIONS
def test_derivatives_hold_the_sampled_states(fmi: int) -> None:
    knowns = ["reference", "command"]
    with Fmu(exported("loop", fmi)) as fmu, fmu.start(CO_SIMULATION) as slave:
        slave.set({"reference": 1.0})
        rates = [slave.directional(["voltage", "der(position)"], [k], [1.0]) for k in knowns]
        assert np.array(rates) == pytest.approx(np.array([[0.0, 0.0], [1.0, 500.0]]))
        slave.step(0.0, 0.5 * PERIOD)
        with pytest.raises(FmuError, match="sample instant fell into it") as refused:
            slave.directional(["position"], ["position"], [1.0])
        assert refused.value.status == DISCARD
        slave.step(0.5 * PERIOD, 0.25 * PERIOD)
        through = slave.directional(["position"], ["position"], [1.0])
        assert through[0] == pytest.approx(np.exp(-0.25 * PERIOD / 4e-3), rel=1e-6)


@pytest.mark.usefixtures("code_runs_here")
@pytest.mark.parametrize(("name", "fmi"), slow_but([("loop", 3)], [("loop", 3), ("controller", 2)]))
def test_check_passes(name: str, fmi: int) -> None:
    report = psa.check_fmu(exported(name, fmi), model_named(name))
    assert report.compared
    assert report.failures == ()


def test_illegal_values_leave_an_error() -> None:
    """A sample that is not finite is a step that failed, with a sentence."""
    with Fmu(exported("controller", 2)) as fmu, fmu.start(CO_SIMULATION) as slave:
        slave.set({"reference": 1e308, "position": -1e308})
        with pytest.raises(FmuError, match="sampled states cannot be evaluated") as failed:
            slave.step(0.0, PERIOD)
        assert failed.value.status in (DISCARD, ERROR)


SLOPE = 30.0
OUTPUTS = ("measured", "voltage")

#: Communication steps in periods: they divide it, are it, do not divide it, exceed it.
STEPS = pytest.mark.parametrize("step", [0.25, 1.0, 0.7, 2.5])


def reference(slope: float) -> Signals:
    """Return no disturbance, and a reference that starts at 1 m and rises."""
    values = np.array([[0.0, 1.0], [0.0, 1.0 + slope]])
    return Signals(("disturbance", "reference"), np.array([0.0, 1.0]), values)


def error(outputs: FloatArray, times: FloatArray, slope: float) -> float:
    truth = expected(times, 1.0, slope)
    return float(np.abs(outputs - np.column_stack([truth.position, truth.voltage])).max())


@VERSIONS
@STEPS
@pytest.mark.parametrize("start", [0.0, 3.0, 0.4])
def test_co_simulation(fmi: int, step: float, start: float) -> None:
    slope = SLOPE if fmi == 2 else 0.0  # FMI 3.0 has no rates of inputs
    times = grid(round(30 / step), step, start)
    with Fmu(exported("loop", fmi)) as fmu:
        values = co_simulate(fmu, times, reference(slope), OUTPUTS, tolerance=1e-10)
    assert error(values, times, slope) < 1e-9


@VERSIONS
@STEPS
@pytest.mark.parametrize("start", [0.0, 0.4])
def test_model_exchange(fmi: int, step: float, start: float) -> None:
    times = grid(round(30 / step), step, start)
    with Fmu(exported("loop", fmi)) as fmu:
        result = integrate(fmu, times, reference(SLOPE), OUTPUTS, tolerance=1e-11)
    assert error(result, times, SLOPE) < 1e-9


@VERSIONS
def test_time_events_of_model_exchange(fmi: int) -> None:
    with Fmu(exported("loop", fmi)) as fmu, fmu.open(MODEL_EXCHANGE) as instance:
        instance.setup(start_time=0.4 * PERIOD)
        instance.update_discrete_states()
        assert instance.next_event_time == PERIOD
        instance.require("EnterContinuousTimeMode")
        instance.set({"reference": 1.0})
        instance.require("SetTime", 0.7 * PERIOD)
        instance.require("EnterEventMode")  # of the importer, not an instant
        instance.update_discrete_states()
        assert instance.next_event_time == PERIOD
        assert instance.get(["command"])[0] == 0.0
        instance.require("EnterContinuousTimeMode")
        instance.require("SetTime", PERIOD)
        assert instance.get(["command"])[0] == 0.0
        instance.require("EnterEventMode")
        assert instance.update_discrete_states() == [False] * 4 + [True]
        assert instance.next_event_time == 2 * PERIOD
        assert instance.get(["command"])[0] == pytest.approx(0.6)
        instance.set({"reference": 2.0})  # an iteration over the event
        instance.update_discrete_states()
        assert instance.get(["voltage"])[0] == pytest.approx(1.2)
        instance.require("EnterContinuousTimeMode")
        instance.set({"reference": 3.0})
        assert instance.get(["voltage"])[0] == pytest.approx(1.2)
        instance.set({"T_s": 0.3 * PERIOD})
        instance.require("EnterEventMode")
        instance.update_discrete_states()
        assert instance.next_event_time == pytest.approx(1.2 * PERIOD)


COUNT = 121


def simulated(model: psa.Model, inputs: str, names: tuple[str, ...]) -> Mapping[str, FloatArray]:
    """Return variables of `Signal` on the grid of quarters of a period, at instants after them."""
    harness = f"model Harness {package_name(model)}.Signal it({inputs}); end Harness;"
    config = rumoca.SimConfig(solver="bdf", rtol=1e-11, atol=1e-16, dt=PERIOD / 4)
    span = PERIOD * (COUNT - 1) / 4
    result = load(modelica_text(model) + harness, "Harness").simulate(t=(0.0, span), config=config)
    times = np.asarray(result.time)
    rows = [np.flatnonzero(np.abs(times - t) < 1e-6 * PERIOD)[-1] for t in grid(COUNT, 0.25)]
    return {n: np.asarray(result[f"it.{n}"])[rows] for n in names}


def test_rumoca_follows_the_exact_recursion() -> None:
    names = ("position", "voltage", "integral", "command")
    result = simulated(loop(), "disturbance=0, reference=1.0 + 30.0*time", names)
    truth = expected(grid(COUNT, 0.25), 1.0, 30.0)
    columns = (truth.position, truth.voltage, truth.z[:, 0], truth.z[:, 1])
    for name, column in zip(names, columns, strict=True):
        assert np.abs(result[name] - column).max() < 1e-8, name


def _shared() -> psa.Model:
    """Return a model whose next values share a long part, and read a balance that they move."""

    def equations(s: psa.Symbols) -> psa.Equations:
        x, z, w = s.level, s.first, s.second
        part = (x - z) / (1.0 + (x + 2.0 * z) ** 2 + 0.3 * w**2) + 0.1 * z
        return psa.Equations(
            add={"displacement": z + x},
            der={"level": (s.push - x) / 5e-3},
            next={"first": 0.3 * part + 0.1 * s.displacement, "second": 0.2 * part**2 - 0.5 * w},
            out={"measured": s.displacement},
        )

    shared = psa.Component(
        "shared", "next values that share a part", "none", equations,
        parameters=(psa.Parameter("T_s", PERIOD, "s", (1e-6, 1.0), "sample period"),),
        states=(psa.State("level", "m", "level", nominal=1.0),),
        sampled=(
            psa.State("first", "m", "first", nominal=1.0, start=0.2),
            psa.State("second", "m", "second", nominal=1.0),
        ),
        sample_period="T_s",
        inputs=(psa.Input("push", "m", "push", nominal=1.0),),
        outputs=(psa.Output("measured", "m", "displacement"),),
    )  # fmt: skip
    return psa.compose([shared])


def test_shared_parts_and_balances_have_their_values_before_the_instant() -> None:
    model = _shared()
    text = modelica_text(model)
    clause = text.partition("when sample(0, T_s) then")[2].partition("end when;")[0]
    assert re.search(r"shared_part = .*pre\(first\)", clause)
    assert "discrete Real shared_part(start=0.0, fixed=true)" in text
    assert "displacement" not in clause
    result = simulated(model, "push=1.0 - 30.0*time", ("first", "second", "measured"))
    times = grid(COUNT, 0.25)
    steps = psa.run(model, times, (1.0 - 30.0 * times)[:, None], np.zeros(1), rtol=1e-12)
    for name, column in (("first", steps.z[:, 0]), ("second", steps.z[:, 1])):
        assert np.abs(result[name] - column).max() < 1e-8, name
    assert np.abs(result["measured"] - steps.y[:, 0]).max() < 1e-8
    assert np.ptp(steps.z[:, 0]) > 0.1
