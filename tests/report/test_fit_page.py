import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psa_casadi.identification.advice import Advice
from psa_casadi.identification.combinations import Combination
from psa_casadi.report.page import results
from psa_casadi.report.plots.records import time_plot
from psa_casadi.report.words import colours
from psa_casadi.report.words.fit_words import (
    determined_sentence,
    error_bar_note,
    grades,
    pairs_sentence,
    strong_pairs,
)
from psa_casadi.report.words.series import compact, extremes, kept, series_of_fit
from psa_casadi.report.words.tables import parameter_table
from tests.report.html_page import Page, figures, numbers, written
from tests.report.report_cases import diagnosis, identification, long_fit
from tests.tiers import slow, slow_but

pytestmark = pytest.mark.xdist_group("fit-page")


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    found = replace(
        identification(),
        doubts=("Tom & <Jerry> disagree.",),
        combinations=(Combination("group", ("k_L", "A")),),
        advice=(Advice("ringing", ("m_P",)),),
    )
    return written(found, tmp_path_factory.mktemp("fit"), origin="synthetic")[0]


def test_the_page_of_a_fit_tells_all_of_it(text: str) -> None:
    page, found = Page(text), identification()
    assert page.loaded == []
    assert page.targets <= page.names
    assert not re.search(r"@import|url\(", text.split("<script>", 1)[0])
    assert "The model misses the synthetic displacement by" in page.text
    assert "measured" not in page.text
    assert "Tom & <Jerry> disagree." in page.text
    assert "k_L and A trade off; no simple formula of them is known." in page.text
    assert "What to measure next" in page.text
    for e in found.experiments:
        assert e.record.sha256 in page.text
        assert f"{e.record.name} (synthetic)" in page.text
    for name in found.model.parameter_names:
        assert f" {name} " in page.text
    for start in found.starts:
        assert start.name in page.text
    assert len(figures(text)) == 2 + 7 * len(found.experiments)


def test_sections_without_content_are_left_out() -> None:
    found = replace(identification(), doubts=(), starts=(), combinations=(), advice=())
    page = Page(results.fit_page(found, series_of_fit(found)))
    for title in ("Warning", "Starts", "leave open", "What to measure next"):
        assert title not in page.text
    assert "measured data" in page.text


def test_a_model_without_fitted_parameters_has_its_page() -> None:
    found = identification()
    none = replace(
        found.determinacy, names=(), intervals={}, standard_errors={}, undetermined=(), on_bound=(),
        covariance=np.zeros((0, 0)), correlations=np.zeros((0, 0)),
    )  # fmt: skip
    bare = replace(found, determinacy=none)
    page = results.fit_page(bare, series_of_fit(bare))
    assert "No intervals were estimated" in Page(page).text
    assert "parameters determined" not in Page(page).text
    assert len(figures(page)) == 7 * len(found.experiments)


def test_every_colour_of_a_plot_has_a_counterpart_at_night(text: str, tmp_path: Path) -> None:
    other, _ = written(diagnosis("cause_named"), tmp_path)
    for page in (text, other):
        used = set(re.findall(r'"(#[0-9a-fA-F]{3,8})"', str(figures(page)).replace("'", '"')))
        assert used
        assert used <= set(colours.DARK)


def test_parameters_are_graded_as_the_determinacy_says() -> None:
    found = identification()
    errors = {n: 0.01 * found.model.values[n] for n in ("k_L", "tau", "R_s", "c_P")}
    errors["tau"] *= 20.0
    errors["A"] = 0.3 * found.model.parameter("A").typical(found.model.values)
    known = replace(
        found.determinacy, standard_errors=errors, undetermined=("R_s",), on_bound=("c_P",)
    )
    graded = grades(replace(found, determinacy=known))
    assert [g.name for g in graded] == list(found.model.parameter_names)
    degrees = {g.name: g.degree for g in graded}
    assert degrees.pop("k_L") == "determined"
    assert degrees.pop("tau") == degrees.pop("A") == "weak"
    assert degrees.pop("R_s") == "undetermined"
    assert degrees.pop("c_P") == "on its bound"
    assert set(degrees.values()) == {"fixed"}
    by_name = {g.name: g for g in graded}
    assert by_name["tau"].error == pytest.approx(0.2)
    assert by_name["A"].error == pytest.approx(0.3)
    assert by_name["A"].by_change
    assert determined_sentence(graded) == (
        "The records determine 1 of 5 fitted parameters to 10 % or better; A and tau are weakly"
        " determined; R_s is undetermined; c_P is on its bound."
    )
    assert "A may be zero, so the error is relative to an ordinary change" in error_bar_note(graded)
    rows = {
        r[0]: r[4] for r in parameter_table(found.model, replace(found, determinacy=known)).rows
    }
    assert [rows[n] for n in ("k_L", "tau", "R_s", "c_P", "m_P")] == [
        "fit", "fit, weak", "fit, undetermined", "fit, on its bound", "not fitted",
    ]  # fmt: skip


