"""Fits by exact steps: which way each record went, how accurately, and that the stepper agrees."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.search import free_parameters
from psa_casadi.records import multisine, time_grid
from psa_casadi.records.split import Experiment, whole
from psa_casadi.simulation.exact.run import run_exact
from psa_casadi.simulation.simulate import EXACT, STEPPER, Way
from psa_casadi.simulation.start import start_on
from tests.identification.test_fit import model_with
from tests.simulation.exact_cases import OUTPUT, composite, inputs, times, with_effect

SIGMA, SAMPLES, STEP = 2e-8, 300, 2e-3


def record_at(time: FloatArray, sigma: float, seed: int = 1) -> psa.Record:
    """Return a record of the demo stack under a multisine that is linear between `time`."""
    grid = time_grid(STEP * SAMPLES, STEP)
    voltage = np.interp(time, grid, multisine(grid, 2.0, 60.0, (3.0, 40.0), seed=seed))
    x = psa.simulate(model_with(), time, voltage, rtol=1e-9).displacement
    white = np.random.default_rng(seed).standard_normal(len(time))
    return psa.Record(name=f"r{seed}", time=time, voltage=voltage, displacement=x + sigma * white)


def regular(sigma: float = SIGMA, seed: int = 1) -> psa.Record:
    return record_at(time_grid(STEP * SAMPLES, STEP), sigma, seed)


def fitted(experiments: list[Experiment], sigma: float, rtol: float = FIT_RTOL) -> Fit:
    model: psa.Model = model_with()
    start = {"k_L": 1.05 * model.values["k_L"], "tau": 1.5 * model.values["tau"]}
    levels = [sigma] * len(experiments)
    return fit(model, experiments, free_parameters(model), sigma=levels, start=start, rtol=rtol)


def allowed(experiment: Experiment, sigma: float) -> float:
    return max(0.03 * sigma, 1e-6 * float(np.ptp(measured(experiment.record)[experiment.used])))


def test_a_fit_tells_way_and_error_of_each_record() -> None:
    experiments = [whole(regular()), whole(jittered(SIGMA, 2))]
    result = fitted(experiments, SIGMA)
    assert [s.way for s in result.simulated] == [EXACT, STEPPER]
    assert result.simulated[0].errors[0] <= allowed(experiments[0], SIGMA)
    assert result.simulated[1].errors[0] <= allowed(experiments[1], SIGMA)
    assert not result.way.stepped
    assert result.rms == pytest.approx(SIGMA, rel=0.15)


def test_the_error_that_is_told_is_that_against_the_stepper() -> None:
    """An estimate by a finer run: right within a factor, unless it is far below what counts."""
    experiments = [whole(regular())]
    result = fitted(experiments, SIGMA)
    fine = simulated_by(result, experiments, Way(1e-10, 1e-10, stepped=True))
    gap = float(np.sqrt(np.mean((result.predicted(experiments)[0] - fine) ** 2)))
    limit = allowed(experiments[0], SIGMA)
    assert gap <= limit
    assert gap <= 3.0 * result.simulated[0].errors[0] + 0.03 * limit


def simulated_by(fit: Fit, experiments: list[Experiment], way: Way) -> FloatArray:
    """Return the prediction (n,) of the first record on another way."""
    return replace(fit, way=way).predicted(experiments)[0]


@pytest.mark.parametrize("sigma", [1e-9, 1e-12])
def test_a_quiet_record_is_simulated_as_finely_as_it_needs(sigma: float) -> None:
    experiments = [whole(regular(sigma))]
    result = fitted(experiments, sigma)
    output = result.simulated[0]
    limit = allowed(experiments[0], sigma)
    assert output.way == STEPPER or output.errors[0] <= limit
    fine = simulated_by(result, experiments, Way(1e-11, 1e-11, stepped=True))
    gap = result.predicted(experiments)[0] - fine
    assert np.sqrt(np.mean(gap**2)) <= 3.0 * limit


def jittered(sigma: float, seed: int = 1) -> psa.Record:
    """Return the record at instants that are off by a thousandth of a sample."""
    shift = 1e-3 * STEP * np.random.default_rng(5).standard_normal(SAMPLES)
    shift[0] = 0.0
    return record_at(time_grid(STEP * SAMPLES, STEP) + shift, sigma, seed)


BASE_UNKNOWNS = ("R_s", "C_p", "k_L", "A", "beta", "gamma", "delta", "n", "tau", "k_P", "c_B")
NAMES = ("base", *psa.EFFECTS)
DERIVED_SAMPLES, DERIVED_STEP = 240, 2e-4
#: What a run at 1e-8 may be off, over the largest value of a column; that of delta jumps.
ALLOWED, OF_DELTA = 2e-3, 1e-2


def unknowns_of(name: str, model: psa.Model) -> list[str | int]:
    """Return the effect's parameters, some of the base, and initial states."""
    item = [] if name == "base" else [p.name for p in psa.EFFECTS[name].parameters]
    memories = [s.name for s in model.structure.states if s.memory]
    starts = [model.state_names.index(n) for n in (*memories, "f_out")]
    return [*item, *BASE_UNKNOWNS, *starts]


