"""The communication step that the page of an FMU names for inputs that are held over it."""

import html
import re
from dataclasses import replace

import numpy as np
import pytest

from psa_casadi.export.fmu.reference_run import SHARE, STEPS_PER_PERIOD, held_step, reference_inputs
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.masters import Signals, co_simulate
from psa_casadi.simulation.stepper import run
from psa_casadi.units import FloatArray
from tests.fmu_models import entries, exported, model_named
from tests.tiers import slow

STACK = "P-885.51"


def _named_step(fmi: int) -> float:
    page = html.unescape(entries(STACK, fmi)["documentation/index.html"].decode())
    found = re.search(r"a step of (\S+) s keeps the error to (\S+) % of", " ".join(page.split()))
    assert found is not None
    assert float(found[2]) <= 100.0 * SHARE
    return float(found[1])


@slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_step_on_the_page_keeps_the_fmu_within_a_thousandth_and_twice_it_does_not(
    fmi: int,
) -> None:
    times, inputs = reference_inputs(model_named(STACK).plant())
    kinks = Signals(("voltage", "load_force"), times, inputs)

    def displacement(step: float, *, held: bool) -> FloatArray:
        grid = np.linspace(0.0, times[-1], round(times[-1] / step) + 1)
        given = replace(kinks.on(grid), held=held)
        with Fmu(exported(STACK, 2 if not held else fmi)) as fmu:
            found = co_simulate(fmu, grid, given, ["displacement"], settled=True)
        return np.interp(times, grid, found[:, 0])

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
    rated = 120.0
    grid = np.arange(STEPS_PER_PERIOD + 1) / (STEPS_PER_PERIOD * frequency)
    voltage = 0.5 * rated * (1.0 - np.cos(2 * np.pi * frequency * grid))
    u = np.column_stack([voltage, np.zeros_like(voltage)])
    at_rest, column = np.zeros(len(model.state_names)), model.output_names.index("displacement")
    truth = run(model, grid, u, at_rest, rtol=1e-8).y[:, column]
    for every, limits in ((1, (0.25, 1.0)), (2, (1.0, 2.5))):
        rows = slice(None, None, every)
        found = run(model, grid[rows], u[rows], at_rest, rtol=1e-8, hold="zero").y[:, column]
        error = np.abs(found - truth[rows]).max() / np.ptp(truth)
        assert limits[0] * SHARE < error <= limits[1] * SHARE, (every, error)


def test_a_model_without_input_or_motion_has_no_such_step() -> None:
    flexure = model_named("flexure")
    assert held_step(replace(flexure, structure=replace(flexure.structure, outputs=()))) is None
    assert held_step(flexure) is not None
