"""Headless Chromium as a command: a page's document, console and screenshot."""

import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from html import unescape
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
#: Headless windows are at least 500 wide; a phone is a frame in one.
PHONE = 390
#: A desk has a mouse, which headless browsers lack: pages behave as on a touch screen without it.
MOUSE = (
    "--blink-settings=primaryHoverType=2,availableHoverTypes=2,"
    "primaryPointerType=4,availablePointerTypes=4"
)
DARK = "--blink-settings=preferredColorScheme=0"
SCRIPTS = Path(__file__).parent / "scripts"
_CONSOLE = re.compile(r":CONSOLE[:(]\d+\)?\] (.*)")


def script(name: str) -> str:
    """Return a script of the tests."""
    return (SCRIPTS / f"{name}.js").read_text("utf-8")


@dataclass(frozen=True)
class Browser:
    """The browser at `path`, with a folder for its profile and its pages."""

    path: str
    folder: Path

    def document(self, page: Path, *flags: str) -> tuple[str, list[str]]:
        """Return the page's document after its scripts ran, and the lines of its console."""
        done = self._run(page, "--dump-dom", *flags)
        return done.stdout, _CONSOLE.findall(done.stderr)

    def screenshot(self, page: Path, width: int, height: int, *flags: str) -> Path:
        """Return a picture of the window."""
        path = self.folder / f"{page.stem}-{width}-{len(flags)}.png"
        self._run(page, f"--screenshot={path}", f"--window-size={width},{height}", *flags)
        return path

    def serious_faults(self, page: Path, *flags: str) -> list[str]:
        """Return what axe calls serious or critical in a page: the rule, and where first."""
        axe = files("axe_core_python").joinpath("axe.min.js").read_text(encoding="utf-8")
        return [
            f"{fault['rule']}: {fault['places'][0]}"
            for fault in driven(self, page, f"{axe}\n{script('axe')}", *flags, silent=False)
            if fault["impact"] in ("serious", "critical")
        ]

    def _run(self, page: Path, *flags: str) -> subprocess.CompletedProcess[str]:
        command = [
            self.path, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--enable-logging=stderr", "--virtual-time-budget=20000", "--no-first-run",
            f"--user-data-dir={self.folder / 'profile'}", *flags, page.as_uri(),
        ]  # fmt: skip
        return subprocess.run(
            command, capture_output=True, text=True, timeout=240, check=True, errors="replace"
        )


def without_policy(text: str) -> str:
    """Return a page without its content security policy, so that scripts of a test run."""
    return re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text, count=1)


def driven(browser: Browser, page: Path, script: str, *flags: str, silent: bool = True) -> Any:
    """Run a script in a copy of a drawn page, and return the argument that it passes to `tell`.

    If `silent`, a message on the console fails the test.
    """
    copy = page.with_name(f"{page.stem}-driven.html")  # in the same folder: its links are relative
    call = (
        "<pre id='driven'></pre><script>function tell(result) {"
        " document.getElementById('driven').textContent = JSON.stringify(result); }\n"
        f"window.addEventListener('load', () => setTimeout(() => {{\n{script}}}, 500));"
        "</script></body>"
    )
    text = call.join(without_policy(page.read_text(encoding="utf-8")).rsplit("</body>", 1))
    copy.write_text(text, encoding="utf-8")
    document, console = browser.document(copy, *flags)
    copy.unlink()
    result = re.search(r"<pre id=.driven.>(.*?)</pre>", document, re.DOTALL)
    if result is None or not result[1] or (silent and console):
        pytest.fail(f"the script in {page} did not come to its end: {console}")
    return json.loads(unescape(result[1]))


def find_browser(folder: Path) -> Browser:
    """Return a browser; without one the test is skipped, or fails where one is required."""
    path = next((p for p in map(shutil.which, NAMES) if p), None)
    if path is None:
        reason = f"no browser is installed: none of {', '.join(NAMES)} is in PATH"
        if os.environ.get("PSA_CASADI_REQUIRE_BROWSER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return Browser(path, folder)


def on_a_phone(page: Path, height: int = 844) -> Path:
    """Return a page that shows `page` in a frame as wide as a phone."""
    inner, outer = (page.with_name(f"{page.stem}-{part}.html") for part in ("inner", "phone"))
    text = without_policy(page.read_text(encoding="utf-8"))
    output = f"<script>{script('phone')}</script></body>"
    inner.write_text(text.replace("</body>", output), encoding="utf-8")
    outer.write_text(
        "<!DOCTYPE html><html><body style='margin:0'>"
        f"<iframe src='{inner.name}' width='{PHONE}' height='{height}' style='border:0'></iframe>"
        "</body></html>",
        encoding="utf-8",
    )
    return outer


def phone_view(browser: Browser, page: Path, *, silent: bool = True) -> dict[str, Any]:
    """Return the layout of a page on a phone."""
    hear = "addEventListener('message', function (e) { tell(JSON.parse(e.data)); });"
    table: dict[str, Any] = driven(browser, on_a_phone(page), hear, silent=silent)
    return table