def derived_record(model: psa.Model) -> tuple[FloatArray, FloatArray, FloatArray]:
    t = times(DERIVED_SAMPLES, DERIVED_STEP)
    u = inputs(model, t, composite(DERIVED_SAMPLES))
    return t, u, start_on(model, t, u).x


def initial(model: psa.Model, unknowns: list[str | int]) -> FloatArray:
    s0 = np.zeros((len(model.state_names), len(unknowns)))
    for column, unknown in enumerate(unknowns):
        if isinstance(unknown, int):
            s0[unknown, column] = 1.0
    return s0


def columns(name: str, tolerance: float) -> tuple[list[str | int], FloatArray, FloatArray]:
    """Return the unknowns, the derivatives of exact steps, and those of the stepper at 1e-12."""
    model = with_effect(name)
    t, u, x0 = derived_record(model)
    unknowns = unknowns_of(name, model)
    s0 = initial(model, unknowns)
    requested: Any = {"unknowns": unknowns, "s0": s0, "outputs": (OUTPUT,)}
    exact_steps = run_exact(model, t, u, x0, tolerance=tolerance, **requested)
    item = psa.run(model, t, u, x0, rtol=1e-12, **requested)
    return unknowns, exact_steps.sensitivity[:, 0], item.sensitivity[:, 0]


def off(array: FloatArray, true: FloatArray) -> float:
    """Return the largest difference over the column's largest value; 0 for columns of zeros."""
    size = float(np.abs(true).max())
    gap = float(np.abs(array - true).max())
    return gap / size if size > 0.0 else gap


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_are_the_stepper_s(name: str) -> None:
    unknowns, result, item = columns(name, 1e-8)
    gaps = {q: off(result[:, k], item[:, k]) for k, q in enumerate(unknowns)}
    for unknown, gap in gaps.items():
        assert gap < (OF_DELTA if unknown == "delta" else ALLOWED), unknown


def test_a_column_does_not_depend_on_the_others() -> None:
    """Columns stand side by side in vectors of four."""
    model = with_effect("load_stiffness")
    t, u, x0 = derived_record(model)
    many: list[str | int] = ["k_L", "A", "tau", "k_P", "load_gain", "c_B", 6]

    def derivatives(unknowns: list[str | int]) -> FloatArray:
        s0 = initial(model, unknowns)
        return run_exact(
            model, t, u, x0, tolerance=1e-6, unknowns=unknowns, s0=s0, outputs=(OUTPUT,)
        ).sensitivity[:, 0]

    together = derivatives(many)
    for column, unknown in enumerate(many):
        np.testing.assert_array_equal(derivatives([unknown])[:, 0], together[:, column])
