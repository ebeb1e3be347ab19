"""A model as WebAssembly runs as it does here: every effect in one module, by the same methods."""

import re

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.web import web_module
from psa_casadi.report.page.live import live_data
from psa_casadi.simulation.simulate import accurate, input_samples
from psa_casadi.simulation.start import start_on
from tests.contract.helpers import off
from tests.model.sampled_models import controller
from tests.report.browser import Browser, find_browser
from tests.report.live_pages import case, run_in_browser
from tests.tiers import slow

pytestmark = pytest.mark.xdist_group("browser")

#: Of the range; what the mathematical functions of two machines differ by, many times over.
SAME = 1e-9


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Browser:
    return find_browser(tmp_path_factory.mktemp("browser"))


def loops(samples: int = 400, period: float = 0.02) -> tuple[FloatArray, FloatArray]:
    """Return loops of two sizes that begin in motion, and a step."""
    t = np.linspace(0.0, 2.0 * period, samples)
    v = 60.0 - 50.0 * np.cos(2.0 * np.pi * t / period + 0.5) * np.where(t < period, 1.0, 0.4)
    v[t > 1.8 * period] += 15.0
    return t, v


def inputs(model: psa.Model, v: FloatArray) -> FloatArray:
    """Return the samples of all inputs, all but the voltage constant."""
    return input_samples(model, len(v), {"voltage": v})


def started(model: psa.Model, t: FloatArray, v: FloatArray) -> FloatArray:
    return start_on(model, t, inputs(model, v)).x


def ordinary_size(model: psa.Model, effect: psa.Component) -> float:
    """Return the gain that a page switches an effect on with."""
    (output,) = (e for e in live_data(model, b"")["effects"] if e["name"] == effect.name)
    return float(output["on"])


def everything() -> psa.Model:
    model = psa.stack_model("P-885.51")
    for effect in psa.EFFECTS.values():
        model = model.with_effect(effect)
    return model


@slow
def test_every_effect_runs_in_one_module_as_it_does_here(browser: Browser) -> None:
    model, (t, v) = everything(), loops()
    rows: dict[str, psa.Model] = {"none": model}
    for effect in psa.EFFECTS.values():
        rows[effect.name] = model.with_values({effect.gain or "": ordinary_size(model, effect)})
    starts = {name: started(m, t, v) for name, m in rows.items()}
    output = run_in_browser(
        browser, model, [case(m, t, v, start=starts[name].tolist()) for name, m in rows.items()]
    )
    changed = []
    for (name, m), row in zip(rows.items(), output, strict=True):
        here, way = accurate(m, t, inputs(m, v), starts[name], rtol=1e-6, hold="linear")
        wanted = here.y[:, m.output_names.index("measured_displacement")]
        assert row["way"] == way, name
        assert off(row["shown"], wanted) < SAME, name
        changed.append(off(row["shown"], output[0]["shown"]))
    assert sum(c > 1e-5 for c in changed) >= 18  # the others need another voltage to show


def test_a_model_that_no_page_runs_is_refused() -> None:
    with pytest.raises(psa.InputError, match="sampled states"):
        web_module(controller())


@slow
def test_a_module_asks_for_nothing_but_mathematical_functions() -> None:
    module = web_module(psa.stack_model("P-885.51"))
    assert module[:4] == b"\0asm"
    assert len(module) < 90_000
    requested = set(re.findall(rb"Math[\x01-\x08]([a-z0-9]+)\x00", module))
    assert requested == {b"pow"}
    assert b"wasi" not in module
