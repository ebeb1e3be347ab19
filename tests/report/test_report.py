"""Figures of pages: pictures, thinned curves, spectra, residuals; `test_told` has the texts."""

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.signal import lfilter

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.export.check.check import CheckRow
from psa_casadi.report.page import results
from psa_casadi.report.plots.records import distribution_plot, time_plot
from psa_casadi.report.words import colours, series
from psa_casadi.report.words.notes import residual_sentence
from psa_casadi.report.words.phrases import Scale, number, probability_text
from psa_casadi.report.words.tables import check_table
from psa_casadi.report.words.text import check_sentence
from tests.report.html_page import Page, figures, numbers, written
from tests.report.report_cases import NOISE, diagnosis, long_fit
from tests.tiers import slow, slow_but


@pytest.mark.parametrize("verdict", ["cause_named", "unexplained"])
def test_the_picture_has_its_size_and_shows_something(tmp_path: Path, verdict: Verdict) -> None:
    for narrow, size in ((False, (1000, 1600)), (True, (880, 720))):
        path = tmp_path / f"{narrow}.png"
        psa.save_figure(diagnosis(verdict, ("a", "b")), path, origin="synthetic", narrow=narrow)
        picture = imread(path)
        assert picture.shape[:2] == size
        assert np.mean(np.any(picture[..., :3] < 0.9, axis=2)) > 0.03
    assert len(list(tmp_path.iterdir())) == 2


def test_every_colour_of_a_plot_has_a_counterpart_at_night(tmp_path: Path) -> None:
    page, _ = written(diagnosis("cause_named"), tmp_path)
    used = set(re.findall(r'"(#[0-9a-fA-F]{3,8})"', str(figures(page)).replace("'", '"')))
    assert used
    assert used <= set(colours.DARK)


@pytest.mark.parametrize("width", range(60, 100, 3))
def test_a_percent_sign_stays_with_its_number(width: int) -> None:
    for line in psa.story(diagnosis("ambiguous"), width=width).splitlines():
        assert not line.strip().startswith("%")
        assert len(line) <= width


@slow
def test_long_records_stay_small(tmp_path: Path) -> None:
    text, _ = written(diagnosis("cause_named", tuple("abcdefgh"), 60_000), tmp_path)
    assert len(text.encode()) < 3e6


def test_the_window_shows_where_the_error_falls_most() -> None:
    (s,) = series.series_of(diagnosis("cause_named"))
    window = series.telling_window(s)
    base, extended = (np.nan_to_num(s.residual(c)) for c in s.curves)
    reached = s.curves[0].values
    assert s.held_out[window].all()
    assert 48 <= len(base[window]) <= len(base) // 8

    def error_drop(part: slice) -> float:
        errors = [float(np.sqrt(np.mean(e[part] ** 2))) for e in (base, extended)]
        return (errors[0] - errors[1]) / float(np.ptp(reached[part]))

    assert error_drop(window) > 2 * error_drop(slice(None))


