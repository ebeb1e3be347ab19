"""The pages in a real browser: drawn, without complaint, on a desk, on a phone, at night."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

import psa_casadi as psa
from psa_casadi.identification.advice import Advice
from tests.report.browser import DARK, PHONE, Browser, on_a_phone, phone_view
from tests.report.report_cases import diagnosis, identification
from tests.tiers import slow, slow_but

pytestmark = pytest.mark.xdist_group("browser")

PAGES = ("fit", "diagnosis")
BLUE = np.array([0x00, 0x72, 0xB2]) / 255.0


@pytest.fixture(scope="module", params=slow_but(["diagnosis"], PAGES))
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report_page(request.param, tmp_path_factory.mktemp("pages"))


@pytest.fixture(scope="module")
def of_diagnosis(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The longer page, for what both have by the same style sheet and scripts."""
    return report_page("diagnosis", tmp_path_factory.mktemp("page"))


def report_page(kind: str, folder: Path) -> Path:
    path = folder / f"{kind}.html"
    if kind == "fit":
        result = replace(identification(), advice=(Advice("nothing", ("tau",), tried=12),))
        psa.write_fit_report(result, path, origin="synthetic")
    else:
        psa.write_report(diagnosis("cause_named", ("rig_a", "rig_b")), path, origin="synthetic")
    return path


def pixels(path: Path) -> np.ndarray[tuple[int, int, int], np.dtype[np.float64]]:
    return np.asarray(imread(path), dtype=np.float64)[:, :, :3]


def colours(image: np.ndarray[tuple[int, int, int], np.dtype[np.float64]]) -> int:
    levels = np.rint(15 * image).astype(np.int64) @ np.array([256, 16, 1])
    return len(np.unique(levels))


@slow
def test_every_plot_is_drawn_and_the_console_is_silent(browser: Browser, page: Path) -> None:
    document, console = browser.document(page, "--window-size=1280,900")
    assert console == []
    assert '<html lang="en" class="scripted">' in document  # no still picture is visible
    boxes = document.split('class="drawing')[1:]
    assert len(boxes) == len(re.findall('class="drawing', page.read_text(encoding="utf-8")))
    assert len(boxes) >= 14
    for box in boxes:
        assert '<svg class="main-svg"' in box
        assert re.search(r'class="(js-line|point|hm|trace)', box), "axes without any curve"


@slow
def test_a_still_picture_is_visible_where_scripts_are_off(
    browser: Browser, of_diagnosis: Path
) -> None:
    off = of_diagnosis.with_name("off.html")
    none = """<head><meta http-equiv="Content-Security-Policy" content="script-src 'none'">"""
    off.write_text(of_diagnosis.read_text("utf-8").replace("<head>", none, 1), encoding="utf-8")
    image = pixels(browser.screenshot(off, 1280, 900))
    assert np.sum(np.all(np.abs(image - BLUE) < 0.06, axis=2)) > 2000  # the model's curves
    assert 30_000 < len("".join(re.findall('base64,([^"]+)', off.read_text("utf-8")))) < 150_000


def test_a_page_that_fails_or_overflows_is_noticed(browser: Browser, tmp_path: Path) -> None:
    broken = tmp_path / "broken.html"
    wide = '<div class="drawing" style="width: 500px"><svg class="main-svg"></svg>wide</div>'
    tiny = '<p style="font-size: 8px">tiny</p>'
    script = "<script>console.error('by hand'); absent.name = 1;</script>"
    broken.write_text(f"<html><body>{wide}{tiny}{script}</body></html>", encoding="utf-8")
    with pytest.raises(pytest.fail.Exception, match=r"by hand.*Uncaught ReferenceError"):
        phone_view(browser, broken)
    table = phone_view(browser, broken, silent=False)
    assert table["needed"] > PHONE
    assert table["outside"] == ["DIV.drawing"]
    assert table["small"] == ["tiny"]


@slow
def test_a_phone_shows_it_legibly_without_scrolling_sideways(browser: Browser, page: Path) -> None:
    table = phone_view(browser, page)
    assert table["width"] == table["needed"] == PHONE
    assert table["outside"] == table["small"] == []
    assert table["drawn"] == table["plots"] >= 14
    assert table["narrowest"] > 0.9 * PHONE
    assert table["smallest"] >= 9


@slow
def test_it_is_bright_by_day_and_dark_at_night(browser: Browser, of_diagnosis: Path) -> None:
    day = pixels(browser.screenshot(of_diagnosis, 1280, 1800))
    night = pixels(browser.screenshot(of_diagnosis, 1280, 1800, DARK))
    for image in (day, night):
        assert image.shape == (1800, 1280, 3)
        assert colours(image) > 40
    assert np.median(day) > 0.95
    assert np.median(night) < 0.15
    ink = [float(np.mean(np.abs(i - np.median(i)) > 0.2)) for i in (day, night)]
    assert min(ink) > 0.02
    assert ink[1] == pytest.approx(ink[0], rel=0.6)
    assert np.sum(np.all(np.abs(day - BLUE) < 0.02, axis=2)) > 2000


@slow
def test_a_screenshot_of_a_phone_is_filled(browser: Browser, of_diagnosis: Path) -> None:
    image = pixels(browser.screenshot(on_a_phone(of_diagnosis, 1800), 500, 1800))[:, :PHONE]
    assert colours(image) > 40
    rows = np.any(np.abs(image - np.median(image)) > 0.2, axis=(1, 2))
    # text and curves begin near the top, go on to the end, and no screenful is empty
    gaps = np.diff(np.flatnonzero(np.concatenate([[True], rows, [True]])))
    assert int(np.max(gaps)) < 200
    assert not np.any(np.abs(image[:, -4:] - np.median(image)) > 0.2)


@slow
def test_a_page_prints_on_few_sheets(browser: Browser, of_diagnosis: Path) -> None:
    path = of_diagnosis.with_suffix(".pdf")
    browser.document(of_diagnosis, DARK, f"--print-to-pdf={path}")
    data = path.read_bytes()
    assert data.startswith(b"%PDF")
    assert len(data) > 60_000
    assert 4 <= len(re.findall(rb"/Type\s*/Page\b", data)) <= 16
