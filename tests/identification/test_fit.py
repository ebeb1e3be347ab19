"""Fits: coordinates, derivatives, the samples that count; exact steps against the stepper."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.fit import FIT_RTOL, Fit, Objective, fit
from psa_casadi.identification.fitting.prediction import Prediction, motions_of, predict
from psa_casadi.identification.fitting.unknowns import Unknowns, unknowns_of
from psa_casadi.identification.refitting import same_place
from psa_casadi.identification.search import fit_base, free_parameters
from psa_casadi.records import multisine, time_grid
from psa_casadi.records.split import Experiment, divided, whole
from psa_casadi.simulation.exact.run import run_exact
from psa_casadi.simulation.simulate import EXACT, STEPPER, Way
from psa_casadi.simulation.start import start_on
from psa_casadi.simulation.stepper import SimulationError
from tests.simulation.exact_cases import OUTPUT, composite, inputs, times, with_effect
from tests.tiers import slow

SIGMA = 2e-8


def model_with(*effects: str) -> psa.Model:
    model = psa.stack_model("demo").with_values({"delta": -0.5, "n": 1.3})
    for name in effects:
        model = model.with_effect(psa.EFFECTS[name])
    gains = {"creep_gain": 0.04, "delta_r": 0.02}
    return model.with_values({k: v for k, v in gains.items() if k in model.values})


def record_of(model: psa.Model, seed: int, samples: int = 400) -> psa.Record:
    time = time_grid(2e-3 * samples, 2e-3)
    voltage = multisine(time, 2.0, 60.0, (3.0, 40.0), seed=seed)
    white = SIGMA * np.random.default_rng(seed).standard_normal(samples)
    x = psa.simulate(model, time, voltage).displacement + 1e-6 * seed + white
    return psa.Record(name=f"r{seed}", time=time, voltage=voltage, displacement=x)


def moved(unknowns: Unknowns, seed: int) -> FloatArray:
    """Return a point some tenths of a unit away from the reference, within the bounds."""
    theta: FloatArray = 0.3 * np.random.default_rng(seed).standard_normal(unknowns.size)
    return np.clip(theta, *unknowns.bounds())


@pytest.mark.parametrize("effects", [(), ("slow_creep", "rate_independent_asymmetry")])
@pytest.mark.parametrize("seed", range(3))
def test_coordinates_invert_values_and_slopes_are_their_derivatives(
    effects: tuple[str, ...], seed: int
) -> None:
    model = model_with(*effects)
    unknowns = unknowns_of(model, free_parameters(model), [{}, {}], [2.0, 3.0], 1e-6)
    count = len(unknowns.names)
    at_reference = unknowns.values(np.zeros(unknowns.size))
    for name in unknowns.names:
        assert at_reference[name] == pytest.approx(model.values[name], rel=1e-14)
    theta = moved(unknowns, seed)
    values = unknowns.values(theta)
    assert unknowns.loop is not None
    np.testing.assert_allclose(unknowns.coordinates(values), theta[:count], rtol=0, atol=1e-10)
    slopes = unknowns.slopes(theta)
    for k in range(count):
        step = 1e-6 * np.eye(unknowns.size)[k]
        up, down = (np.array(list(unknowns.values(theta + h).values())) for h in (step, -step))
        size = np.abs(np.array(list(values.values())))
        assert np.all(np.abs((up - down) / 2e-6 - slopes[:, k]) <= 1e-7 * (size + 1e-3))


@pytest.mark.parametrize(
    "effects", [(), pytest.param(("slow_creep", "rate_independent_asymmetry"), marks=slow)]
)
def test_the_jacobian_is_central_differences_of_predictions(effects: tuple[str, ...]) -> None:
    """Two runs differ by up to 4e-7 of the range over the step, for they step differently."""
    model = model_with(*effects)
    experiments = [whole(record_of(model, seed, 120)) for seed in (1, 2)]
    unknowns = unknowns_of(model, free_parameters(model), [{}, {}], [2.0, 3.0], 1e-6)
    theta, step = moved(unknowns, 4), 1e-2

    def predicted(point: FloatArray) -> tuple[FloatArray, FloatArray]:
        parts = predict(model, experiments, unknowns, point, way=Way(1e-9, 1e-9, stepped=True))
        displacement = np.concatenate([p.displacement for p in parts])
        return displacement, np.vstack([p.jacobian for p in parts])

    x, exact = predicted(theta)
    assert exact.shape == (240, unknowns.size)
    for k, h in enumerate(step * np.eye(unknowns.size)):
        result = (predicted(theta + h)[0] - predicted(theta - h)[0]) / (2 * step)
        error, size = result - exact[:, k], exact[:, k]
        assert np.abs(error).max() < 2e-3 * np.abs(size).max() + 1e-6 * np.ptp(x) / step
        assert np.sqrt(np.mean(error**2)) < 0.05 * np.sqrt(np.mean(size**2))


def test_missing_samples_are_ignored() -> None:
    """Samples lost to nan count as little as samples that are wild but not used."""
    model = model_with()
    record = record_of(model, 1)
    rng = np.random.default_rng(8)
    lost = rng.uniform(size=record.n) < 0.3
    lost[50:80] = True
    assert record.displacement is not None
    y = record.displacement
    as_nan = replace(record, displacement=np.where(lost, np.nan, y))
    as_wild = replace(record, displacement=np.where(lost, rng.uniform(-1.0, 1.0, record.n), y))
    none = np.zeros(record.n, dtype=np.bool_)
    items = [
        fitted(model, [e]) for e in (whole(as_nan), Experiment(as_wild, ~lost, none), whole(record))
    ]
    np.testing.assert_array_equal(items[0].theta, items[1].theta)
    np.testing.assert_array_equal(items[0].residuals, items[1].residuals)
    assert len(items[0].residuals) == record.n - np.count_nonzero(lost)
    assert items[0].rms == pytest.approx(SIGMA, rel=0.1)
    for name in ("k_L", "A"):
        assert items[0].model.values[name] == pytest.approx(items[2].model.values[name], rel=0.02)
    assert items[0].model.values["k_L"] != items[2].model.values["k_L"]


def fitted(model: psa.Model, experiments: Sequence[Experiment]) -> Fit:
    start = {"k_L": 1.05 * model.values["k_L"], "tau": 1.5 * model.values["tau"]}
    free = free_parameters(model)
    return fit(model, experiments, free, sigma=[SIGMA] * len(experiments), start=start)


def test_the_parts_of_a_fit_belong_together() -> None:
    model = model_with()
    experiments = [whole(record_of(model, seed)) for seed in (1, 2)]
    result = fitted(model, experiments)
    assert result.converged
    assert result.sigma == (SIGMA, SIGMA)
    measured = np.concatenate([np.asarray(e.record.displacement) for e in experiments])
    predicted = np.concatenate(result.predicted())
    np.testing.assert_allclose(result.residuals, measured - predicted, rtol=0, atol=1e-3 * SIGMA)
    priors = result.theta / result.unknowns.prior
    cost = np.sum((result.residuals / SIGMA) ** 2) + np.sum(priors**2)
    assert result.cost == pytest.approx(cost, rel=1e-12)
    gradient = -result.jacobian.T @ result.residuals / SIGMA**2 + priors / result.unknowns.prior
    size = np.linalg.norm(result.jacobian / SIGMA, axis=0)
    low, high = result.unknowns.bounds()
    pushed = np.where(result.theta <= low, np.minimum(gradient, 0.0), gradient)
    pushed = np.where(result.theta >= high, np.maximum(gradient, 0.0), pushed)
    assert np.all(np.abs(pushed) < 0.1 * size)  # within a tenth of a standard deviation
    assert result.offset(1) - result.offset(0) == pytest.approx(1e-6, abs=SIGMA)
    assert abs(result.start(0)["f_H"]) < 3.0


def _after_a_history(model: psa.Model, peak: float, seed: int) -> psa.Record:
    """A record that starts at 20 V, where the stack has come down to from a peak."""
    time = time_grid(4.0, 2e-3)
    before = time < 2.0
    down = np.interp(time, [0.0, 1.0, 2.0], [0.0, peak, 20.0])
    again = 20.0 + 25.0 * (1.0 - np.cos(2.0 * np.pi * (time - 2.0))) * (time / 4.0)
    voltage = np.where(before, down, again)
    x = psa.simulate(model, time, voltage).displacement
    x = x + SIGMA * np.random.default_rng(seed).standard_normal(time.size)
    t, v, y = (column[~before] for column in (time, voltage, x))
    return psa.Record(name=f"h{seed}", time=t - t[0], voltage=v, displacement=y)


def test_a_record_that_is_held_out_starts_as_the_others_of_its_device_do() -> None:
    """Also where its first tenth gives another memory, by an error that the model has there."""
    model = model_with()
    records = [_after_a_history(model, 90.0, seed) for seed in (1, 2, 3)]
    held = records[2]
    wrong = np.asarray(held.displacement).copy()
    lead = np.arange(held.n) < held.n // 10
    wrong[lead] += 40.0 * SIGMA * np.linspace(-1.0, 1.0, int(lead.sum()))
    experiments = divided(records[:2], [replace(held, displacement=wrong)])
    result = fitted(model, experiments)
    shared, item = result.predicted()[2], _from_first_tenth(result, experiments[2])
    truth = np.asarray(held.displacement)[~lead]
    errors = [float(np.std(x[~lead] - truth)) for x in (shared, item)]
    assert errors[0] < 1.1 * SIGMA < 2.0 * SIGMA < errors[1]
    # a record with another first voltage has another start
    other = record_of(model, 5)
    apart = divided(records[:2], [replace(other, voltage=other.voltage + 5.0)])
    elsewhere = fitted(model, apart)
    plain = _from_first_tenth(elsewhere, apart[2])
    np.testing.assert_allclose(elsewhere.predicted()[2], plain, rtol=0, atol=0.1 * SIGMA)


def _from_first_tenth(whole_fit: Fit, held: Experiment) -> FloatArray:
    """The prediction of a record whose start and offset are fitted to its first tenth."""
    lead = Experiment(held.record, held.known, held.held_out)
    return fit(whole_fit.model, [lead], [], sigma=[SIGMA]).predicted()[0]


def test_no_fit_sees_a_sample_of_a_record_that_is_held_out() -> None:
    """Not of its first tenth either, which only gives the start of its prediction."""
    model = model_with()
    records = [record_of(model, seed) for seed in (1, 2, 3)]
    nonsense = np.random.default_rng(4).standard_normal(records[2].n)
    sampled = replace(records[2], time=0.1 * records[2].time)
    others = [replace(sampled, displacement=1e-4 * nonsense), records[2]]
    fits = [fitted(model, divided(records[:2], [held])) for held in others]
    alone = fitted(model, [whole(r) for r in records[:2]])
    count = alone.unknowns.size
    for result in fits:
        np.testing.assert_allclose(result.theta[:count], alone.theta, rtol=1e-6)
        np.testing.assert_allclose(result.residuals, alone.residuals, rtol=0, atol=1e-6 * SIGMA)
        assert not np.any(result.theta[count:])
        assert not np.any(result.jacobian[:, count:])
    # nor does the search for the start of a fit
    bases = [fit_base(model, divided(records[:2], [held])) for held in others]
    assert bases[0].model.values == bases[1].model.values


@pytest.mark.parametrize(
    ("ranges", "slope", "evaluated"), [(1e4, 0.0, True), (1e8, 0.0, False), (1.0, 1e160, False)]
)
def test_a_loop_that_has_left_the_record_far_behind_has_diverged(
    ranges: float, slope: float, evaluated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its numbers are finite; their squares overflow, or each evaluation would take far longer."""
    model = model_with()
    experiments = [whole(record_of(model, 1))]
    result = fitted(model, experiments)
    evaluate = Objective(model, experiments, result.unknowns, [SIGMA], result.way)
    samples = experiments[0].record.n
    far = np.full(samples, ranges * experiments[0].record.range_m)
    slopes = np.full((samples, result.unknowns.size), slope)
    monkeypatch.setattr(
        "psa_casadi.identification.fitting.fit.predict",
        lambda *_, **__: [Prediction(far, slopes, "exact")],
    )
    assert (evaluate(result.theta) is not None) == evaluated


