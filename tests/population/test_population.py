"""The statistics of a population against published figures, plain formulas and simulation."""

from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.population.population import Estimate, Finding, differences, frequencies, population
from psa_casadi.population.statistics import adjusted, batch_test, drift, mixed_regression, outliers
from tests.tiers import slow_but

# Thirteen trials of a vaccine: events and others, treated and control, and the latitude (G. A.
# Colditz et al., JAMA 271 (1994) 698).
TREATED = np.array([4, 6, 3, 62, 33, 180, 8, 505, 29, 17, 186, 5, 27.0])
TREATED_NOT = np.array(
    [119, 300, 228, 13536, 5036, 1361, 2537, 87886, 7470, 1699, 50448, 2493, 16886.0]
)
CONTROL = np.array([11, 29, 11, 248, 47, 372, 10, 499, 45, 65, 141, 3, 29.0])
CONTROL_NOT = np.array(
    [128, 274, 209, 12619, 5761, 1079, 619, 87892, 7232, 1600, 27197, 2338, 17825.0]
)
LATITUDE = np.array([44, 55, 42, 52, 13, 44, 19, 13, 27, 42, 18, 33, 33.0])


def vaccine() -> tuple[FloatArray, FloatArray]:
    """Return ln of the relative risks and their standard errors."""
    treated, control = TREATED + TREATED_NOT, CONTROL + CONTROL_NOT
    ratio = np.log(TREATED / treated / (CONTROL / control))
    return ratio, np.sqrt(1 / TREATED - 1 / treated + 1 / CONTROL - 1 / control)


def test_published_figures_come_out() -> None:
    """As W. Viechtbauer, J. Stat. Softw. 36 (2010) 3 prints them (package metafor)."""
    y, s = vaccine()
    fit = mixed_regression(y, s)
    assert fit.q == pytest.approx(152.2330, abs=1e-3)
    assert fit.tau_interval[0] ** 2 == pytest.approx(0.1197, abs=1e-4)
    assert fit.tau_interval[1] ** 2 == pytest.approx(1.1115, abs=1e-4)
    by_latitude = mixed_regression(y, s, np.column_stack([np.ones(13), LATITUDE]))
    assert by_latitude.q == pytest.approx(30.7331, abs=1e-3)
    assert by_latitude.dof == 11


def test_tau_is_where_q_is_expected() -> None:
    y, s = vaccine()

    def q(tau2: float) -> float:
        w = 1.0 / (s**2 + tau2)
        mean = np.average(y, weights=w)
        return float(np.sum(w * (y - mean) ** 2)) - 12.0

    tau2 = float(optimize.brentq(q, 0.0, 10.0, xtol=1e-14))
    fit = mixed_regression(y, s)
    assert fit.tau**2 == pytest.approx(tau2, rel=1e-7)
    w = 1.0 / (s**2 + tau2)
    mean, error = np.average(y, weights=w), 1.0 / np.sqrt(w.sum())
    half = stats.t.ppf(0.975, 12) * error
    assert fit.interval() == pytest.approx((mean - half, mean + half), rel=1e-7)


@pytest.mark.parametrize("tau", slow_but([1.0], [0.0, 1.0]))
def test_intervals_cover_and_few_are_told_without_cause(tau: float) -> None:
    rng = np.random.default_rng(3)
    rounds, tau_in, mean_in, alarms = 600, 0, 0, 0
    for k in range(rounds):
        s = rng.uniform(0.5, 2.0, 16)
        y = 3.0 + tau * rng.standard_normal(16) + s * rng.standard_normal(16)
        fit = mixed_regression(y, s)
        tau_in += fit.tau_interval[0] <= tau <= fit.tau_interval[1]
        mean_in += fit.interval()[0] <= 3.0 <= fit.interval()[1]
        alarms += k < 300 and bool(outliers(y, s).outlying.any())
    assert 0.925 < tau_in / rounds < (0.97 if tau else 0.99)  # at 0 one end always covers
    assert 0.925 < mean_in / rounds < 0.985
    assert alarms / 300 < 0.09  # 5 % are meant


def test_z_is_the_studentized_deleted_residual() -> None:
    """With one noise for all, tau and noise together are the variance of the others."""
    y = np.random.default_rng(5).standard_normal(12)
    result = outliers(y, np.full(12, 1e-3))
    for i in range(12):
        others = np.delete(y, i)
        z = (y[i] - others.mean()) / (others.std(ddof=1) * np.sqrt(1 + 1 / 11))
        assert result.z[i] == pytest.approx(z, rel=1e-6)
        assert result.p[i] == pytest.approx(2 * stats.t.sf(abs(z), 10), rel=1e-5)


