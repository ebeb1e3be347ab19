"""Models in pages: size of module and page, how long a redraw takes, how far a quick run errs."""

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

from psa_casadi.effects import EFFECTS
from psa_casadi.export.web import web_module
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.report.page.document import render
from psa_casadi.report.page.live import LiveModel, LiveRecord
from psa_casadi.report.page.playground import playground
from psa_casadi.report.words import colours
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.series import Curve, Series
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.simulate import simulate
from psa_casadi.units import FloatArray
from psa_casadi.variables import Interval, Provenance
from tests.report.browser import DARK, Browser, find_browser, without_policy
from tests.report.live_pages import case, run_in_browser
from tests.report.report_cases import NOISE
from tests.report.steered_browser import Steered, steered
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

#: What is done to the page before each picture, the caption, and the browser's flags.
_FRAMES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("", "as it was fitted", ()),
    ("box.psa.set('k_L', 1.06 * start('k_L'));", "a slider dragged", ()),
    ("box.querySelectorAll('.switch input')[0].click();", "an effect switched off", ()),
    (
        "box.psa.set('memory_gain', -0.5 * start('memory_gain'));",
        "another value, at night",
        (DARK,),
    ),
)
_WIDTH, _HEIGHT = 1000, 800
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


def strip(page: str) -> Figure:
    """Return pictures of a page with a model that has two effects, two by two."""
    drawn, axes = plt.subplots(2, 2, figsize=(12.0, 10.0), layout="constrained")
    with tempfile.TemporaryDirectory() as folder:
        browser = find_browser(Path(folder))
        for k, ((act, caption, flags), ax) in enumerate(zip(_FRAMES, axes.flat, strict=True)):
            path = Path(folder) / f"frame{k}.html"
            text = _ACT.format(act=act).join(without_policy(page).rsplit("</body>", 1))
            path.write_text(text, encoding="utf-8")
            ax.imshow(plt.imread(browser.screenshot(path, _WIDTH, _HEIGHT, *flags)))
            ax.set_title(f"{k + 1}. {caption}", fontsize=11)
            ax.set_axis_off()
    return drawn


#: What a redraw of so many samples may take [ms].
SAMPLES, ALLOWED = 5000, 100.0
_MODELS: dict[str, tuple[str, ...]] = {
    "base": (),
    "hysteresis memory": ("hysteresis_memory",),
    "creep, memory, load": ("slow_creep", "hysteresis_memory", "load_stiffness"),
    "every effect": tuple(EFFECTS),
}
#: Effects of the page in the strip of pictures.
_STRIP = ("slow_creep", "hysteresis_memory")
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


def run(progress: Progress, quick: bool) -> Outcome:
    """Return the tables of sizes, redraw times and errors."""
    sizes, times, errors = [], [], []
    with tempfile.TemporaryDirectory() as place, ExitStack() as ends:
        folder = Path(place)
        browser, page = find_browser(folder), folder / "page.html"
        tab = ends.enter_context(steered(browser))  # its clock is the machine's

        def redrawn(what: str, n: int, text: str, value: float) -> float:
            """Drag a slider of a page; return the size of the page [kB]."""
            page.write_text(text, encoding="utf-8")
            drag = _DRAG.format(times=6 if quick else 25, value=value)
            rows = _dragged(tab, page, drag)[2:]  # the browser compiles during the first
            ran, whole = np.array(rows).T
            shown = (ran.min(), whole.min(), np.median(whole))
            times.append((what, str(n), *(number(float(x), 2) for x in shown)))
            return page.stat().st_size / 1e3

        for name in list(_MODELS)[: 2 if quick else None]:
            progress(name)
            model, began = _model(_MODELS[name]), time.perf_counter()
            module = web_module(model)
            spent, value = time.perf_counter() - began, model.values["k_L"]
            redrawn(name, 1000, _page(model, 1000), value)
            kb = redrawn(name, SAMPLES, _page(model, SAMPLES), value)
            small = (len(module) / 1e3, len(gzip.compress(module, 9)) / 1e3)
            sizes.append((name, *map(number, (*small, kb)), number(spent, 2)))
            errors.append((name, *_errors(model, browser)))
        progress("playground")
        kb = redrawn("playground", 2000, playground(), 7.3)
        sizes.append(("playground", "", "", number(kb), ""))
    return Outcome((
        TitledTable(
            "Sizes",
            Table(("model", "module [kB]", "gzip [kB]", "page [kB]", "compiled in [s]"),
                  tuple(sizes)),
            f"A page of {SAMPLES} samples; plotly is 1,960 kB of it. What was compiled before"
            " is taken from the cache.",
        ),
        TitledTable(
            "Redraws while a slider moves",
            Table(("model", "samples", "model, least [ms]", "all, least [ms]",
                   "all, median [ms]"), tuple(times)),
            f"Asked at {SAMPLES} samples: below {ALLOWED:g} ms on two cores.",
        ),
        TitledTable(
            "Error over the range",
            Table(("model", "one run", "as psa.simulate, against it"), tuple(errors)),
            "One run is what a slider shows; its error is against a tolerance of 1e-8.",
        ),
    ), _strip_as_fitted)  # fmt: skip


