"""Profile likelihoods: where they must agree with the linearised interval, and where not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.profile import PROFILE_LIMIT, Profile, profile
from psa_casadi.records import multisine, time_grid
from psa_casadi.records.split import whole
from psa_casadi.report.plots.findings import profile_plot
from psa_casadi.report.words.notes import profile_sentences

SIGMA = 2e-8
#: The lags of wafers and bonding layers are far below the sampling: a tenth and less of it.
SAMPLE = 2e-3


def plant() -> psa.Model:
    return psa.stack_model("demo").with_values({"delta": -0.5, "n": 1.3, "tau": 3e-3, "c_B": 8e3})


def record_of(model: psa.Model, seed: int, noise: float = SIGMA) -> psa.Record:
    time = time_grid(400 * SAMPLE, SAMPLE)
    voltage = multisine(time, 2.0, 60.0, (3.0, 40.0), seed=seed)
    x = psa.simulate(model, time, voltage).displacement
    x = x + noise * coloured(seed, len(time))
    return psa.Record(name=f"r{seed}", time=time, voltage=voltage, displacement=x)


def coloured(seed: int, count: int) -> FloatArray:
    """Return noise of variance 1 whose neighbours have the correlation 0.3."""
    white = np.random.default_rng(seed).standard_normal(count)
    noise: FloatArray = lfilter([np.sqrt(1.0 - 0.3**2)], [1.0, -0.3], white)
    return noise


@cache
def fitted(*free: str, noise: float = SIGMA) -> Fit:
    """Return a fit whose weights assume the noise SIGMA, whatever it is."""
    experiments = [whole(record_of(plant(), 1, noise))]
    return fit(plant(), experiments, free, sigma=[SIGMA])


def ends(p: Profile) -> tuple[float, float]:
    """Return both ends of a closed interval."""
    assert p.low is not None
    assert p.high is not None
    return p.low, p.high


@pytest.mark.parametrize("name", ["k_L", "tau", "beta", "n"])
def test_where_the_cost_is_quadratic_it_is_the_linearised_interval(name: str) -> None:
    result = fitted("k_L", "A", "beta", "gamma", "n", "tau")
    p = profile(result, name)
    linear = determinacy(result).intervals[name]
    (low, high), width = ends(p), linear.high - linear.low
    assert high - low == pytest.approx(width, rel=0.1)
    assert high + low == pytest.approx(linear.high + linear.low, abs=0.1 * width)
    assert p.estimate == result.model.values[name]
    assert np.all(np.diff(p.values) > 0)
    assert p.increase.min() == 0.0


def test_residuals_above_the_weights_widen_it() -> None:
    """The weights say 2e-8 m, the residuals 6e-8 m: the interval is three times as wide."""
    widths = []
    for noise in (SIGMA, 3.0 * SIGMA):
        result = fitted("k_L", "tau", noise=noise)
        low, high = ends(profile(result, "tau"))
        widths.append(high - low)
    assert widths[1] == pytest.approx(3.0 * widths[0], rel=0.1)


def test_at_its_ends_the_cost_of_the_best_fit_has_grown_by_the_limit() -> None:
    """R_s C_p is far below the sampling interval: no standard error describes its interval."""
    result = fitted("k_L", "tau", "R_s")
    p = profile(result, "R_s")
    assert p.high is not None

    def grown(value: float) -> float:
        model, starts = result.model.with_values({"R_s": value}), [result.start(0)]
        held = fit(
            model, result.experiments, ("k_L", "tau"), sigma=result.sigma, start_states=starts
        )
        return held.cost - result.cost

    unit = grown(float(p.values[-1])) / p.increase[-1]
    assert grown(p.high) / unit == pytest.approx(PROFILE_LIMIT, rel=0.1)
    if p.low is None:
        assert p.values[0] == pytest.approx(p.bounds[0], rel=1e-6)


def test_a_parameter_without_influence_is_open_on_both_sides() -> None:
    """The time constant of a creep of gain 0 changes nothing."""
    creep = psa.EFFECTS["slow_creep"]
    model = plant().with_effect(creep)
    free = next(q.name for q in creep.parameters if q.name != creep.gain)
    experiments = [whole(record_of(plant(), 1))]
    result = fit(model, experiments, ("k_L", free), sigma=[SIGMA])
    p = profile(result, free)
    assert p.low is None
    assert p.high is None
    assert p.increase.max() < 0.1
    assert p.values[0] == pytest.approx(p.bounds[0], rel=1e-6)
    assert p.values[-1] == pytest.approx(p.bounds[1], rel=1e-6)
    assert f"{free} is not determined" in profile_sentences(p)[0]


def test_a_lag_below_the_sampling_is_bounded_from_above_only() -> None:
    result = fitted("k_L", "tau", "c_P")
    p = profile(result, "c_P")
    assert p.low is None
    assert p.high is not None
    assert p.high > 1e3
    assert p.values[0] == pytest.approx(p.bounds[0], rel=1e-6)  # six decades below the limit
    assert 0.0 < p.increase[0] < PROFILE_LIMIT
    sentence = profile_sentences(p)[0]
    assert sentence.startswith("c_P is below")
    assert "nothing bounds it from below" in sentence


def test_a_fit_that_stopped_short_is_reported() -> None:
    result = fitted("k_L", "tau")
    theta = result.theta.copy()
    error = determinacy(result).standard_errors["tau"]
    moved = result.model.values["tau"] + 1.5 * error
    theta[:2] = result.unknowns.coordinates({**result.model.values, "tau": moved})
    short = replace(result, theta=theta, model=result.model.with_values({"tau": moved}))
    p = profile(short, "tau")
    complete = profile(result, "tau")
    assert len(profile_sentences(complete)) == 1
    assert "had not reached its minimum" in profile_sentences(p)[1]
    assert p.low == pytest.approx(complete.low, rel=2e-3)
    assert p.high == pytest.approx(complete.high, rel=2e-3)


def test_a_parameter_that_was_not_searched_has_no_profile() -> None:
    result = fitted("k_L", "tau")
    with pytest.raises(psa.InputError, match=r"'m_P' was not searched in this fit.*k_L, tau"):
        profile(result, "m_P")


def test_sentence_and_plot_show_profile_limit_and_interval() -> None:
    result = fitted("k_L", "tau")
    closed = profile(result, "tau")
    (sentence,) = profile_sentences(closed)
    assert sentence.startswith("tau lies between 2.")
    assert sentence.endswith("ms.")
    plot = profile_plot(closed)
    assert plot.layout["xaxis"]["title"]["text"] == "tau [ms]"
    np.testing.assert_allclose(plot.data[0]["x"], 1e3 * closed.values)
    np.testing.assert_allclose(plot.data[0]["y"], closed.increase)
    line, interval = plot.layout["shapes"]
    assert line["y0"] == line["y1"] == PROFILE_LIMIT
    assert (interval["x0"], interval["x1"]) == pytest.approx([1e3 * x for x in ends(closed)])
    # where the cost is quadratic the dotted parabola passes through the profile's points
    parabola = np.interp(plot.data[0]["x"], plot.data[1]["x"], plot.data[1]["y"])
    np.testing.assert_allclose(parabola, closed.increase, atol=0.3)
