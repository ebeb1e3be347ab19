"""Sampled states in Modelica: the text, and what rumoca, an independent compiler, makes of it."""

import re
from collections.abc import Mapping

import numpy as np
import rumoca

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.export.modelica.package import modelica_text
from psa_casadi.model.compose import Model, compose
from psa_casadi.simulation.stepper import run
from psa_casadi.variables import Input, Output, Parameter, State
from tests.modelica_runs import load
from tests.sampled_models import PERIOD, FloatArray, expected, grid, loop

COUNT = 121


def simulated(model: Model, inputs: str, names: tuple[str, ...]) -> Mapping[str, FloatArray]:
    """Return variables of `Signal` on the grid of quarters of a period, at instants after them."""
    harness = f"model Harness PiezoStack.Signal it({inputs}); end Harness;"
    config = rumoca.SimConfig(solver="bdf", rtol=1e-11, atol=1e-16, dt=PERIOD / 4)
    span = PERIOD * (COUNT - 1) / 4
    result = load(modelica_text(model) + harness, "Harness").simulate(t=(0.0, span), config=config)
    times = np.asarray(result.time)
    rows = [np.flatnonzero(np.abs(times - t) < 1e-6 * PERIOD)[-1] for t in grid(COUNT, 0.25)]
    return {n: np.asarray(result[f"it.{n}"])[rows] for n in names}


def test_rumoca_follows_the_exact_recursion() -> None:
    names = ("position", "voltage", "integral", "command")
    found = simulated(loop(), "disturbance=0, reference=1.0 + 30.0*time", names)
    truth = expected(grid(COUNT, 0.25), 1.0, 30.0)
    columns = (truth.position, truth.voltage, truth.z[:, 0], truth.z[:, 1])
    for name, column in zip(names, columns, strict=True):
        assert np.abs(found[name] - column).max() < 1e-8, name


def _shared() -> Model:
    """Return a model whose next values share a long part, and read a balance that they move."""

    def equations(s: Symbols) -> Equations:
        part = _long_part(s)
        return Equations(
            add={"displacement": s.first + s.level},
            der={"level": (s.push - s.level) / 5e-3},
            next={
                "first": 0.3 * part + 0.1 * s.displacement,
                "second": 0.2 * part * part - 0.5 * s.second,
            },
            out={"shown": s.displacement},
        )

    return compose(
        [
            Component(
                name="shared",
                description="next values that share a part",
                source="none",
                parameters=(Parameter("T_s", PERIOD, "s", (1e-6, 1.0), "sample period"),),
                states=(State("level", "m", "level", nominal=1.0),),
                sampled=(
                    State("first", "m", "first", nominal=1.0, start=0.2),
                    State("second", "m", "second", nominal=1.0),
                ),
                sample_period="T_s",
                inputs=(Input("push", "m", "push", nominal=1.0),),
                outputs=(Output("shown", "m", "displacement"),),
                equations=equations,
            )
        ]
    )


def _long_part(s: Symbols) -> Expression:
    x, z, w = s.level, s.first, s.second
    return (x - z) / (1.0 + (x + 2.0 * z) ** 2 + 0.3 * w**2) + 0.1 * z


def test_shared_parts_and_balances_have_their_values_before_the_instant() -> None:
    model = _shared()
    text = modelica_text(model)
    clause = text.partition("when sample(0, T_s) then")[2].partition("end when;")[0]
    assert re.search(r"shared_part = .*pre\(first\)", clause)
    assert "discrete Real shared_part(start=0.0, fixed=true)" in text
    assert "displacement" not in clause
    found = simulated(model, "push=1.0 - 30.0*time", ("first", "second", "shown"))
    times = grid(COUNT, 0.25)
    steps = run(model, times, (1.0 - 30.0 * times)[:, None], np.zeros(1), rtol=1e-12)
    for name, column in (("first", steps.z[:, 0]), ("second", steps.z[:, 1])):
        assert np.abs(found[name] - column).max() < 1e-8, name
    assert np.abs(found["shown"] - steps.y[:, 0]).max() < 1e-8
    assert np.ptp(steps.z[:, 0]) > 0.1