def _dragged(tab: Steered, page: Path, drag: str) -> Sequence[Sequence[float]]:
    """Return what every move took in a page: the model alone, and all [ms]."""
    tab.call("Page.navigate", url="about:blank")
    tab.call("Page.navigate", url=page.as_uri())
    tab.until("document.querySelector('.live') && document.querySelector('.live').psa")
    rows: Sequence[Sequence[float]] = tab.run(drag)
    return rows


def _model(effects: Sequence[str]) -> Model:
    model = stack_model("P-885.51")
    for name in effects:
        model = model.with_effect(EFFECTS[name])
        if len(effects) < len(EFFECTS):
            gain = model.parameter(EFFECTS[name].gain or "")
            size = gain.typical({**model.values, gain.name: 0.0})
            model = model.with_values({gain.name: float(np.clip(size, *gain.bounds))})
    return model


def _voltage(n: int) -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0.0, 2.0, n)
    return t, 60.0 - 55.0 * np.cos(6.0 * np.pi * t) * np.exp(-0.5 * t)


def _page(model: Model, n: int) -> str:
    t, v = _voltage(n)
    y = simulate(model, t, v).displacement
    measured = y + NOISE * np.random.default_rng(1).standard_normal(n)
    module: Future[bytes | None] = Future()
    module.set_result(web_module(model))
    curve, none = Curve("model", colours.EXTENDED, y), np.zeros(n, dtype=bool)
    row = LiveRecord(Series("record", t, v, measured, (curve,), none, NOISE, False), {"voltage": v})
    live = LiveModel(model, module, [row])
    title = "A model in a page"
    return render("design.html", title, live=live, summary=(), still=None, figures=(), tables=())


def _strip_as_fitted() -> Figure:
    """Return the strip of a page as a fit leaves it: some values are free, with intervals."""
    model = _model(_STRIP)
    free = ("k_L", "A", "beta", "tau", *(c.gain or "" for c in model.effects))
    sure = {n: Interval(*sorted((0.9 * model.values[n], 1.1 * model.values[n]))) for n in free}
    fitted = model.with_values({}, provenance=Provenance(free=free, intervals=sure))
    return strip(_page(fitted, 2000))


def _errors(model: Model, browser: Browser) -> list[str]:
    t, v = _voltage(600)
    asked = [case(model, t, v, quick=True, rtol=None), case(model, t, v)]
    found = run_in_browser(browser, model, asked)
    here = (simulate(model, t, v, rtol=r).displacement for r in (1e-8, 1e-6))
    pairs = [(f["shown"], x) for f, x in zip(found, here, strict=True)]
    return [f"{float(np.max(np.abs(a - b)) / np.ptp(b)):.1e}" for a, b in pairs]
