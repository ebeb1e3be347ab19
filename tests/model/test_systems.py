"""Wired systems: one model, its errors, and the nanopositioner against an independent loop."""

import math
from pathlib import Path

import numpy as np
import pytest
from fmpy import simulate_fmu

import psa_casadi as psa
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.model.nanopositioner import (
    positioner_plant,
)
from tests.export.modelica_runs import simulated
from tests.studies.benchmarks.nonlinearity import simulate_positioner
from tests.tiers import slow

STACK_AND_STAGE = (
    ("stack.displacement", "flexure.tip_position"),
    ("stack.velocity", "flexure.tip_velocity"),
    ("flexure.reaction_force", "stack.load_force"),
)


def _gain(name: str, unit: str = "V") -> psa.Model:
    """A part whose output follows its input at once."""
    part = psa.Component(
        name=name,
        description="twice the input",
        source="test",
        equations=lambda s: psa.Equations(out={"out": 2.0 * s.into}),
        inputs=(psa.Input("into", "V", "input", start=0.25),),
        outputs=(psa.Output("out", unit, "output"),),
    )
    return psa.compose([part], name=name)


def test_a_connected_model_has_the_equations_of_its_parts() -> None:
    """Derivatives and outputs of stack and stage at random points, wired by hand."""
    stack, stage = psa.stack_model("P-885.51").plant(), psa.part_model("flexure_stage")
    both = psa.connect({"stack": stack, "flexure": stage}, STACK_AND_STAGE, name="both")
    assert both.input_names == ("stack_voltage",)
    draw = np.random.default_rng(2)
    for _ in range(5):
        x = stack.state_nominals() * draw.normal(size=len(stack.state_names))
        x_f = stage.state_nominals() * draw.normal(size=2)
        tip = np.array([x[stack.state_names.index("x")], x[stack.state_names.index("v_x")]])
        slope, out = stage.structure.f(0.0, x_f, tip, stage.parameter_vector())
        force = float(out[stage.output_names.index("reaction_force")])
        own, shown = stack.structure.f(0.0, x, [30.0, force], stack.parameter_vector())
        got = both.structure.f(0.0, [*x, *x_f], [30.0], both.parameter_vector())
        parts = [np.array(v).ravel() for v in (own, slope, shown, out)]
        expected = np.concatenate(parts[:2]), np.concatenate(parts[2:])
        for found, wanted in zip(got, expected, strict=True):
            np.testing.assert_allclose(np.array(found).ravel(), wanted, rtol=1e-13)


def test_every_mistake_in_the_wires_is_told_at_once() -> None:
    parts = {"a": _gain("a"), "b": _gain("b"), "c": _gain("c", unit="m")}
    wires = (("a.out", "b.into"), ("b.out", "b.into"), ("c.out", "a.into"), ("a.there", "c.into"),
             ("nowhere.out", "c.into"))  # fmt: skip
    with pytest.raises(psa.InputError) as caught:
        psa.connect(parts, wires, name="m", inputs={"x": "b.into", "2y": "c.into"})
    text = str(caught.value)
    for part in (
        "'2y' cannot name",
        "'b.into' has two sources, 'a.out' and 'b.out'",
        "from 'c.out' [m] to 'a.into' [V] joins different units",
        "'a.there' is no output",
        "'nowhere.out' names no part",
        "has two sources, 'b.out' and 'x'",
    ):
        assert part in text


def test_an_algebraic_loop_is_named() -> None:
    parts = {"a": _gain("a"), "b": _gain("b")}
    with pytest.raises(psa.InputError, match=r"a\.out -> b\.out -> a\.out"):
        psa.connect(parts, (("a.out", "b.into"), ("b.out", "a.into")), name="m")


def test_sampled_parts_of_different_periods_are_refused() -> None:
    parts = {n: psa.part_model("position_controller", sample_time=t)
             for n, t in (("one", 1e-4), ("two", 2e-4))}  # fmt: skip
    with pytest.raises(
        psa.InputError, match=r"one_sample_time = 0\.0001 s, two_sample_time = 0\.0002 s"
    ):
        psa.connect(parts, (), name="m")


