"""Parameters that are none: a resistance over the charge, a spring that ages, one of a user."""

import numpy as np
import pytest

import psa_casadi as psa
from tests.any_model import hard_plants as hard


@pytest.mark.slow
def test_a_spring_that_ages_is_named_at_its_parameter() -> None:
    d = psa.diagnose(hard.spring(), hard.aged(0), leave_out=["hysteresis"])
    assert [c.effect for c in d.causes] == ["change_of_k_with_time"]
    assert d.causes[0].port == "the parameter k"
    values = d.model.values
    size, angle = (values[f"change_of_k_with_time_{n}"] for n in ("size", "angle"))
    ends = values["k"] * (1.0 + size * (np.cos(angle) + np.sin(angle)))
    assert values["k"] == pytest.approx(60.0, rel=0.02)
    assert ends == pytest.approx(60.0 * (1.0 - 0.15 * (1.0 - np.exp(-2.5))), rel=0.02)
    assert d.errors[0].extended < 0.2 * d.errors[0].base


@pytest.mark.slow
def test_a_resistance_over_the_charge_is_named_at_its_parameter() -> None:
    """Charged and discharged three times, so that the charge is no clock."""
    model, record = hard.battery()
    d = psa.diagnose(model, record, hold="zero", leave_out=["hysteresis", "stop"])
    assert [c.effect for c in d.causes] == ["change_of_R0_with_soc"]
    values = d.model.values
    at = np.array([0.0, 0.5]) / values["change_of_R0_with_soc_range"]
    size, angle = (values[f"change_of_R0_with_soc_{k}"] for k in ("size", "angle"))
    result = values["R0"] * (1.0 + size * (np.cos(angle) * at + np.sin(angle) * at**2))
    np.testing.assert_allclose(result, [0.05 * 2.2, 0.05 * 1.3], rtol=0.05)


def test_an_effect_of_ones_own_acts_at_a_parameter_and_is_kept(tmp_path: object) -> None:
    soft = psa.Component(
        "soft",
        description="the spring softens",
        source="this test",
        equations=lambda s: psa.Equations(add={"varied_k": -s.softer * s.k * s.time / 30.0}),
        parameters=(psa.Parameter("softer", 0.0, "1", (-1.0, 1.0), "share", scale=0.1),),
        gain="softer",
    )
    few = ["lag", "delay", "bend", "sat", "dead", "const", "loss", "fric", "drag", "curve", "stop"]
    few += ["hysteresis", "zero", "drift", "change"]
    d = psa.diagnose(hard.spring(), hard.aged(1), effects=[soft], leave_out=few)
    assert [c.effect for c in d.causes] == ["soft"]
    path = f"{tmp_path}/soft.json"
    psa.save_model(d.model, path)
    again = psa.load_model(path)
    t, u = 0.01 * np.arange(300, dtype=np.float64), np.ones((300, 1))
    x0 = np.zeros(2)
    np.testing.assert_array_equal(psa.run(again, t, u, x0).y, psa.run(d.model, t, u, x0).y)
