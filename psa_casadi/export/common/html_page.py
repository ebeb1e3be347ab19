"""A page of HTML of its own, without any file beside it, and its tables."""

import html
from collections.abc import Iterable, Sequence

from psa_casadi.characters import check_text

_STYLE = """\
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 svg { width: 3rem; height: 3rem; vertical-align: middle; margin-right: .6rem; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th, td { text-align: left; vertical-align: top; padding: .25rem .8rem .25rem 0; }
tr { border-bottom: 1px solid #8884; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
code { font-size: .95em; }
p.note { border-left: .25rem solid #e69f00; padding-left: .8rem; }
"""


def page(title: str, parts: Iterable[str], what: str) -> str:
    """Return a page of parts that are HTML already; empty ones are left out.

    Raises InputError for a character that HTML cannot carry; `what` names the page then.
    """
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>\n{_STYLE}</style>'
    body = "\n".join(p for p in parts if p)
    check_text(body, what)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def table_of(
    heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()
) -> str:
    """Return a table of texts, escaped; columns of `numbers` are aligned to the right."""
    top = "".join(f"<th>{html.escape(h)}</th>" for h in heads)
    lines = [f"<tr>{top}</tr>"]
    for row in rows:
        openings = ['<td class="number">' if i in numbers else "<td>" for i in range(len(row))]
        cells = [f"{o}{html.escape(c)}</td>" for o, c in zip(openings, row, strict=True)]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"
