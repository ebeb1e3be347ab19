"""Models in pages, measured in a headless browser."""

import gzip
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.export.web import web_module
from psa_casadi.report.page.document import render
from psa_casadi.report.page.live import LiveModel, LiveRecord
from psa_casadi.report.page.playground import playground
from psa_casadi.report.words import colours
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.series import Curve, Series
from psa_casadi.units import FloatArray
from psa_casadi.variables import Interval, Provenance
from tests.report.browser import DARK, Browser, find_browser, without_policy
from tests.report.live_pages import case, run_in_browser
from tests.report.report_cases import NOISE
from tests.report.steered_browser import Steered, steered
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

#: What a redraw of so many samples may take [ms].
SAMPLES, ALLOWED = 5000, 100.0
_MODELS: dict[str, tuple[str, ...]] = {
    "base": (),
    "hysteresis memory": ("hysteresis_memory",),
    "creep, memory, load": ("slow_creep", "hysteresis_memory", "load_stiffness"),
    "every effect": tuple(psa.EFFECTS),
}
#: Moves a slider over and over; a size that is read back makes the browser lay out its picture.
_DRAG = """
var box = document.querySelector('.live'), rows = [];
for (var k = 0; k < {times}; k += 1) {{
  var began = performance.now();
  box.psa.set('k_L', {value} * (1 + 0.002 * k));
  box.getBoundingClientRect();
  rows.push([box.psa.last().run, performance.now() - began]);
}}
rows;
"""


def web(progress: Progress, quick: bool) -> Outcome:
    """Return the tables of sizes, redraw times and errors."""
    sizes, times, errors = [], [], []
    with tempfile.TemporaryDirectory() as place, ExitStack() as ends:
        browser, page = find_browser(Path(place)), Path(place) / "page.html"
        tab = ends.enter_context(steered(browser))  # its clock is the machine's

        def redrawn(what: str, n: int, text: str, value: float) -> str:
            """Drag a slider of a page; return the size of the page [kB]."""
            page.write_text(text, encoding="utf-8")
            drag = _DRAG.format(times=6 if quick else 25, value=value)
            rows = _dragged(tab, page, drag)[2:]  # the browser compiles during the first
            ran, whole = np.array(rows).T
            times.append({
                "model": what, "samples": n, "model, least [ms]": number(float(ran.min()), 2),
                "all, least [ms]": number(float(whole.min()), 2),
                "all, median [ms]": number(float(np.median(whole)), 2),
            })  # fmt: skip
            return number(page.stat().st_size / 1e3)

        for name in list(_MODELS)[: 2 if quick else None]:
            progress(name)
            model, began = _model(_MODELS[name]), time.perf_counter()
            module = web_module(model)
            spent, value = time.perf_counter() - began, model.values["k_L"]
            redrawn(name, 1000, _page(model, 1000), value)
            sizes.append({
                "model": name, "module [kB]": number(len(module) / 1e3),
                "gzip [kB]": number(len(gzip.compress(module, 9)) / 1e3),
                "page [kB]": redrawn(name, SAMPLES, _page(model, SAMPLES), value),
                "compiled in [s]": number(spent, 2),
            })  # fmt: skip
            errors.append({"model": name, **_errors(model, browser)})
        progress("playground")
        redrawn("playground", 2000, playground(), 7.3)
    return Outcome((
        TitledTable("Sizes", sizes, f"A page of {SAMPLES} samples; plotly is 1,960 kB of it."
                    " What was compiled before is taken from the cache."),
        TitledTable("Redraws while a slider moves", times,
                    f"Asked at {SAMPLES} samples: below {ALLOWED:g} ms on two cores."),
        TitledTable("Error over the range", errors, "One run is what a slider shows; its error is"
                    " against a tolerance of 1e-8."),
    ), _strip)  # fmt: skip


def _dragged(tab: Steered, page: Path, drag: str) -> Sequence[Sequence[float]]:
    """Return what every move took in a page: the model alone, and all [ms]."""
    tab.call("Page.navigate", url="about:blank")
    tab.call("Page.navigate", url=page.as_uri())
    tab.until("document.querySelector('.live') && document.querySelector('.live').psa")
    rows: Sequence[Sequence[float]] = tab.run(drag)
    return rows