def test_outliers_do_not_hide_each_other() -> None:
    rng = np.random.default_rng(11)
    s = rng.uniform(0.5, 1.5, 60)
    y = rng.standard_normal(60) + s * rng.standard_normal(60)
    y[[3, 17, 40]] += [9.0, 10.0, -11.0]
    result = outliers(y, s)
    assert set(np.flatnonzero(result.outlying)) == {3, 17, 40}


def test_p_values_are_adjusted_as_defined() -> None:
    p = np.array([0.01, 0.04, 0.03, 0.005])
    assert adjusted(p, "bonferroni") == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert adjusted(p) == pytest.approx([0.02, 0.04, 0.04, 0.02])
    assert adjusted([]).size == 0


def test_batches_are_the_analysis_of_variance_where_noise_is_small() -> None:
    rng = np.random.default_rng(8)
    names = [n for n in "abc" for _ in range(7)]
    y = rng.standard_normal(21) + np.repeat([0.0, 0.0, 2.0], 7)
    result = batch_test(y, np.full(21, 1e-3), names)
    expected = stats.f_oneway(y[:7], y[7:14], y[14:])
    assert result.f == pytest.approx(expected.statistic, rel=1e-5)
    assert result.p_value == pytest.approx(expected.pvalue, rel=1e-4)
    parts = y.reshape(3, 7)
    noise = np.sqrt(parts.var(axis=1, ddof=1).mean() * (1 / 7 + 1 / 14))
    differs = [parts[k].mean() - np.delete(parts, k, 0).mean() for k in range(3)]
    p = np.sort(2 * stats.t.sf(np.abs(differs) / noise, 18)) * [3, 2, 1]
    assert [b.differs_by for b in result.batches] == pytest.approx(differs)
    assert sorted(b.p_adjusted for b in result.batches) == pytest.approx(p, rel=1e-3)
    assert result.batches[2].mean == pytest.approx(y[14:].mean())


def test_drift_is_linear_regression_where_noise_is_small() -> None:
    rng = np.random.default_rng(9)
    t = np.sort(rng.uniform(2024.0, 2026.0, 30))
    y = 0.8 * t + rng.standard_normal(30)
    result = drift(y, np.full(30, 1e-3), t)
    expected = stats.linregress(t, y)
    assert result.slope == pytest.approx(expected.slope, rel=1e-6)
    assert result.p_value == pytest.approx(expected.pvalue, rel=1e-3)


@pytest.mark.parametrize("errors", [(1.0, 0.0, 1.0), (1.0, np.nan, 1.0)])
def test_errors_that_are_none_are_refused(errors: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="not positive"):
        mixed_regression([1.0, 2.0, 3.0], errors)
    with pytest.raises(InputError, match="give more"):
        mixed_regression([1.0], [1.0])


def finding(name: str, k_l: float, half: float, **more: Any) -> Finding:
    """Return a device with one parameter that is determined and one that is not."""
    table = {
        "k_L": Estimate(k_l, "N/V", (k_l * np.exp(-half), k_l * np.exp(half))),
        "tau": Estimate(1e-3, "s", (1e-9, 1.0), determined=False),
    }
    return Finding(name, "identification", table, **more)


def test_a_population_tells_outliers_and_causes() -> None:
    rng = np.random.default_rng(2)
    sizes = 7.0 * np.exp(0.01 * rng.standard_normal(30))
    sizes[4] *= 1.2
    result = population([finding(f"d{k}", v, 0.005) for k, v in enumerate(sizes)])
    assert {o.device for o in result.outliers} == {"d4"}
    (spread,) = result.spreads
    assert spread.estimates.log
    assert 0.006 < spread.common.tau < 0.015
    with pytest.raises(InputError, match="no population"):
        population([finding("a", 7.0, 0.01), finding("b", 7.0, 0.01)])
    (first, second) = frequencies(["creep", "hum", "creep"], 10)
    assert (first.what, first.count, second.count) == ("creep", 2, 1)
    assert first.interval == pytest.approx((0.0567, 0.5098), abs=1e-3)  # Wilson's formula by hand


def test_two_findings_are_compared_by_their_z() -> None:
    a, b = finding("a", 7.0, 0.02), finding("b", 7.5, 0.02)
    (result,) = differences([a, b])
    z = np.log(7.5 / 7.0) / (np.sqrt(2.0) * 0.02 / 1.959964)
    assert result.p_value == pytest.approx(2 * stats.norm.sf(z), rel=1e-6)
    assert result.differs
    assert not differences([a, finding("c", 7.05, 0.02)])[0].differs