def test_the_spectrum_of_white_noise_lies_on_the_noise_floor() -> None:
    (s,) = series.series_of(diagnosis("cause_named", samples=20_000))
    frequency, density = series.spectrum(s.time, s.residual(s.curves[1]))
    assert frequency[-1] == pytest.approx(500.0, rel=2e-3)
    level = float(np.sqrt(np.mean(density[5:] ** 2)))
    assert level == pytest.approx(series.noise_density(s), rel=0.05)
    assert series.noise_density(s) == pytest.approx(NOISE * np.sqrt(2e-3), rel=0.02)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (1234.5, "1230"), (12.345, "12.3"), (-0.00123456, "-0.00123"), (9.996, "10.0"),
        (1e300, "1.00e300"), (2.5e-7, "2.50e-7"), (6e7, "6.00e7"), (float("inf"), "not finite"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text
    assert probability_text(1.0) == "> 99 %"


def test_the_check_of_an_fmu_names_what_failed() -> None:
    good = CheckRow("units", 0.0, 0.0, True, "")
    bad = CheckRow("equations", float("nan"), 1e-9, False, "it stopped")
    report = psa.CheckReport(Path("x.fmu"), (good, bad), compared=False)
    row = check_table(report).rows[1]
    assert " ".join(row) == "equations not finite 1.00e-9 FAIL it stopped"
    assert check_sentence(report).startswith("x.fmu did not pass: equations.")
    assert "no model" in check_sentence(report)
    assert "passed all 1 checks" in check_sentence(psa.CheckReport(Path("x.fmu"), (good,), True))


LONG = [(1, 1_000_000), (20, 5_000)]


@slow
@pytest.mark.parametrize(("records", "samples"), slow_but([(1, 1_000_000)], LONG))
def test_long_and_many_records_stay_below_1_5_mb_and_keep_their_spikes(
    records: int, samples: int
) -> None:
    result, rows = long_fit(records, samples)
    page = results.fit_page(result, rows)
    assert len(page.encode()) < 3e6
    drawn = figures(page)[2:]
    assert len(drawn) == 7 * min(records, results.MOST_RECORDS)
    words = Page(page).text
    assert ("are drawn" in words) == (records > results.MOST_RECORDS)
    assert all(words.count(s.name) >= 2 for s in rows)
    pictured = [s for s in rows if f"{s.name} (measured)" in words]
    for figure, s in zip(drawn[::7], pictured, strict=True):
        displayed, model, residual = (numbers(t["y"]) for t in figure["data"])
        whole = s.scale.factor * s.measured
        assert np.nanmax(displayed) == pytest.approx(np.nanmax(whole), rel=1e-6)
        assert np.nanmin(displayed) == pytest.approx(np.nanmin(whole), rel=1e-6)
        assert np.nanmax(residual) == pytest.approx(3.0, rel=0.01)
        assert np.isnan(displayed).any()
        assert np.isfinite(model).all()


def test_every_column_of_pixels_keeps_its_extremes() -> None:
    rng = np.random.default_rng(0)
    signals = [rng.standard_normal(1_000_000), rng.standard_normal(1_000_000)]
    signals[0][777], signals[1][900_000], signals[0][5] = 50.0, -60.0, np.nan
    signals[1][250_000:260_000] = np.nan
    displayed = series.kept(signals, 4000)
    assert len(displayed) <= 4002
    assert np.all(np.diff(displayed) > 0)
    assert (displayed[0], displayed[-1]) == (0, 999_999)
    starts = np.searchsorted(displayed, 1000 * np.arange(1000))
    for values in signals:
        for extreme in (np.fmax, np.fmin):  # NaN where a whole column is
            whole = extreme.reduce(values.reshape(1000, 1000), axis=1)
            np.testing.assert_array_equal(extreme.reduceat(values[displayed], starts), whole)
    assert {777, 900_000} <= set(displayed.tolist())


def test_a_short_record_is_drawn_whole_and_a_gap_stays_a_gap() -> None:
    _, (s,) = long_fit(1, 900)
    trace = time_plot(s, "measured", results.points_each(1)).data[0]
    assert np.array_equal(np.isnan(trace["y"]), np.isnan(s.measured))
    assert series.extremes([np.arange(10.0)], np.array([0, 5, 10])).tolist() == [0, 4, 5, 9]


def test_single_precision_is_used_only_where_nobody_can_see_it() -> None:
    step = np.arange(0.0, 1.0, 1e-5)
    assert series.compact(step).dtype == np.float32
    assert series.compact(1.7e9 + step).dtype == np.float64
    assert series.compact(np.full(3, np.nan)).shape == (3,)


def white(samples: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(samples)


def figures_of(residual: FloatArray) -> series.ResidualFigures:
    time = np.arange(len(residual)) / 1000.0
    model, none = np.sin(time) * 1e-5, np.zeros(len(time), dtype=bool)
    curve = series.Curve("model", "#0072b2", model)
    s = series.Series("r", time, time, model + 1e-9 * residual, (curve,), none, 1e-9, False)
    return series.residual_figures(s, curve)


def test_the_autocorrelation_of_a_first_order_process_is_a_power_of_its_pole() -> None:
    residual = lfilter([1.0], [1.0, -0.9], white(200_000, 1))
    lags, values = series.autocorrelation(residual)
    assert (lags[0], lags[-1]) == (1, 50_000)
    assert np.all(np.diff(lags) > 0)
    near = lags <= 30
    assert values[near] == pytest.approx(0.9 ** lags[near], abs=0.03)


def test_the_band_holds_nineteen_of_twenty_lags_of_white_noise() -> None:
    outside = []
    for residual in (white(20_000, seed) for seed in range(20)):
        _, values = series.autocorrelation(residual)
        outside.append(np.mean(np.abs(values) > series.white_band(residual)))
    assert 0.03 < float(np.mean(outside)) < 0.08


_SLOW = np.sin(2 * np.pi * 1e-3 * np.arange(20_000)) + 0.05 * white(20_000)
_RNG = np.random.default_rng(3)
_SKEWED, _HEAVY = _RNG.exponential(size=20_000) - 1.0, _RNG.laplace(size=20_000)


@pytest.mark.parametrize(
    ("residual", "figure", "wanted", "words"),
    [
        (white(20_000), "rms", (1e-9, 2e-11), "is as white as noise"),
        (white(20_000), "beyond_three", (0.0027, 0.0012), "close to normal"),
        (_SLOW, "lasting", (0.25, 0.015), "is not white: neighbouring samples correlate by 1.00"),
        (_SLOW, "lasting", (0.25, 0.015), "lighter in its tails"),
        (_SKEWED, "skewness", (2.0, 0.3), "longer upwards and heavier in its tails"),
        (-_SKEWED, "skewness", (-2.0, 0.3), "longer downwards"),
        (_HEAVY, "kurtosis", (3.0, 0.8), "is heavier in its tails than"),
    ],
)
def test_a_residual_is_called_what_it_is(
    residual: FloatArray, figure: str, wanted: tuple[float, float], words: str
) -> None:
    result = figures_of(residual)
    assert getattr(result, figure) == pytest.approx(wanted[0], abs=wanted[1])
    sentence = residual_sentence(result, "base model", Scale("s", 1.0))
    assert words in sentence
    assert figure != "lasting" or f"that of noise after {result.lasting:.2f} s" in sentence


def test_a_residual_is_readable_next_to_one_that_is_far_off() -> None:
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
    indices = series.shown_lines(frequency, density, 800)
    assert len(frequency) > 50_000
    assert len(indices) <= 810
    peak = int(np.argmax(density))
    assert peak in indices
    assert frequency[peak] == pytest.approx(20_000.0, rel=1e-3)
    assert (indices[0], indices[-1]) == (0, len(frequency) - 1)
