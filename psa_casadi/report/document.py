"""One self-contained HTML page: style, script, sections, tables and plots, nothing from the net."""

from collections.abc import Iterable
from html import escape
from typing import Any

from plotly.offline import get_plotlyjs

from psa_casadi.report.tables import Table

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; margin: 0 auto; max-width: 1100px;
  padding: 0 14px 40px; }
h1 { font-size: 1.5em; line-height: 1.25; } h2 { font-size: 1.2em; margin: 1.8em 0 .4em; }
h3 { font-size: 1em; margin: 1.2em 0 .2em; }
p { margin: .4em 0; max-width: 75ch; }
.badge { display: inline-block; padding: .1em .6em; border-radius: .3em; background: #eee;
  font-size: .9em; margin-right: .4em; }
.badge.synthetic { background: #f3e9c4; }
.verdict { font-size: 1.15em; border-left: 5px solid #0072b2; padding-left: .7em; }
.note { color: #555; font-size: .92em; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9em; margin: .5em 0; }
th, td { text-align: left; padding: .25em .7em .25em 0; border-bottom: 1px solid #ddd;
  vertical-align: top; white-space: nowrap; }
th, td:last-child { white-space: normal; }
td:last-child { min-width: 12em; }
td.hash { font-family: monospace; font-size: .8em; overflow-wrap: anywhere; min-width: 18ch; }
@media (max-width: 600px) { body { font-size: 15px; } }
@media print {
  body { max-width: none; font-size: 10pt; padding: 0; }
  .plot, table, h2, h3 { break-inside: avoid; } h2, h3 { break-after: avoid; }
  .scroll { overflow: visible; } table { font-size: 8pt; } td { white-space: normal; }
}
"""

# A finger scrolls the page over a plot instead of zooming it; plots fit the paper when printed.
_SCRIPT = """
(function () {
  var plots = Array.prototype.slice.call(document.querySelectorAll('.js-plotly-plot'));
  if (window.matchMedia('(pointer: coarse)').matches) {
    plots.forEach(function (p) { Plotly.relayout(p, {dragmode: false}); });
  }
  window.addEventListener('beforeprint', function () {
    plots.forEach(function (p) { Plotly.relayout(p, {width: 680}); });
  });
  window.addEventListener('afterprint', function () {
    plots.forEach(function (p) { Plotly.relayout(p, {width: null, autosize: true}); });
  });
})();
"""

_CONFIG = {"responsive": True, "displaylogo": False, "displayModeBar": False}


class Document:
    """Collects the parts of a page in their order and returns its text."""

    def __init__(self, title: str, origin: str) -> None:
        self._title = title
        self._plots = 0
        label = f"{origin} data"
        self._parts = [
            f"<h1>{escape(title)}</h1>",
            f'<p><span class="badge {escape(origin)}">{escape(label)}</span></p>',
        ]

    def heading(self, text: str, level: int = 2) -> None:
        """Begin a section."""
        self._parts.append(f"<h{level}>{escape(text)}</h{level}>")

    def paragraph(self, text: str, kind: str = "") -> None:
        """Add a paragraph; `kind` is the name of a style."""
        marked = f' class="{kind}"' if kind else ""
        self._parts.append(f"<p{marked}>{escape(text)}</p>")

    def bullets(self, texts: Iterable[str]) -> None:
        """Add a list."""
        items = "".join(f"<li>{escape(t)}</li>" for t in texts)
        self._parts.append(f"<ul>{items}</ul>")

    def table(self, table: Table) -> None:
        """Add a table that scrolls on its own where the page is too narrow for it."""
        head = "".join(f"<th>{escape(h)}</th>" for h in table.head)
        hashes = [h == "SHA-256" for h in table.head]
        rows = "".join(
            "<tr>"
            + "".join(
                f"<td{' class=hash' if is_hash else ''}>{escape(cell)}</td>"
                for cell, is_hash in zip(row, hashes, strict=True)
            )
            + "</tr>"
            for row in table.rows
        )
        self._parts.append(
            f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
            f"<tbody>{rows}</tbody></table></div>"
        )

    def plot(self, plot: Any) -> None:
        """Add a plotly figure."""
        self._plots += 1
        text = plot.to_html(
            full_html=False, include_plotlyjs=False, config=_CONFIG, div_id=f"plot{self._plots}"
        )
        self._parts.append(f'<div class="plot">{text}</div>')

    def text(self) -> str:
        """Return the page."""
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{escape(self._title)}</title><style>{_STYLE}</style>"
            f"<script>{get_plotlyjs()}</script></head>\n<body>\n"
            + "\n".join(self._parts)
            + f"\n<script>{_SCRIPT}</script>\n</body></html>\n"
        )