def _model(effects: Sequence[str]) -> psa.Model:
    model = psa.stack_model("P-885.51")
    for name in effects:
        model = model.with_effect(psa.EFFECTS[name])
        if len(effects) < len(psa.EFFECTS):
            gain = model.parameter(psa.EFFECTS[name].gain or "")
            size = gain.typical({**model.values, gain.name: 0.0})
            model = model.with_values({gain.name: float(np.clip(size, *gain.bounds))})
    return model


def _voltage(n: int) -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0.0, 2.0, n)
    return t, 60.0 - 55.0 * np.cos(6.0 * np.pi * t) * np.exp(-0.5 * t)


def _page(model: psa.Model, n: int) -> str:
    t, v = _voltage(n)
    y = psa.simulate(model, t, v).displacement
    measured = y + NOISE * np.random.default_rng(1).standard_normal(n)
    module: Future[bytes | None] = Future()
    module.set_result(web_module(model))
    curve, none = Curve("model", colours.EXTENDED, y), np.zeros(n, dtype=bool)
    row = LiveRecord(Series("record", t, v, measured, (curve,), none, NOISE, False), {"voltage": v})
    live = LiveModel(model, module, [row])
    title = "A model in a page"
    return render("design.html", title, live=live, summary=(), still=None, figures=(), tables=())


def _errors(model: psa.Model, browser: Browser) -> dict[str, str]:
    t, v = _voltage(600)
    table = {"one run": case(model, t, v, quick=True, rtol=None),
             "as psa.simulate, against it": case(model, t, v)}  # fmt: skip
    result = run_in_browser(browser, model, list(table.values()))
    here = (psa.simulate(model, t, v, rtol=r).displacement for r in (1e-8, 1e-6))
    return {
        name: f"{float(np.max(np.abs(f['shown'] - x)) / np.ptp(x)):.1e}"
        for name, f, x in zip(table, result, here, strict=True)
    }


#: What is done to the page before each picture, the caption, and the browser's flags.
_FRAMES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("", "as it was fitted", ()),
    ("box.psa.set('k_L', 1.06 * start('k_L'));", "a slider dragged", ()),
    ("box.querySelectorAll('.switch input')[0].click();", "an effect switched off", ()),
    ("box.psa.set('memory_gain', -0.5 * start('memory_gain'));", "another value, at night",
     (DARK,)),
)  # fmt: skip
_ACT = """<script>
document.querySelectorAll('h1, nav, h2, .live ~ *').forEach(function (n) {{ n.hidden = true; }});
var box = document.querySelector('.live');
var told = JSON.parse(box.querySelector('script').textContent);
function start(name) {{
  return told.parameters.find(function (p) {{ return p.name === name; }}).value;
}}
(function begin() {{
  if (!box.psa) {{ setTimeout(begin, 20); return; }}
  {act}
}})();
</script></body>"""


def _strip() -> Figure:
    """Return pictures of a page as a fit leaves it, with two effects and intervals, two by two."""
    model = _model(("slow_creep", "hysteresis_memory"))
    free = ("k_L", "A", "beta", "tau", *(c.gain or "" for c in model.effects))
    sure = {n: Interval(*sorted((0.9 * model.values[n], 1.1 * model.values[n]))) for n in free}
    page = _page(model.with_values({}, provenance=Provenance(free=free, intervals=sure)), 2000)
    figure, panels = plt.subplots(2, 2, figsize=(12.0, 10.0), layout="constrained")
    with tempfile.TemporaryDirectory() as folder:
        browser = find_browser(Path(folder))
        for k, ((act, caption, flags), axes) in enumerate(zip(_FRAMES, panels.flat, strict=True)):
            path = Path(folder) / f"frame{k}.html"
            text = _ACT.format(act=act).join(without_policy(page).rsplit("</body>", 1))
            path.write_text(text, encoding="utf-8")
            axes.imshow(plt.imread(browser.screenshot(path, 1000, 800, *flags)))
            axes.set_title(f"{k + 1}. {caption}", fontsize=11)
            axes.set_axis_off()
    return figure
