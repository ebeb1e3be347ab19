"""A strip of pictures: a page's model as it was fitted, dragged, without an effect, at night."""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from tests.browser import DARK, find_browser, without_policy

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
