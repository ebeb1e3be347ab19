"""The page of a model in a headless browser: as fitted, changed, without an effect, at night."""

import tempfile
from concurrent.futures import Future
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.export.web import web_module
from psa_casadi.model.variables import Interval, Provenance
from psa_casadi.report.page.document import render
from psa_casadi.report.page.live import LiveModel, LiveRecord
from psa_casadi.report.words import colours
from psa_casadi.report.words.series import Curve, Series
from tests.report.browser import DARK, find_browser, without_policy
from tests.report.report_cases import NOISE
from tests.studies.benchmarks.table import Outcome, Progress


def web(progress: Progress, quick: bool) -> Outcome:
    """Return the picture of docs/howto/web.md."""
    return Outcome((), _strip)


def _page() -> str:
    """Return the page of a model as a fit leaves it, with two effects and intervals."""
    model, n = psa.stack_model("P-885.51"), 2000
    for name in ("slow_creep", "hysteresis_memory"):
        model = model.with_effect(psa.EFFECTS[name])
        gain = model.parameter(psa.EFFECTS[name].gain or "")
        size = gain.typical({**model.values, gain.name: 0.0})
        model = model.with_values({gain.name: float(np.clip(size, *gain.bounds))})
    free = ("k_L", "A", "beta", "tau", *(c.gain or "" for c in model.effects))
    sure = {n: Interval(*sorted((0.9 * model.values[n], 1.1 * model.values[n]))) for n in free}
    model = model.with_values({}, provenance=Provenance(free=free, intervals=sure))
    t = np.linspace(0.0, 2.0, n)
    v = 60.0 - 55.0 * np.cos(6.0 * np.pi * t) * np.exp(-0.5 * t)
    y = psa.simulate(model, t, v).displacement
    measured = y + NOISE * np.random.default_rng(1).standard_normal(n)
    module: Future[bytes | None] = Future()
    module.set_result(web_module(model))
    curve, none = Curve("model", colours.EXTENDED, y), np.zeros(n, dtype=bool)
    row = LiveRecord(Series("record", t, v, measured, (curve,), none, NOISE, False), {"voltage": v})
    live, title = LiveModel(model, module, [row]), "A model in a page"
    return render("design.html", title, live=live, summary=(), still=None, figures=(), tables=())


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
var data = JSON.parse(box.querySelector('script').textContent);
function start(name) {{
  return data.parameters.find(function (p) {{ return p.name === name; }}).value;
}}
(function begin() {{
  if (!box.psa) {{ setTimeout(begin, 20); return; }}
  {act}
}})();
</script></body>"""


def _strip() -> Figure:
    """Return pictures of the page, two by two."""
    page = _page()
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
