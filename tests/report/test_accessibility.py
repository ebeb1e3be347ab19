"""No page keeps people out who cannot see it well or have no mouse: axe finds no serious fault.

The pages of the site are checked in the folder that PSA_CASADI_SITE names, as
`build_scripts/check docs` does.
"""

import os
from pathlib import Path

import pytest

from tests.report.browser import DARK, MOUSE, Browser
from tests.report.test_report_browser import report_page
from tests.tiers import slow

pytestmark = pytest.mark.xdist_group("browser")

#: One page of every kind: text and tables, code, a gallery, a notebook, what is made from code.
SITE = (
    "", "evidence", "howto/verdict", "howto/simulink", "effects", "tutorials/laboratory_to_fmu",
    "commands", "python", "json",
)  # fmt: skip


@slow
@pytest.mark.parametrize("name", ["fit", "diagnosis"])
def test_a_report_has_no_serious_fault(name: str, browser: Browser, tmp_path: Path) -> None:
    page = report_page(name, tmp_path)
    assert browser.serious_faults(page, *([DARK] if name == "fit" else [])) == []


@pytest.mark.skipif("PSA_CASADI_SITE" not in os.environ, reason="PSA_CASADI_SITE names no site")
@pytest.mark.parametrize("name", SITE)
def test_a_page_of_the_site_has_no_serious_fault(name: str, browser: Browser) -> None:
    page = Path(os.environ["PSA_CASADI_SITE"]) / name / "index.html"
    assert browser.serious_faults(page, MOUSE) == []


@slow
def test_a_fault_is_reported(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    picture = "<html lang=en><title>t</title><body><main><h1>t</h1><img src=x.png></main></body>"
    page.write_text(f"<!DOCTYPE html>{picture}</html>", encoding="utf-8")
    (fault,) = browser.serious_faults(page)
    assert fault.startswith("image-alt: <img src=")
