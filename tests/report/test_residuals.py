import numpy as np
import pytest

from psa_casadi.report.plots.records import distribution_plot
from psa_casadi.report.words import series
from psa_casadi.report.words.fit_words import residual_sentence
from psa_casadi.report.words.phrases import Scale

SECONDS = Scale("s", 1.0)


def white(samples: int, seed: int = 0) -> series.FloatArray:
    return np.random.default_rng(seed).standard_normal(samples)


def first_order(samples: int, r: float) -> series.FloatArray:
    drive, values = white(samples, 1), np.zeros(samples)
    for k in range(1, samples):
        values[k] = r * values[k - 1] + drive[k]
    return values


def figures_of(residual: series.FloatArray) -> series.ResidualFigures:
    time = np.arange(len(residual)) / 1000.0
    model = np.sin(time) * 1e-5
    none = np.zeros(len(time), dtype=bool)
    curve = series.Curve("model", "#0072b2", model)
    s = series.Series("r", time, time, model + 1e-9 * residual, (curve,), none, 1e-9, False)
    return series.residual_figures(s, curve)


def test_the_autocorrelation_of_a_first_order_process_is_a_power_of_its_pole() -> None:
    residual = first_order(200_000, 0.9)
    lags, values = series.autocorrelation(residual)
    assert (lags[0], lags[-1]) == (1, 50_000)
    assert np.all(np.diff(lags) > 0)
    near = lags <= 30
    assert values[near] == pytest.approx(0.9 ** lags[near], abs=0.03)


def test_the_band_holds_nineteen_of_twenty_lags_of_white_noise() -> None:
    outside = []
    for seed in range(20):
        residual = white(20_000, seed)
        _, values = series.autocorrelation(residual)
        outside.append(np.mean(np.abs(values) > series.white_band(residual)))
    assert 0.03 < float(np.mean(outside)) < 0.08


def test_a_white_normal_residual_is_called_so() -> None:
    found = figures_of(white(20_000))
    assert found.rms == pytest.approx(1e-9, rel=0.02)
    assert found.beyond_three == pytest.approx(0.0027, abs=0.0012)
    sentence = residual_sentence(found, "base model", SECONDS)
    assert sentence.startswith("The residual of the base model is as white as noise")
    assert "close to normal" in sentence


def test_a_slow_residual_is_called_correlated_and_for_how_long() -> None:
    time = 1e-3 * np.arange(20_000)
    found = figures_of(np.sin(2 * np.pi * time) + 0.05 * white(20_000))
    sentence = residual_sentence(found, "model", SECONDS)
    assert "is not white: neighbouring samples correlate by 1.00" in sentence
    assert "lighter in its tails" in sentence
    assert found.lasting == pytest.approx(0.25, rel=0.06)  # a quarter of the period
    assert f"that of noise after {found.lasting:.2f} s" in sentence


def test_a_lopsided_and_a_heavy_distribution_are_called_so() -> None:
    rng = np.random.default_rng(3)
    upwards = figures_of(rng.exponential(size=20_000) - 1.0)
    assert upwards.skewness == pytest.approx(2.0, abs=0.3)
    assert "longer upwards and heavier in its tails" in residual_sentence(upwards, "m", SECONDS)
    heavy = figures_of(rng.laplace(size=20_000))
    assert heavy.kurtosis == pytest.approx(3.0, abs=0.8)
    assert "is heavier in its tails than" in residual_sentence(heavy, "m", SECONDS)
    downwards = figures_of(1.0 - rng.exponential(size=20_000))
    assert "longer downwards" in residual_sentence(downwards, "m", SECONDS)


def test_a_residual_can_be_read_beside_one_that_is_far_off() -> None:
    narrow, none = 1e-9 * white(5000), np.zeros(5000, dtype=bool)
    wide, time = 3e-8 * np.linspace(-1.0, 1.0, 5000), np.arange(5000) / 1000.0
    curves = (series.Curve("base", "#d55e00", -wide), series.Curve("extended", "#0072b2", -narrow))
    s = series.Series("r", time, time, 0.0 * time, curves, none, 1e-9, False)
    base, extended, normal = distribution_plot(s).data
    span = np.ptp(narrow)
    assert np.ptp(normal["x"]) == pytest.approx(2e9 * span, rel=1e-5)
    assert extended["name"] == "extended"
    assert np.sum(extended["y"]) == pytest.approx(100.0)
    outside = 100.0 - 100.0 * 2e9 * span / 60.0
    assert base["name"] == f"base ({outside:.0f} % outside)"
    assert np.sum(base["y"]) == pytest.approx(100.0 - outside, abs=0.1)
    near = series.Series("r", time, time, 0.0 * time, (curves[1], curves[1]), none, 1e-9, False)
    assert np.ptp(distribution_plot(near).data[-1]["x"]) == pytest.approx(1e9 * span, rel=1e-5)


def test_a_spectrum_of_many_lines_is_thinned_and_keeps_its_peaks() -> None:
    time = np.arange(1_000_000) / 100_000.0
    residual = white(len(time)) + np.sin(2 * np.pi * 20_000.0 * time)
    frequency, density = series.spectrum(time, residual)
    shown = series.shown_lines(frequency, density, 800)
    assert len(frequency) > 50_000
    assert len(shown) <= 810
    peak = int(np.argmax(density))
    assert peak in shown
    assert frequency[peak] == pytest.approx(20_000.0, rel=1e-3)
    assert (shown[0], shown[-1]) == (0, len(frequency) - 1)
