"""Sampled states: their declaration, and simulation against an independent recursion."""

from dataclasses import replace

import numpy as np
import pytest

from psa_casadi.component import Component, Equations
from psa_casadi.errors import InputError
from psa_casadi.model.compose import compose
from psa_casadi.simulation.stepper import run
from psa_casadi.variables import Parameter, State
from tests.sampled_models import (
    ALONE,
    CONTROLLER,
    PERIOD,
    PLANT,
    FloatArray,
    controller,
    expected,
    grid,
    loop,
)

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
    steps = run(loop(), times, inputs(times, slope), np.zeros(1), rtol=1e-12)
    assert np.abs(steps.x[:, 0] - truth.position).max() < 1e-9
    assert np.abs(steps.z - truth.z).max() < 1e-9
    assert np.abs(steps.y - np.column_stack([truth.position, truth.voltage])).max() < 1e-9
    assert np.ptp(truth.voltage) > 0.2  # the loop is at work


def test_a_held_input_is_sampled_after_its_jump() -> None:
    times = grid(4, 1.0)
    reference = np.array([0.0, 0.0, 1.0, 1.0])
    u = np.column_stack([np.zeros(4), reference])
    z = run(loop(), times, u, np.zeros(1), hold="zero").z
    assert z[1, 1] == 0.0
    assert z[2, 1] == loop().values["k_p"]


def test_a_model_of_sampled_states_only() -> None:
    model, times = controller(), grid(41, 0.25)
    u = np.column_stack([np.ones_like(times), 0.3 * np.sin(400.0 * times)])
    steps = run(model, times, u, np.zeros(0))
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
    counter = Component(
        name="counter",
        description="counts instants",
        source="none",
        parameters=(Parameter("T_s", PERIOD, "s", (1e-6, 1.0), "sample period"),),
        sampled=(State("count", "m", "number of instants", nominal=1.0),),
        sample_period="T_s",
        equations=lambda s: Equations(
            add={"displacement": s.count}, next={"count": s.displacement + 1.0}
        ),
    )
    times = grid(4, 1.0)
    assert run(compose([counter]), times, np.zeros((4, 0)), np.zeros(0)).z[:, 0].tolist() == [
        1.0, 2.0, 3.0, 4.0,
    ]  # fmt: skip


def test_every_mistake_of_a_declaration_is_named() -> None:
    zero = replace(PLANT, name="p", parameters=(Parameter("T_0", 1.0, "s", (0.0, 1.0), "period"),))
    unsampled = replace(CONTROLLER, sampled=())
    with pytest.raises(InputError, match="declares only one of"):
        compose((PLANT, unsampled))
    with pytest.raises(InputError, match="'T_none' of component 'sampled_pi' is no parameter"):
        compose((PLANT, replace(CONTROLLER, sample_period="T_none")))
    with pytest.raises(InputError, match="'T_0' may be 0 by its bounds"):
        compose((zero, replace(CONTROLLER, sample_period="T_0")))
    second = replace(
        ALONE,
        name="second",
        parameters=(Parameter("T_2", 1.0, "s", (0.1, 1.0), "period"),),
        sampled=(State("more", "1", "more", nominal=1.0),),
        sample_period="T_2",
        inputs=(),
        outputs=(),
        equations=lambda s: Equations(next={"more": s.more}),
    )
    with pytest.raises(InputError, match=r"different periods \(T_2, T_s\)"):
        compose((PLANT, CONTROLLER, second))
    same = compose((PLANT, CONTROLLER, replace(second, parameters=(), sample_period="T_s")))
    assert same.sampled_names == ("integral", "command", "more")
    lacking = replace(CONTROLLER, equations=lambda s: Equations(out={"voltage": s.command}))
    with pytest.raises(InputError, match="lacks the next value of the sampled state 'command'"):
        compose((PLANT, lacking))
    more = replace(CONTROLLER, outputs=(), equations=lambda s: Equations(
        next={"integral": s.integral, "command": s.command, "gain": 1.0}))  # fmt: skip
    with pytest.raises(InputError, match="sampled state 'gain', which it does not declare"):
        compose((PLANT, more))
    with pytest.raises(InputError, match="Two components declare 'position'"):
        compose((PLANT, ALONE))


def test_sensitivities_are_refused() -> None:
    times = grid(4, 1.0)
    with pytest.raises(InputError, match="Sensitivities of a model with sampled states"):
        run(loop(), times, inputs(times, 0.0), np.zeros(1), unknowns=["k_p"], output="shown")