def _reference(t: float) -> float:
    return 5e-6 * (1.0 - math.cos(2.0 * math.pi * 250.0 * t))


@pytest.mark.parametrize("compensated", [False, True])
def test_the_closed_loop_is_that_of_an_independent_simulation(compensated: bool) -> None:
    """Position, command and voltage at every instant, against the loop in plain Python."""
    system = psa.nanopositioner(compensated=compensated)
    found = simulate_positioner(
        {n: m.values for n, m in system.parts.items()}, _reference, 4e-3, 5e-5
    )
    model = system.model()
    samples = np.array([[_reference(t)] for t in found.time])
    steps = psa.run(model, found.time, samples, np.zeros(len(model.state_names)), rtol=1e-9)
    shown = dict(zip(model.output_names, steps.y.T, strict=True))
    assert np.ptp(found.position) > 8e-6
    np.testing.assert_allclose(shown["stage_position"], found.position, atol=1e-12)
    np.testing.assert_allclose(shown["command"], found.command, atol=1e-6)
    np.testing.assert_allclose(shown["voltage"], found.voltage, atol=1e-5)


@pytest.mark.parametrize("stack", ["P-885.51", "PTBS200", "WYDS0808020"])
def test_the_tuned_loop_keeps_its_margins(stack: str) -> None:
    """The sensitivity asked for is met with the resonance where it is, and used up nearly."""
    plant = positioner_plant(stack).model()
    found = {}
    for limit in (1.4, 1.6):
        tuned = psa.controller_for(plant, position="stage_position", sensitivity=limit)
        found[limit] = psa.margins_of(plant, tuned, "stage_position")
        assert 1.2 < found[limit].sensitivity <= limit * 1.0001
        assert found[limit].gain > limit / (limit - 1.0)
        assert found[limit].phase > 2.0 * np.arcsin(0.5 / limit)
        for share in (0.9, 1.1):
            notch = share * tuned.values["notch_frequency"]
            beside = tuned.with_values({"notch_frequency": notch})
            assert psa.margins_of(plant, beside, "stage_position").sensitivity <= limit * 1.0001
    assert found[1.6].crossover > found[1.4].crossover > 50.0


def test_a_plant_that_cannot_be_tuned_is_refused() -> None:
    stack = psa.stack_model("P-885.51").plant()
    with pytest.raises(psa.InputError) as caught:
        psa.controller_for(stack, sensitivity=9.0, sample_time=-1.0)
    assert [p.split()[0] for p in caught.value.problems] == [
        "The", "The", "sample_time", "sensitivity",
    ]  # fmt: skip


@slow
def test_the_closed_loop_is_the_same_as_fmu_and_in_modelica(tmp_path: Path) -> None:
    """A step of 5 um: the stage in fmpy and in rumoca against `run`."""
    system = psa.nanopositioner()
    model = system.model()
    span, T = 2e-3, 5e-5
    t = np.linspace(0.0, span, 41)
    steps = psa.run(model, t, np.full((41, 1), 5e-6), np.zeros(len(model.state_names)), rtol=1e-9)
    wanted = steps.y[:, model.output_names.index("stage_position")]
    assert wanted[-1] > 4e-6
    path = psa.export_fmu(model, tmp_path / "loop.fmu")
    found = simulate_fmu(
        str(path), stop_time=span, output_interval=T, relative_tolerance=1e-9,
        start_values={"reference": 5e-6}, output=["stage_position"], fmi_type="CoSimulation",
    )  # fmt: skip
    at = np.interp(t, found["time"], found["stage_position"])
    np.testing.assert_allclose(at, wanted, atol=1e-6 * 5e-6)
    text = modelica_text(model, name="Loop")
    harness = "model Harness Loop.Signal positioner(reference=5e-6); end Harness;"
    got = simulated(text + harness, "Harness", span)
    at = np.interp(t, got["time"], got["positioner.stage_position"])
    np.testing.assert_allclose(at, wanted, atol=1e-5 * 5e-6)
