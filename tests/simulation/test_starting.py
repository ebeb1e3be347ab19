"""The scale of force that a fit starts with: a data sheet gives it, no displacement shows it."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.identification.start.ordinary import chosen_start
from psa_casadi.model.variables import Provenance

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


def test_a_start_says_whether_its_force_scale_is_known() -> None:
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
