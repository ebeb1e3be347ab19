"""One self-contained HTML page: style, script, sections, tables and plots, nothing from the net."""

import base64
import io
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.resources import files
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imsave

from psa_casadi.command_line import typed
from psa_casadi.report.page import blocks
from psa_casadi.report.page.blocks import Bar
from psa_casadi.report.page.packed import Drawings, Picture, library_hash, script_hash
from psa_casadi.report.page.packed import words as _text
from psa_casadi.report.plots.theme import DARK
from psa_casadi.report.words.tables import Table
from psa_casadi.version import __version__

#: Levels of red, green and blue of a still picture: lines on paper take few, and it is small.
_LEVELS = 16
#: The scripts of a model that runs in a page, by what it does there, in their order.
_LIVE = ("live_model.js", "live_plot.js", "live_zoom.js", "live_knobs.js")
LIVE_SCRIPTS = {
    "report": (*_LIVE, "live_budget.js", "live.js", "live_start.js"),
    "playground": (*_LIVE, "live_fmu.js", "voltages.js", "playground.js", "live_start.js"),
}


class Document:
    """Collects the parts of a page in their order and returns its text."""

    def __init__(self, title: str, badges: Sequence[str]) -> None:
        self._title, self._alive, self._drawings = title, "", Drawings()
        marks = "".join(
            f'<span class="badge {_text(b.split()[0])}">{_text(b)}</span>' for b in badges
        )
        self._head = f"<h1>{_text(title)}</h1><p>{marks}</p>"
        self._top: list[str | Callable[[], str]] = []
        self._parts = self._top
        self._sections: list[tuple[str, str]] = []

    def section(self, title: str) -> None:
        """Begin a section that the list of contents at the top names."""
        if not self._sections:
            self._parts = []
        name = f"s{len(self._sections) + 1}"
        self._sections.append((name, title))
        self._parts.append(f'<h2 id="{name}">{_text(title)}</h2>')

    def heading(self, text: str) -> None:
        """Begin a part of a section."""
        self._parts.append(f"<h3>{_text(text)}</h3>")

    def paragraph(self, text: str, kind: str = "") -> None:
        """Add a paragraph; `kind` is the name of a style."""
        marked = f' class="{kind}"' if kind else ""
        self._parts.append(f"<p{marked}>{_text(text)}</p>")

    def bullets(self, texts: Iterable[str]) -> None:
        """Add a list."""
        self._parts.append(blocks.bullets(texts))

    def warnings(self, texts: Sequence[str]) -> None:
        """Add a box that nobody overlooks; nothing if there is nothing to warn of."""
        if texts:
            word = "Warning" if len(texts) == 1 else "Warnings"
            self._parts.append(
                f'<div class="warnings" role="alert"><p>{word}</p>{blocks.bullets(texts)}</div>'
            )

    def advice(self, title: str, texts: Sequence[str], commands: Sequence[str]) -> None:
        """Add a box that says what to do, and what to type."""
        typed_text = "\n".join(commands)
        block = f'<pre tabindex="0">{_text(typed_text)}</pre>' if commands else ""
        self._parts.append(
            f'<div class="advice"><p>{_text(title)}</p>{blocks.bullets(texts)}{block}</div>'
        )

    def tiles(self, figures: Iterable[tuple[str, str, str]]) -> None:
        """Add the main figures in a row: label, figure, and a remark that may be empty."""
        self._parts.append(blocks.tiles(figures))

    def bars(self, caption: str, rows: Sequence[Bar], floor: float, note: str) -> None:
        """Add bars of one scale, with a line across them at `floor`."""
        self._parts.append(blocks.bars(caption, rows, floor, note))

    def table(
        self, table: Table, marks: Mapping[str, str] | None = None, *, folded: str = ""
    ) -> None:
        """Add a table; a cell whose text is in `marks` gets that style.

        It is `folded` away behind these words, where they are given.
        """
        content = blocks.table(table, marks)
        self._parts.append(blocks.folded(folded, content) if folded else content)

    def picture(self, picture: Picture) -> None:
        """Add a plot over the whole width."""
        self._parts.append(self._drawings.figure(picture))

    def still(self, figure: Figure, caption: str) -> None:
        """Add a picture that matplotlib draws; it is seen where the plots cannot be drawn.

        That is where scripts are off, or the browser is older than 2023.
        """
        canvas = FigureCanvasAgg(figure)
        canvas.draw()  # type: ignore[no-untyped-call]
        drawn = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        step, buffer = 255.0 / (_LEVELS - 1), io.BytesIO()
        imsave(buffer, (step * np.rint(drawn / step)).astype(np.uint8), format="png")
        data = base64.b64encode(buffer.getvalue()).decode("ascii")
        self._parts.append(
            f'<figure class="stand-in"><figcaption>{_text(caption)}</figcaption><img class="still"'
            f' alt="{_text(caption)}" src="data:image/png;base64,{data}"></figure>'
        )

    def pictures(self, pictures: Iterable[Picture]) -> None:
        """Add plots side by side, two in a row where there is room."""
        figures = "".join(map(self._drawings.figure, pictures))
        self._parts.append(f'<div class="pair">{figures}</div>')

    def live(self, told: Callable[[], Mapping[str, Any] | str]) -> None:
        """Add a model that runs in the page.

        What live.js must know of it is asked for when all else is there; words say why it is not.
        """

        def part() -> str:
            found = told()
            if isinstance(found, str):
                return f'<p class="note">{_text(found)}</p>'
            self._alive = found["kind"]
            return (
                f'<div class="live">{_json(found)}<p class="note still-note">With scripts on, the'
                " model runs here: sliders for its parameters, switches for its effects.</p></div>"
            )

        self._parts.append(part)

    def text(self) -> str:
        """Return the page; no script runs in it but its own, and it asks for nothing outside."""
        contents = "".join(f'<a href="#{n}">{_text(title)}</a>' for n, title in self._sections)
        body = [self._head, *self._top]
        if self._sections:
            body += [f'<nav aria-label="contents">{contents}</nav>', *self._parts]
        told = [part if isinstance(part, str) else part() for part in body]
        style = _source("page.css") + (_source("live.css") if self._alive else "")
        scripts = [_source("packed.js")] if self._drawings or self._alive else []
        scripts += [_source("page.js")] if self._drawings else []
        scripts += ["\n".join(map(_source, LIVE_SCRIPTS[self._alive]))] if self._alive else []
        allowed = [script_hash(text.encode()) for text in scripts]
        allowed += [library_hash()] if self._drawings else []
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            + _policy(allowed)
            + '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{_text(self._title)}</title><style>{style}</style>"
            + "</head>\n<body><main>\n"
            + "\n".join(told)
            + f"\n<footer>{_text(_made())}</footer>"
            + f'\n<script type="application/json" id="dark-colours">{json.dumps(DARK)}</script>'
            + (self._drawings.shared() if self._drawings else "")
            + "\n</main>"
            + "".join(f"<script>{text}</script>" for text in scripts)
            + "\n</body></html>\n"
        )


def _source(name: str) -> str:
    """Return a style or script that lies beside this file."""
    return files("psa_casadi.report.page").joinpath(name).read_text(encoding="utf-8")


def _policy(scripts: Iterable[str]) -> str:
    """Return what a browser is told to refuse: all scripts but these, and all requests."""
    allowed = " ".join(scripts)
    rules = (
        "default-src 'none'", "style-src 'unsafe-inline'", "img-src data: blob:",
        f"script-src 'wasm-unsafe-eval' {allowed}", "base-uri 'none'", "form-action 'none'",
    )  # fmt: skip
    return f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(rules)}">'


def _json(content: object) -> str:
    """Return data for a script; "<" is escaped so that no text in it can end the script."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json">{text}</script>'


def _made() -> str:
    """Say when the page was written, by which version and command."""
    stated = os.environ.get("SOURCE_DATE_EPOCH", "")
    when = datetime.fromtimestamp(int(stated), UTC) if stated.isdecimal() else datetime.now(UTC)
    command = f" Command: {typed.get()}" if typed.get() else ""
    return f"Written {when:%Y-%m-%d %H:%M} UTC by psa_casadi {__version__}.{command}"
