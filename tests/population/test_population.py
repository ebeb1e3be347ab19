"""Populations: statistics against published figures, the pages of devices, models of users."""

import json
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats

import psa_casadi as psa
from psa_casadi.common.errors import InputError
from psa_casadi.common.strict_json import json_text
from psa_casadi.common.units import FloatArray
from psa_casadi.documents.files import identification_file
from psa_casadi.documents.findings import finding_content
from psa_casadi.model.model_file import dumps
from psa_casadi.population.population import (
    Estimate,
    Finding,
    differences,
    frequencies,
    population,
    replayed,
)
from psa_casadi.population.statistics import adjusted, batch_test, drift, mixed_regression, outliers
from psa_casadi.report.page.devices import MOST
from psa_casadi.report.plots.device_plots import drift_plot, spread_plot
from psa_casadi.report.words.population_words import missed_sentences, population_sentences
from tests.any_model import own_plants as plants
from tests.any_model.own_models import motor
from tests.contract.helpers import done
from tests.model.evidence_models import evident_model
from tests.report.browser import DARK, PHONE, Browser, find_browser, seen_on_a_phone
from tests.report.html_page import Page, figures
from tests.report.report_cases import diagnosis, identification
from tests.report.test_schemas import valid
from tests.tiers import slow, slow_but

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
def test_intervals_cover_and_few_are_reported_without_cause(tau: float) -> None:
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


def test_a_population_reports_outliers_and_causes() -> None:
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


HOSTILE = "<img src=x onerror=alert(1)>&<b>bold</b>"


