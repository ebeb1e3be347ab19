"""A model in a browser: what its WebAssembly module gives for chosen values, read back exactly."""

import base64
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.export.web import web_module
from psa_casadi.model.compose import Model
from psa_casadi.report.page.live import doubles, live_data
from tests.report.browser import Browser, driven, script


def library(name: str) -> str:
    """Return a script of the pages."""
    return files("psa_casadi.report.page").joinpath(name).read_text(encoding="utf-8")


def case(
    model: Model, time: FloatArray, voltage: FloatArray, *, rtol: float | None = 1e-6, **more: Any
) -> dict[str, Any]:
    """Return a request to a page: the model's values on a voltage."""
    return {
        "values": model.parameter_vector().tolist(),
        "nominals": model.state_nominals().tolist(),
        "error_sizes": model.error_sizes().tolist(), "t": doubles(time), "rtol": rtol,
        "inputs": {"voltage": doubles(voltage)}, **more,
    }  # fmt: skip


def run_in_browser(
    browser: Browser, model: Model, cases: Sequence[Mapping[str, Any]], *, times: int = 0
) -> list[dict[str, Any]]:
    """Return status, way, steps and displayed displacement (n,) [m] of every case of one module.

    Each is run `times` more, and `spent` is what one takes then [ms].
    """
    table = {"model": live_data(model, web_module(model)), "cases": list(cases), "times": times}
    page = browser.folder / "module.html"
    scripts = "".join(map(library, ("packed.js", "live_model.js")))
    page.write_text(f"<html><body><script>{scripts}</script></body></html>", encoding="utf-8")
    output = driven(browser, page, f"var given = {json.dumps(table)};\n{script('module')}")
    assert isinstance(output, list), output
    for row in output:
        if "shown" in row:
            row["shown"] = np.frombuffer(base64.b64decode(row["shown"]), "<f8")
    return output
