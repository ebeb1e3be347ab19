"""Pieces of a page as HTML: lists, tables, tiles, bars over a floor, what is folded away."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from psa_casadi.report.page.packed import words as _text
from psa_casadi.report.words.tables import Table

_FIGURE = re.compile(r"[-<>]? ?[\d.,]+(e-?\d+)?( (to|%|[-\d.,]+(e-?\d+)?))*|not finite")
_HASH = re.compile(r"[0-9a-f]{64}")
_WIDE = 28
#: What the line of `bars` is where they are errors.
FLOOR = "Dashed: the noise, the floor that no model can remove."


@dataclass(frozen=True)
class Bar:
    """A length in a row of bars: its label, size, colour (a custom property of the style), text."""

    label: str
    size: float
    colour: str
    text: str


def bullets(texts: Iterable[str]) -> str:
    """Return a list."""
    return f"<ul>{''.join(f'<li>{_text(t)}</li>' for t in texts)}</ul>"


def tiles(figures: Iterable[tuple[str, str, str]]) -> str:
    """Return the main figures in a row: label, figure, and a remark that may be empty."""
    cells = "".join(
        f"<div><dt>{_text(label)}</dt><dd>{_text(figure)}"
        f"{f'<small>{_text(remark)}</small>' if remark else ''}</dd></div>"
        for label, figure, remark in figures
    )
    return f'<dl class="tiles">{cells}</dl>'


def bars(caption: str, rows: Sequence[Bar], floor: float, note: str) -> str:
    """Return bars of one scale, with a line across them at `floor`."""
    whole = max((row.size for row in rows), default=0.0) or 1.0
    lines = "".join(
        f'<dt>{_text(row.label)}</dt><dd><span class="track" aria-hidden="true">'
        f'<i style="width:{100.0 * row.size / whole:.1f}%;background:var({row.colour})"></i></span>'
        f"<b>{_text(row.text)}</b></dd>"
        for row in rows
    )
    return (
        f'<figure class="bars"><figcaption>{_text(caption)}</figcaption>'
        f'<dl style="--floor:{100.0 * floor / whole:.1f}%">{lines}</dl>'
        f'<p class="note">{_text(note)}</p></figure>'
    )


def folded(summary: str, content: str) -> str:
    """Return what is seen once its summary is opened."""
    return f"<details><summary>{_text(summary)}</summary>{content}</details>"


def table(rows: Table, marks: Mapping[str, str] | None = None) -> str:
    """Return a table that scrolls on its own where the page is too narrow for it.

    Columns of figures are set flush right; a cell whose text is in `marks` gets that style.
    """
    styles = [_column_style(column) for column in zip(*rows.rows, strict=True)]
    styles = styles or [""] * len(rows.head)

    def row(tag: str, cells: Sequence[str]) -> str:
        texts = (
            f"<{tag}{_class(style, (marks or {}).get(cell, ''))}>{_text(cell)}</{tag}>"
            for cell, style in zip(cells, styles, strict=True)
        )
        return f"<tr>{''.join(texts)}</tr>"

    body = "".join(row("td", cells) for cells in rows.rows)
    return (
        f'<div class="scroll" tabindex="0"><table><thead>{row("th", rows.head)}</thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _class(*names: str) -> str:
    given = " ".join(n for n in names if n)
    return f' class="{given}"' if given else ""


def _column_style(cells: Sequence[str]) -> str:
    filled = [c for c in cells if c]
    if filled and all(_FIGURE.fullmatch(c) for c in filled):
        return "figure"
    if filled and all(_HASH.fullmatch(c) for c in filled):
        return "hash"
    return "wide" if any(len(c) > _WIDE for c in filled) else ""