def finding_of(name: str, k_l: float, **more: Any) -> Finding:
    table = {"k_L": Estimate(k_l, "N/V", (0.99 * k_l, 1.01 * k_l), meaning="linear force per volt")}
    return Finding(
        name, "identification", table, (("r", name),), rms_m=2e-9, rms_percent=0.02, **more
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the files of two diagnoses: one named a cause, one names none."""
    folder = tmp_path_factory.mktemp("diagnoses")
    before, after = folder / "before.json", folder / "after.json"
    before.write_text(diagnosis("cause_named").to_json(), encoding="utf-8")
    after.write_text(diagnosis("adequate").to_json(), encoding="utf-8")
    return before, after


def test_a_model_and_a_finding_of_the_same_records_are_one_device(tmp_path: Path) -> None:
    stack_identification = identification()
    hashes = [
        {"record": e.record.name, "sha256": e.record.sha256}
        for e in stack_identification.experiments
    ]
    content = {**json.loads(dumps(evident_model())), "identified_from": hashes}
    (tmp_path / "a.json").write_text(
        json_text(identification_file(stack_identification)), encoding="utf-8"
    )
    (tmp_path / "model.json").write_text(json.dumps(content), encoding="utf-8")
    (joined,) = psa.read_findings([tmp_path / "model.json", tmp_path / "a.json"])
    assert joined.device == "a"
    assert joined.kind == "identification"
    assert joined.trace is not None


def test_what_a_record_is_compared_with_has_the_sensors_errors() -> None:
    plain = evident_model()
    bent = plain.with_effect(psa.EFFECTS["sensor_nonlinearity"])
    gain = psa.EFFECTS["sensor_nonlinearity"].gain or ""
    far = replace(bent, values={**bent.values, gain: 0.05})
    items = [replayed(m) for m in (plain, bent, far)]
    a, b, c = (np.array(t.model) for t in items if t is not None)
    np.testing.assert_allclose(b, a, atol=1e-5 * float(np.ptp(a)))
    assert np.max(np.abs(c - a)) > 1e-3 * float(np.ptp(a))


def test_names_are_text_and_plots_have_no_markup(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    psa.write_comparison([finding_of(HOSTILE, 7.0), finding_of("b", 7.4)], page)
    text = page.read_text(encoding="utf-8")
    assert Page(text).loaded == []
    assert HOSTILE in Page(text).text
    names = [trace["name"] for figure in figures(text) for trace in figure.get("data", [])]
    assert "&lt;img src=x onerror=alert(1)&gt;&amp;&lt;b&gt;bold&lt;/b&gt;" in names
    assert not [n for n in names if "<" in n]
    assert "Beyond noise, k_L differs" in Page(text).text


def test_a_page_has_not_too_many_devices(tmp_path: Path) -> None:
    with pytest.raises(psa.InputError, match="no room side by side"):
        psa.write_comparison(
            [finding_of(f"d{k}", 7.0) for k in range(MOST + 1)], tmp_path / "p.html"
        )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "is no file of a diagnosis, identification or model"),
        ('{"format": "psa_casadi.diagnosis/1"}', "'verdict' is missing"),
        ("{", "is not JSON"),
    ],
)
def test_files_that_are_none_are_reported(content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(content)
    with pytest.raises(psa.InputError, match=message):
        psa.read_findings([path])


@pytest.mark.parametrize(
    ("place", "value"),
    [("verdict", 3), ("causes", {}), ("notes", [1]), ("gain", None), ("noise_floor_rms_m", "x")],
)
def test_values_that_do_not_belong_are_reported_with_their_place(
    place: str, value: object, files: tuple[Path, Path], tmp_path: Path
) -> None:
    content = json.loads(files[0].read_text("utf-8"))
    (content["errors"] if place.startswith("noise_floor") else content)[place] = value
    path = tmp_path / "x.json"
    path.write_text(json.dumps(content))
    with pytest.raises(psa.InputError, match=rf"{place}[^;]*is .*; give "):
        psa.read_findings([path])


def devices() -> list[Finding]:
    """Return forty devices of two batches over two years: an outlier, and a strong batch."""
    rng = np.random.default_rng(4)
    sizes = 7.0 * np.exp(0.01 * rng.standard_normal(40))
    sizes[20:] *= 1.04
    sizes[5] *= 1.3
    items = []
    for k, size in enumerate(sizes.tolist()):
        item = finding_of(
            f"d{k}", size, batch="A" if k < 20 else "B", day=date(2024 + k // 20, 1 + k % 12, 1)
        )
        tau = 1e-3 * float(np.exp(0.02 * rng.standard_normal()))
        more = {"tau": Estimate(tau, "s", (0.98 * tau, 1.02 * tau), meaning="lag")}
        items.append(replace(item, parameters={**item.parameters, **more}))
    return items


def test_a_population_states_who_deviates_and_which_batch(tmp_path: Path) -> None:
    result = population(devices())
    assert {o.device for o in result.outliers} == {"d5"}
    assert result.batches_differ == ("k_L",)
    assert result.drifting == ("k_L",)
    page = tmp_path / "population.html"
    psa.write_population(result, page, without=[(HOSTILE, "refused", "line 2 <script>")])
    displayed = Page(page.read_text(encoding="utf-8"))
    assert displayed.loaded == []
    assert "1 of 40 devices stands out: d5. Batches differ in k_L. Over the date, k_L drifts." in (
        displayed.text
    )
    assert HOSTILE in displayed.text
    assert len(figures(page.read_text(encoding="utf-8"))) >= 3


def test_the_pictures_name_the_devices_of_the_table() -> None:
    result = population(devices())
    spread = next(s for s in result.spreads if s.estimates.name == "k_L")
    for plot in (spread_plot(result, spread), drift_plot(result, spread)):
        others, apart = plot.data
        assert apart["name"] == "outlier"
        assert [t.strip() for t in apart["text"]] == apart["hovertext"] == ["d5"]
        assert (len(others["x"]), set(others["text"])) == (39, {""})
    axis = spread_plot(result, spread).layout["xaxis"]
    assert axis["ticktext"] == [str(k + 1) for k in axis["tickvals"]]
    few = population(devices()[:6])
    plot = spread_plot(few, few.spreads[0])
    axis = plot.layout["xaxis"]
    marks = ((p["x"], p["hovertext"]) for p in plot.data)
    named = {x: name for xs, names in marks for x, name in zip(xs, names, strict=True)}
    assert [named[k] for k in axis["tickvals"]] == axis["ticktext"]
    assert set(axis["ticktext"]) == {f"d{k}" for k in range(6)}
    # significant in this parameter by itself, and not among all tests
    assert spread.far.outlying.sum() == 1
    (only,) = spread_plot(replace(result, outliers=()), spread).data
    assert (only["name"], len(only["x"])) == ("belongs to the others", 40)


def test_a_population_states_whose_fits_miss_their_records() -> None:
    assert missed_sentences(devices()) == ()
    items = [replace(f, noise_ratio=2.0 + k) if k < 8 else f for k, f in enumerate(devices())]
    (statement,) = missed_sentences(items)
    assert statement in population_sentences(population(items))
    assert "The fits of d7 (9.0 times the noise), d6" in statement
    assert "d2 (4.0 times the noise) and 2 more miss their records" in statement


@slow
@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize("name", ["comparison", "population"])
def test_the_pages_in_a_browser(
    name: str, files: tuple[Path, Path], tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    browser: Browser = find_browser(tmp_path_factory.mktemp("browser"))
    page = tmp_path / f"{name}.html"
    if name == "comparison":
        psa.write_comparison(psa.read_findings(files)[:1] + tuple(devices()[:2]), page)
    else:
        psa.write_population(population(devices()), page)
    document, console = browser.document(page, "--window-size=1280,900")
    assert console == []
    for box in document.split('class="drawing')[1:]:
        assert '<svg class="main-svg"' in box
    for flags in ((), (DARK,)):
        assert browser.serious_faults(page, *flags) == []
    table = seen_on_a_phone(browser, page)
    assert table["width"] == table["needed"] == PHONE
    assert table["outside"] == []


def device(name: str, seed: int, inertia: float = 3e-5, friction: float = 0.0) -> psa.Signals:
    record = plants.motor(seed, friction, inertia=inertia)
    return replace(record, name=name)


def test_identifications_of_a_user_model_are_compared(tmp_path: Path) -> None:
    """The third of three motors is heavier by a hundredth; all else is the same."""
    items = [device("first", 1), device("second", 2), device("third", 3, inertia=3.03e-5)]
    results = [psa.identify(motor(), record, starts=1) for record in items]
    assert len(results[0].plot().axes) == 4  # both outputs, and what is left of each
    path = tmp_path / "second.json"
    path.write_text(json_text(identification_file(results[1])), encoding="utf-8")
    content = valid("identification", path.read_text("utf-8"))
    rows = content["records"]
    assert [(r["output"], r["unit"], r["samples"]) for r in rows] == [
        ("w", "rad/s", 3000), ("i", "A", 3000)
    ]  # fmt: skip
    assert rows[0]["rms_m"] == pytest.approx(0.3, rel=0.05)
    assert rows[1]["noise_m"] == pytest.approx(0.005, rel=0.05)
    findings = psa.read_findings([results[0], path, results[2]])
    assert [f.device for f in findings] == ["first", "second", "third"]
    assert [f.rms_m for f in findings] == [None] * 3  # rad/s is no length
    psa.write_comparison(findings, tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text("utf-8"))
    assert "Beyond noise, J differs (4 parameters compared)." in page.text
    assert page.loaded == []
    compared = psa.compare(*results)
    assert "Beyond noise, J differs (4 parameters compared)." in repr(compared)
    rows = compared.to_frame().set_index(["parameter", "device"])
    assert len(rows) == 12
    assert rows.loc[("J", "third"), "value"] == results[2].model.values["J"]
    assert set(rows.index[rows["differs"]].get_level_values(0)) == {"J"}
    with pytest.raises(psa.InputError, match="One device is nothing to compare"):
        psa.compare(results[0])


def test_a_fit_that_misses_its_record_is_reported(tmp_path: Path) -> None:
    """The second of two motors has dry friction, which the model lacks."""
    items = [device("oiled", 2), device("dry", 1, friction=0.012)]
    results = [psa.identify(motor(), record, starts=1) for record in items]
    compared = psa.compare(*results)
    oiled, dry = compared.findings
    worst = max(rms / results[1].noise[name] for name, rms in results[1].rms.items())
    assert (oiled.noise_ratio, oiled.warnings) == (None, ())
    assert dry.noise_ratio == pytest.approx(worst, rel=0.05)
    assert "The fit of dry (" in compared.sentence
    assert "misses its records" in repr(compared)
    compared.report(tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text("utf-8"))
    assert "misses its records" in page.text
    assert "dry: 'w' is missed by" in page.text
    assert "dry: 'i' is missed by" in page.text
    rows = [finding_content(f) for f in compared.findings]
    assert [r["missed [times the noise]"] for r in rows] == [None, dry.noise_ratio]


@pytest.mark.slow
def test_diagnoses_of_a_user_model_are_compared(tmp_path: Path) -> None:
    fewer = ["hysteresis", "stop", "curve", "delay"]
    items = [device("dry", 1, friction=0.012), device("oiled", 2)]
    dry, oiled = (psa.diagnose(motor(), r, leave_out=fewer) for r in items)
    path = tmp_path / "dry.json"
    path.write_text(dry.to_json(), encoding="utf-8")
    findings = psa.read_findings([path, oiled])
    assert [f.verdict for f in findings] == ["cause_named", "adequate"]
    size = findings[0].parameters["friction_in_speed_size"]
    assert size.value == json.loads(dry.to_json())["causes"][0]["parameters"][
        "friction_in_speed_size"
    ]["value"]  # fmt: skip
    psa.write_comparison(findings, tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text("utf-8"))
    assert "Verdicts differ (dry: cause named and oiled: adequate)" in page.text
    assert "friction in speed" in page.text
    errors = {e.output: e for e in findings[0].errors}
    assert errors["w"].unit == "rad/s"
    assert errors["w"].extended == pytest.approx(0.3, rel=0.1)
    assert errors["i"].base > 2.0 * errors["i"].extended
    assert "w, base, held out [rad/s]" in page.text
    # a result at hand has all parameters of its model, a file those of its causes
    assert set(findings[1].parameters) == {"R", "k", "J", "b"}
    loaded = psa.compare(psa.load_diagnosis(path), oiled)
    assert [f.verdict for f in loaded.findings] == ["cause_named", "adequate"]
    assert loaded.findings[0].parameters == findings[0].parameters
    plain = tmp_path / "oiled.json"
    plain.write_text(oiled.to_json(), encoding="utf-8")
    words = done("compare", path, plain, "-o", tmp_path / "two.html").words
    assert "cause named" in words
    assert "held out" in words