def test_pairs_that_are_known_only_together_are_named() -> None:
    found = identification()
    matrix = np.eye(len(found.determinacy.names))
    matrix[0, 1] = matrix[1, 0] = -0.97
    matrix[2, 3] = matrix[3, 2] = 0.99
    matrix[0, 3] = matrix[3, 0] = 0.94
    names = found.determinacy.names
    pairs = strong_pairs(
        replace(found, determinacy=replace(found.determinacy, correlations=matrix))
    )
    assert pairs == [(names[2], names[3], 0.99), (names[0], names[1], -0.97)]
    assert f"{names[0]} with {names[1]} (−0.97)" in pairs_sentence(pairs)
    assert "No two estimates correlate" in pairs_sentence([])


LONG = [(1, 1_000_000), (20, 5_000)]


@slow
@pytest.mark.parametrize(("records", "samples"), slow_but([(1, 1_000_000)], LONG))
def test_long_and_many_records_stay_below_1_5_mb_and_keep_their_spikes(
    records: int, samples: int
) -> None:
    found, series = long_fit(records, samples)
    page = results.fit_page(found, series)
    assert len(page.encode()) < 3e6
    drawn = figures(page)[2:]
    assert len(drawn) == 7 * min(records, results.MOST_RECORDS)
    words = Page(page).text
    assert ("are drawn" in words) == (records > results.MOST_RECORDS)
    assert all(words.count(s.name) >= 2 for s in series)
    pictured = [s for s in series if f"{s.name} (measured)" in words]
    for figure, s in zip(drawn[::7], pictured, strict=True):
        shown, model, residual = (numbers(t["y"]) for t in figure["data"])
        whole = s.scale.factor * s.measured
        assert np.nanmax(shown) == pytest.approx(np.nanmax(whole), rel=1e-6)
        assert np.nanmin(shown) == pytest.approx(np.nanmin(whole), rel=1e-6)
        assert np.nanmax(residual) == pytest.approx(3.0, rel=0.01)
        assert np.isnan(shown).any()
        assert np.isfinite(model).all()


def test_every_column_of_pixels_keeps_its_extremes() -> None:
    rng = np.random.default_rng(0)
    signals = [rng.standard_normal(1_000_000), rng.standard_normal(1_000_000)]
    signals[0][777], signals[1][900_000], signals[0][5] = 50.0, -60.0, np.nan
    signals[1][250_000:260_000] = np.nan
    shown = kept(signals, 4000)
    assert len(shown) <= 4002
    assert np.all(np.diff(shown) > 0)
    assert (shown[0], shown[-1]) == (0, 999_999)
    column_of = np.arange(1_000_000) // 1000
    for values in signals:
        for column in range(1000):
            part = values[column * 1000 : (column + 1) * 1000]
            seen = values[shown[column_of[shown] == column]]
            if np.isfinite(part).any():
                assert np.nanmax(seen) == np.nanmax(part)
                assert np.nanmin(seen) == np.nanmin(part)
            else:
                assert np.isnan(seen).any()
    assert {777, 900_000} <= set(shown.tolist())


def test_a_short_record_is_drawn_whole_and_a_gap_stays_a_gap() -> None:
    _, (s,) = long_fit(1, 900)
    trace = time_plot(s, "measured", results.points_each(1)).data[0]
    assert np.array_equal(np.isnan(trace["y"]), np.isnan(s.measured))
    assert extremes([np.arange(10.0)], np.array([0, 5, 10])).tolist() == [0, 4, 5, 9]


def test_single_precision_is_used_only_where_nobody_can_see_it() -> None:
    step = np.arange(0.0, 1.0, 1e-5)
    assert compact(step).dtype == np.float32
    assert compact(1.7e9 + step).dtype == np.float64
    assert compact(np.full(3, np.nan)).shape == (3,)
