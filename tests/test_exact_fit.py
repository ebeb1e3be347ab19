"""Fits by exact steps: which way each record went, how accurately, and that the stepper agrees."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.identification.determinacy import covariance_of
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.fitting.prediction import measured, simulated
from psa_casadi.identification.search import free_parameters
from psa_casadi.model.compose import Model
from psa_casadi.records import Record, multisine, time_grid
from psa_casadi.records.split import Experiment, whole
from psa_casadi.simulation.simulate import simulate
from psa_casadi.simulation.ways import EXACT, STEPPER, Way
from tests.test_fit import model_with

FloatArray = NDArray[np.float64]

SIGMA, SAMPLES, STEP = 2e-8, 300, 2e-3


def record_at(time: FloatArray, sigma: float, seed: int = 1) -> Record:
    """Return a record of the demo stack under a multisine that is linear between `time`."""
    grid = time_grid(STEP * SAMPLES, STEP)
    voltage = np.interp(time, grid, multisine(grid, 2.0, 60.0, (3.0, 40.0), seed=seed))
    x = simulate(model_with(), time, voltage, rtol=1e-9).displacement
    white = np.random.default_rng(seed).standard_normal(len(time))
    return Record(name=f"r{seed}", time=time, voltage=voltage, displacement=x + sigma * white)


def regular(sigma: float = SIGMA, seed: int = 1) -> Record:
    return record_at(time_grid(STEP * SAMPLES, STEP), sigma, seed)


def fitted(experiments: list[Experiment], sigma: float, rtol: float = FIT_RTOL) -> Fit:
    model: Model = model_with()
    start = {"k_L": 1.05 * model.values["k_L"], "tau": 1.5 * model.values["tau"]}
    levels = [sigma] * len(experiments)
    return fit(model, experiments, free_parameters(model), sigma=levels, start=start, rtol=rtol)


def allowed(experiment: Experiment, sigma: float) -> float:
    return max(0.03 * sigma, 1e-6 * float(np.ptp(measured(experiment.record)[experiment.used])))


def standard_errors(found: Fit, experiments: list[Experiment]) -> FloatArray:
    return np.asarray(np.sqrt(np.diag(covariance_of(found, experiments))))


def test_a_fit_tells_way_and_error_of_each_record() -> None:
    experiments = [whole(regular()), whole(jittered(SIGMA, 2))]
    found = fitted(experiments, SIGMA)
    assert [s.way for s in found.simulated] == [EXACT, STEPPER]
    assert found.simulated[0].error <= allowed(experiments[0], SIGMA)
    assert found.simulated[1].error <= allowed(experiments[1], SIGMA)
    assert not found.way.stepped
    assert found.rms == pytest.approx(SIGMA, rel=0.15)


def test_the_error_that_is_told_is_that_against_the_stepper() -> None:
    """An estimate by a finer run: right within a factor, unless it is far below what counts."""
    experiments = [whole(regular())]
    found = fitted(experiments, SIGMA)
    fine = simulated_by(found, experiments, Way(1e-10, 1e-10, stepped=True))
    gap = float(np.sqrt(np.mean((found.predicted(experiments)[0] - fine) ** 2)))
    limit = allowed(experiments[0], SIGMA)
    assert gap <= limit
    assert gap <= 3.0 * found.simulated[0].error + 0.03 * limit


def simulated_by(found: Fit, experiments: list[Experiment], way: Way) -> FloatArray:
    """Return the prediction (n,) of the first record on another way."""
    return replace(found, way=way).predicted(experiments)[0]


@pytest.mark.parametrize("sigma", [1e-9, 1e-12])
def test_a_quiet_record_is_simulated_as_finely_as_it_needs(sigma: float) -> None:
    experiments = [whole(regular(sigma))]
    found = fitted(experiments, sigma)
    told = found.simulated[0]
    limit = allowed(experiments[0], sigma)
    assert told.way == STEPPER or told.error <= limit
    fine = simulated_by(found, experiments, Way(1e-11, 1e-11, stepped=True))
    gap = found.predicted(experiments)[0] - fine
    assert np.sqrt(np.mean(gap**2)) <= 3.0 * limit


def test_a_coarse_way_is_refused() -> None:
    """Where a run at 1e-5 misses by more than 3 % of the noise, the fit has gone on finer."""
    experiments = [whole(regular(1e-9))]
    coarse = fitted(experiments, 1e-9, rtol=1e-5)
    limit = allowed(experiments[0], 1e-9)
    told = simulated(coarse.model, experiments, coarse.unknowns, coarse.theta, way=Way(1e-5, 1e-5))[
        0
    ]
    if told.error > limit:
        assert coarse.way.stepped or coarse.way.rtol < 1e-5
    assert coarse.simulated[0].way == STEPPER or coarse.simulated[0].error <= limit


def jittered(sigma: float, seed: int = 1) -> Record:
    """Return the record at instants that are off by a thousandth of a sample."""
    shift = 1e-3 * STEP * np.random.default_rng(5).standard_normal(SAMPLES)
    shift[0] = 0.0
    return record_at(time_grid(STEP * SAMPLES, STEP) + shift, sigma, seed)


def test_a_stepped_record_is_as_accurate() -> None:
    """Noise of 1e-9 m is 5e-5 of the range."""
    experiments = [whole(jittered(1e-9, 2))]
    found = fitted(experiments, 1e-9)
    assert found.simulated[0].way == STEPPER
    fine = simulated_by(found, experiments, Way(1e-11, 1e-11, stepped=True))
    gap = found.predicted(experiments)[0] - fine
    assert np.sqrt(np.mean(gap**2)) <= 3.0 * allowed(experiments[0], 1e-9)


def test_both_ways_find_the_same_values() -> None:
    even, uneven = regular(), jittered(SIGMA)
    found = [fitted([whole(r)], SIGMA) for r in (even, uneven)]
    assert [f.simulated[0].way for f in found] == [EXACT, STEPPER]
    assert [f.converged for f in found] == [True, True]
    spread = standard_errors(found[0], [whole(even)])
    assert np.all(np.abs(found[0].theta - found[1].theta) <= 0.5 * spread)


def test_one_record_fits_the_same_on_both_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    experiments = [whole(regular())]
    exact = fitted(experiments, SIGMA)

    def refuse(*_: object) -> str:
        return "not wanted"

    monkeypatch.setattr("psa_casadi.simulation.exact.run.why_not", refuse)
    by_stepper = fitted(experiments, SIGMA)
    assert exact.simulated[0].way == EXACT
    assert by_stepper.simulated[0].way == STEPPER
    spread = standard_errors(exact, experiments)
    assert np.all(np.abs(exact.theta - by_stepper.theta) <= 0.5 * spread)
    assert by_stepper.cost == pytest.approx(exact.cost, abs=1.0)
