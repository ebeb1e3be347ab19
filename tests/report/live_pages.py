"""A model in a browser: what its WebAssembly module gives for chosen values, read back exactly."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from html import unescape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.export.web import web_module
from psa_casadi.model.compose import Model
from psa_casadi.report.page.live import doubles, live_data
from psa_casadi.units import FloatArray
from tests.report.browser import SCRIPTS, Browser

_PAGE = (SCRIPTS / "module.html").read_text("utf-8")
_TOLD = re.compile(r'<pre id="told">(.*?)</pre>', re.DOTALL)


def library(name: str) -> str:
    """Return a script of the pages."""
    return files("psa_casadi.report.page").joinpath(name).read_text(encoding="utf-8")


def case(
    model: Model, time: FloatArray, voltage: FloatArray, *, rtol: float | None = 1e-6, **more: Any
) -> dict[str, Any]:
    """Return what a page is asked for: the model's values on a voltage."""
    return {
        "values": model.parameter_vector().tolist(),
        "nominals": model.state_nominals().tolist(),
        "error_sizes": model.error_sizes().tolist(), "t": doubles(time), "rtol": rtol,
        "inputs": {"voltage": doubles(voltage)}, **more,
    }  # fmt: skip


def run_in_browser(
    browser: Browser, model: Model, cases: Sequence[Mapping[str, Any]], *, times: int = 0
) -> list[dict[str, Any]]:
    """Return status, way, steps and shown displacement (n,) [m] of every case of one module.

    Each is run so many `times` more, and `spent` is what one takes then [ms].
    """
    given = {"model": live_data(model, web_module(model)), "cases": list(cases), "times": times}
    page: Path = browser.folder / "module.html"
    text = _PAGE.format(
        library=library("packed.js") + library("live_model.js"), given=json.dumps(given)
    )
    page.write_text(text, encoding="utf-8")
    document, console = browser.document(page)
    found = _TOLD.search(document)
    assert found is not None
    assert console == [], console
    told: list[dict[str, Any]] = json.loads(unescape(found[1]))
    for row in told:
        if "shown" in row:
            row["shown"] = np.frombuffer(base64.b64decode(row["shown"]), "<f8")
    return told
