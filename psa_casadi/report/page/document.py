"""One self-contained HTML page: a template filled in, with its scripts and plots packed inside."""

import base64
import gzip
import hashlib
import io
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from html import escape
from importlib import import_module
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.image import imsave
from plotly.offline import get_plotlyjs

from psa_casadi.common.characters import plain
from psa_casadi.common.progress import typed
from psa_casadi.report.plots.panel import Panel, plotly_figure
from psa_casadi.report.words import colours, phrases
from psa_casadi.report.words.tables import Table
from psa_casadi.version import __version__

_HOME = "psa_casadi.report.page"
_FIGURE = re.compile(r"[-<>]? ?[\d.,]+(e-?\d+)?( (to|%|[-\d.,]+(e-?\d+)?))*|not finite")
_HASH = re.compile(r"[0-9a-f]{64}")
_WIDE = 28
#: The modules whose functions templates call.
_IN_TEMPLATES = (
    "plots.device_plots", "plots.figures", "plots.findings", "plots.records", "words.catalogue",
    "words.notes", "words.phrases", "words.population_words", "words.tables", "words.text",
    "words.verdict_words",
)  # fmt: skip
#: Levels of red, green and blue of a still picture: lines on paper take few, and it is small.
_LEVELS = 16
#: The scripts of a model that runs in a page, by what it does there, in their order.
_LIVE = ("live_model.js", "live_plot.js", "live_knobs.js")
LIVE_SCRIPTS = {
    "report": (*_LIVE, "live_budget.js", "live.js", "live_start.js"),
    "playground": (*_LIVE, "live_fmu.js", "voltages.js", "playground.js", "live_start.js"),
}


@dataclass(frozen=True)
class Picture:
    """A plot with its caption and, below it, what the reader must know to read it."""

    caption: str
    panel: Panel
    note: str = ""


def render(template: str, title: str, badges: Sequence[str] = (), **options: Any) -> str:
    """Return a page that runs only its scripts and requests nothing from outside."""
    return filled(template, page=_Page(), title=title, badges=badges, made=_made(), **options)


def filled(template: str, **values: Any) -> str:
    """Return the text of a template that is filled in."""
    return environment().get_template(template).render(values)


class _Page:
    """What the templates put into a page besides text: plots, the model that runs, scripts.

    Plots over the same time share it: an array is in the page once.
    """

    def __init__(self) -> None:
        self.sections: list[tuple[str, str]] = []
        self._arrays: dict[str, int] = {}
        self._plots, self._alive = False, ""

    def section(self, title: str) -> str:
        """Note a section for the list of contents; return the name that links lead to."""
        self.sections.append((f"s{len(self.sections) + 1}", title))
        return self.sections[-1][0]

    def plot(self, panel: Panel) -> Markup:
        """Return the data of a plot, whose long arrays are shared."""
        self._plots = True
        return _json(
            plotly_figure(panel, lambda array: self._arrays.setdefault(array, len(self._arrays)))
        )

    def live(self, table: Mapping[str, Any]) -> Markup:
        """Return what the script of a model that runs in the page must know of it."""
        self._alive = table["kind"]
        return _json(table)

    def style(self) -> Markup:
        """Return the style sheet."""
        return Markup(source("page.css") + (source("live.css") if self._alive else ""))

    def scripts(self) -> list[Markup]:
        """Return the scripts that the page runs."""
        texts = [source("packed.js"), source("page.js")] if self._plots or self._alive else []
        texts += ["\n".join(map(source, LIVE_SCRIPTS[self._alive]))] if self._alive else []
        return [Markup(text) for text in texts]

    def policy(self) -> Markup:
        """Return the policy: a browser refuses all requests, and all scripts but the page's."""
        allowed = [script_hash(text) for text in self.scripts()]
        allowed += [_library()[1]] if self._plots or self._alive else []
        rules = (
            "default-src 'none'", "style-src 'unsafe-inline'", "img-src data: blob:",
            f"script-src 'wasm-unsafe-eval' {' '.join(allowed)}", "base-uri 'none'",
            "form-action 'none'",
        )  # fmt: skip
        return Markup("; ".join(rules))

    def shared(self) -> Markup:
        """Return what all plots take: colours at night, the arrays, the library that draws them."""
        if not (self._plots or self._alive):
            return Markup("")
        dark = json.dumps(colours.DARK)
        first = f'<script type="application/json" id="dark-colours">{dark}</script>'
        held = {"arrays": packed(" ".join(self._arrays).encode()), "library": _library()[0]}
        rows = (f'<script type="application/gzip" id="{n}">{t}</script>' for n, t in held.items())
        return Markup(first + "".join(rows))


@cache
def environment() -> Environment:
    """Return what fills templates in: words are escaped, a percent sign stays with its number."""
    made = Environment(
        loader=PackageLoader(_HOME, "templates"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, finalize=_words,
    )  # fmt: skip
    made.globals.update(column_styles=_column_styles, still_picture=_still_picture)
    for place in _IN_TEMPLATES:
        made.globals[place.partition(".")[2]] = import_module(f"psa_casadi.report.{place}")
    made.filters.update(plain=phrases.plain, percent=phrases.percent, either=phrases.either)
    return made


def _words(value: Any) -> Any:
    """Return words as HTML can carry them; a percent sign stays with its number."""
    if hasattr(value, "__html__"):
        return value
    return Markup(escape(plain(str(value))).replace(" %", "\u00a0%"))


def _column_styles(table: Table) -> list[str]:
    """Return the style of every column: figures, hashes, long texts, or none."""
    styles = []
    for column in zip(*table.rows, strict=True):
        cells = [c for c in column if c]
        style = "wide" if any(len(c) > _WIDE for c in cells) else ""
        for name, pattern in (("hash", _HASH), ("figure", _FIGURE)):
            if cells and all(pattern.fullmatch(c) for c in cells):
                style = name
        styles.append(style)
    return styles or [""] * len(table.head)


def _still_picture(figure: Figure) -> str:
    """Return the address of a small PNG that matplotlib draws."""
    canvas: Any = figure.canvas
    canvas.draw()
    drawn, step = np.asarray(canvas.buffer_rgba()), 255.0 / (_LEVELS - 1)
    buffer = io.BytesIO()
    imsave(buffer, (step * np.rint(drawn / step)).astype(np.uint8), format="png")
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def source(name: str) -> str:
    """Return a style or script of this package."""
    return files(_HOME).joinpath(name).read_text(encoding="utf-8")


def packed(content: bytes) -> str:
    """Return bytes as packed.js opens them: gzip in base64."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def script_hash(text: str) -> str:
    """Return what a content security policy calls a script or a style."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


@cache  # packing takes 0.3 s
def _library() -> tuple[str, str]:
    """Return the script that the installed plotly draws with, packed, and its hash."""
    text = get_plotlyjs()
    return packed(text.encode()), script_hash(text)


def _json(content: object) -> Markup:
    """Return data for a script; "<" is escaped so that no text in it can end the script."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    return Markup(f'<script type="application/json">{text}</script>')


def _made() -> str:
    """Say when the page was written, by which version and command."""
    stated = os.environ.get("SOURCE_DATE_EPOCH", "")
    when = datetime.fromtimestamp(int(stated), UTC) if stated.isdecimal() else datetime.now(UTC)
    command = f" Command: {typed.get()}" if typed.get() else ""
    return f"Written {when:%Y-%m-%d %H:%M} UTC by psa_casadi {__version__}.{command}"
