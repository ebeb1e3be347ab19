"""The pages of devices side by side and of a population: what they say, whatever names hold."""

import json
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.strict_json import json_text
from psa_casadi.documents.files import identification_file
from psa_casadi.model.model_file import dumps
from psa_casadi.population.finding import Estimate, Finding, replayed
from psa_casadi.population.population import population
from psa_casadi.report.page.devices import MOST
from psa_casadi.report.plots.device_plots import drift_plot, spread_plot
from psa_casadi.report.words.population_words import missed_sentences, population_sentences
from tests.model.evidence_models import evident_model
from tests.report.browser import DARK, PHONE, Browser, find_browser, seen_on_a_phone
from tests.report.html_page import Page, figures
from tests.report.report_cases import diagnosis, identification
from tests.tiers import slow

HOSTILE = "<img src=x onerror=alert(1)>&<b>bold</b>"


def finding(name: str, k_l: float, **more: Any) -> Finding:
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
    psa.write_comparison([finding(HOSTILE, 7.0), finding("b", 7.4)], page)
    text = page.read_text(encoding="utf-8")
    assert Page(text).loaded == []
    assert HOSTILE in Page(text).text
    names = [trace["name"] for figure in figures(text) for trace in figure.get("data", [])]
    assert "&lt;img src=x onerror=alert(1)&gt;&amp;&lt;b&gt;bold&lt;/b&gt;" in names
    assert not [n for n in names if "<" in n]
    assert "Beyond noise, k_L differs" in Page(text).text


def test_a_page_has_not_too_many_devices(tmp_path: Path) -> None:
    with pytest.raises(psa.InputError, match="no room side by side"):
        psa.write_comparison([finding(f"d{k}", 7.0) for k in range(MOST + 1)], tmp_path / "p.html")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "is no file of a diagnosis, identification or model"),
        ('{"format": "psa_casadi.diagnosis/1"}', "'verdict' is missing"),
        ("{", "is not JSON"),
    ],
)
def test_files_that_are_none_are_told(content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(content)
    with pytest.raises(psa.InputError, match=message):
        psa.read_findings([path])


@pytest.mark.parametrize(
    ("place", "value"),
    [("verdict", 3), ("causes", {}), ("notes", [1]), ("gain", None), ("noise_floor_rms_m", "x")],
)
def test_values_that_do_not_belong_are_told_with_their_place(
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
        item = finding(
            f"d{k}", size, batch="A" if k < 20 else "B", day=date(2024 + k // 20, 1 + k % 12, 1)
        )
        tau = 1e-3 * float(np.exp(0.02 * rng.standard_normal()))
        more = {"tau": Estimate(tau, "s", (0.98 * tau, 1.02 * tau), meaning="lag")}
        items.append(replace(item, parameters={**item.parameters, **more}))
    return items


def test_a_population_says_who_stands_out_and_which_batch(tmp_path: Path) -> None:
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
        assert apart["name"] == "stands out"
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


def test_a_population_says_whose_fits_miss_their_records() -> None:
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
