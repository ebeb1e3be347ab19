"""Records that one simulation cannot follow: unstable, chaotic and integrating plants."""

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi.common.notes import Note
from psa_casadi.identification.experiments import experiments_of, given_to
from psa_casadi.identification.multistart import search_starts
from psa_casadi.simulation.stepper import SimulationError
from tests.any_model import hard_plants as hard


def _near(values: Mapping[str, float], truth: Mapping[str, float], rel: float = 0.04) -> None:
    for name, true_value in truth.items():
        assert values[name] == pytest.approx(true_value, rel=rel), name


def _codes(notes: Any) -> set[str]:
    return {n.code for n in notes if isinstance(n, Note)}


def test_parts_find_the_parameters_of_an_unstable_plant_and_that_its_input_is_held() -> None:
    model, record, truth = hard.pendulum()
    result = psa.identify(model, record)
    _near(result.model.values, truth)
    assert result.rms["measured"] == pytest.approx(0.002, rel=0.05)
    assert {"in_parts", "hold_found"} <= _codes(result.notes)
    assert len(result.experiments) > 4
    assert all(e.record.hold == "zero" for e in result.experiments)


def test_parts_find_the_parameters_of_chaos() -> None:
    model, record, truth = hard.duffing()
    result = psa.identify(model, record)
    _near(result.model.values, truth, rel=0.02)
    assert result.rms["x"] == pytest.approx(0.02, rel=0.05)
    assert "hold_found" not in _codes(result.notes)


@pytest.mark.slow
@pytest.mark.parametrize("plant", [hard.lorenz, hard.levitated])
def test_parts_are_as_short_as_a_plant_needs(plant: Callable[[], hard.Plant]) -> None:
    """Chaos with a hidden state; a rate that is not finite at 0, which no exact steps can have."""
    model, record, truth = plant()
    result = psa.identify(model, record)
    _near(result.model.values, truth, rel=0.01)
    assert all(result.rms[n] == pytest.approx(result.noise[n], rel=0.05) for n in result.rms)
    assert "in_parts" in _codes(result.notes)


def test_parts_are_fitted_where_no_whole_record_can_be_simulated() -> None:
    """A reaction that runs away within a second where nothing holds it."""
    rng, t, x = np.random.default_rng(6), 0.01 * np.arange(800, dtype=np.float64), np.zeros(801)
    u, x[0] = np.zeros(t.size), 2.0
    for k, now in enumerate(t):
        u[k] = -2.0 * x[k] ** 2 - 4.0 * (x[k] - 2.0 - 0.5 * np.sin(3.0 * now))
        rate = lambda _, z, u=u[k]: 2.0 * z**2 + u  # noqa: E731
        x[k + 1] = solve_ivp(rate, (0.0, 0.01), x[k : k + 1], rtol=1e-9).y[0, -1]
    q, inflow, a = (ca.SX.sym(n) for n in ("q", "u", "a"))
    model = psa.ode_model(
        {"x": q, "u": inflow, "p": a, "ode": a * q**2 + inflow, "y": q},
        name="runaway",
        outputs=["measured"],
        parameters=[psa.Parameter("a", 3.0, "1", (0.2, 20.0), "rate constant", log=True)],
    )
    record = {"time": t, "u": u, "measured": x[:-1] + 0.01 * rng.standard_normal(t.size)}
    whole = experiments_of(model, given_to(model, record, None), judged=False)
    with pytest.raises(SimulationError, match="cannot be simulated on these records"):
        search_starts(model, whole, ["a"], starts=1)
    _near(psa.identify(model, record, starts=1).model.values, {"a": 2.0}, rel=0.005)


def test_what_is_missing_in_an_unstable_plant_is_named() -> None:
    model, record, truth = hard.pendulum(drag=0.05)
    d = psa.diagnose(model, record)
    assert [c.effect for c in d.causes] == ["drag_in_w"]
    assert d.verdict == "cause_named"
    _near(d.model.values, truth, rel=0.1)
    at = d.model.values["drag_in_w_range"]
    drag = d.model.values["drag_in_w_size"] * d.model.values["J"] / at**2
    assert drag == pytest.approx(0.05, rel=0.04)
    assert d.errors[0].extended == pytest.approx(0.002, rel=0.15)


@pytest.mark.slow
def test_what_an_integrator_lacks_is_named_and_judged_on_the_whole_record() -> None:
    """A slide on a guide with dry friction and a slope, and no restoring force."""
    model, record, truth = hard.slide()
    d = psa.diagnose(model, record)
    assert {c.effect for c in d.causes} == {"friction_in_v", "constant_in_v"}
    assert {"in_parts", "hold_found"} <= _codes(d.remarks)
    assert len(d.experiments) == 1
    _near(d.model.values, truth, rel=0.01)
    _near({n: v * 50.0 for n, v in d.model.values.items()}, {"friction_in_v_size": 15.0})
    assert d.model.values["constant_in_v_size"] * 50.0 == pytest.approx(-4.0, rel=0.01)
    assert d.errors[0].base > 0.05
    assert d.errors[0].extended < 2e-5