def test_a_fit_without_samples_is_refused() -> None:
    record = record_of(model_with(), 1)
    none = np.zeros(record.n, dtype=np.bool_)
    with pytest.raises(psa.InputError, match="No sample with a displacement is left to fit"):
        fit(model_with(), [Experiment(record, none, none)], ["k_L"], sigma=[SIGMA])
    bare = replace(record, displacement=None)
    with pytest.raises(psa.InputError, match="No sample with a displacement is left to fit"):
        fit(psa.compose(psa.BASE), [Experiment(bare, ~none, none)], ["k_L"], sigma=[SIGMA])


def test_a_stack_that_never_settles_leaves_no_start_open(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial point may be undamped: there is no time after which its start is forgotten."""
    monkeypatch.setattr(
        "psa_casadi.identification.fitting.prediction.settling_time", lambda model: np.inf
    )
    assert motions_of(model_with(), record_of(model_with(), 1), SIGMA) == {}


def test_numbers_that_overflow_are_no_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """What tries a fit tries the next one then."""
    monkeypatch.setattr(
        "psa_casadi.identification.fitting.fit.motions_of", lambda *_: {"f": 1 / 0.0}
    )
    record = record_of(model_with(), 1)
    with pytest.raises(SimulationError, match="numbers of the fit overflow"):
        fit(model_with(), [whole(record)], ["k_L"], sigma=[SIGMA])


def test_fits_of_one_minimum_are_the_same_place_wherever_their_priors_count_from() -> None:
    """The prior of a lag is a factor of e around the model's value, here off by e^7."""
    model = psa.stack_model("demo")
    time = time_grid(4e-3, 5e-6)
    voltage = multisine(time, 0.0, 60.0, (500.0, 3e4), seed=3)
    x = psa.simulate(model, time, voltage, memory={"f_H": 0.0}).displacement
    noise = 2e-9 * np.random.default_rng(3).standard_normal(time.size)
    record = psa.Record(name="fast", time=time, voltage=voltage, displacement=x + noise)
    free, experiments, right = ["k_L", "c_B", "m_B"], [whole(record)], model.values["c_B"]
    off = model.with_values({"c_B": right * np.exp(7.0)})
    near = fit(model, experiments, free, sigma=[2e-9])
    far = fit(off, experiments, free, sigma=[2e-9], start={"c_B": right})
    assert far.cost > near.cost + 45.0
    for result in (near, far):
        squares = float(np.sum((result.residuals / 2e-9) ** 2))
        assert result.data_cost == pytest.approx(squares, rel=1e-9)
    assert far.data_cost == pytest.approx(near.data_cost, abs=0.1)
    assert same_place(near, far)


SAMPLES, STEP = 300, 2e-3


def record_at(time: FloatArray, sigma: float, seed: int = 1) -> psa.Record:
    """Return a record of the demo stack under a multisine that is linear between `time`."""
    grid = time_grid(STEP * SAMPLES, STEP)
    voltage = np.interp(time, grid, multisine(grid, 2.0, 60.0, (3.0, 40.0), seed=seed))
    x = psa.simulate(model_with(), time, voltage, rtol=1e-9).displacement
    white = np.random.default_rng(seed).standard_normal(len(time))
    return psa.Record(name=f"r{seed}", time=time, voltage=voltage, displacement=x + sigma * white)


def regular(sigma: float = SIGMA, seed: int = 1) -> psa.Record:
    return record_at(time_grid(STEP * SAMPLES, STEP), sigma, seed)


def fitted_demo(experiments: list[Experiment], sigma: float, rtol: float = FIT_RTOL) -> Fit:
    model: psa.Model = model_with()
    start = {"k_L": 1.05 * model.values["k_L"], "tau": 1.5 * model.values["tau"]}
    levels = [sigma] * len(experiments)
    return fit(model, experiments, free_parameters(model), sigma=levels, start=start, rtol=rtol)


def allowed(experiment: Experiment, sigma: float) -> float:
    return max(0.03 * sigma, 1e-6 * float(np.ptp(experiment.record.measured[experiment.used])))


def test_a_fit_reports_way_and_error_of_each_record() -> None:
    experiments = [whole(regular()), whole(jittered(SIGMA, 2))]
    result = fitted_demo(experiments, SIGMA)
    assert [s.way for s in result.simulated] == [EXACT, STEPPER]
    assert result.simulated[0].errors[0] <= allowed(experiments[0], SIGMA)
    assert result.simulated[1].errors[0] <= allowed(experiments[1], SIGMA)
    assert not result.way.stepped
    assert result.rms == pytest.approx(SIGMA, rel=0.15)


def test_the_reported_error_is_that_against_the_stepper() -> None:
    """An estimate by a finer run: right within a factor, unless it is far below what counts."""
    experiments = [whole(regular())]
    result = fitted_demo(experiments, SIGMA)
    fine = simulated_by(result, experiments, Way(1e-10, 1e-10, stepped=True))
    gap = float(np.sqrt(np.mean((result.predicted()[0] - fine) ** 2)))
    limit = allowed(experiments[0], SIGMA)
    assert gap <= limit
    assert gap <= 3.0 * result.simulated[0].errors[0] + 0.03 * limit


def simulated_by(fit: Fit, experiments: list[Experiment], way: Way) -> FloatArray:
    """Return the prediction (n,) of the first record on another way."""
    return replace(fit, way=way).predicted()[0]


@pytest.mark.parametrize("sigma", [1e-9, 1e-12])
def test_a_quiet_record_is_simulated_as_finely_as_it_needs(sigma: float) -> None:
    experiments = [whole(regular(sigma))]
    result = fitted_demo(experiments, sigma)
    output = result.simulated[0]
    limit = allowed(experiments[0], sigma)
    assert output.way == STEPPER or output.errors[0] <= limit
    fine = simulated_by(result, experiments, Way(1e-11, 1e-11, stepped=True))
    gap = result.predicted()[0] - fine
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


def effect_unknowns(name: str, model: psa.Model) -> list[str | int]:
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
    unknowns = effect_unknowns(name, model)
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
