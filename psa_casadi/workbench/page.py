"""The page of the workbench: one document with its styles and scripts, and what it may not do."""

import base64
import hashlib
import json
from collections.abc import Sequence
from functools import cache
from html import escape
from importlib.resources import files

from psa_casadi.records.record import COLUMNS
from psa_casadi.units import units_of
from psa_casadi.version import __version__

_PAGE, _REPORT = "psa_casadi.workbench", "psa_casadi.report.page"
_STYLES = ((_REPORT, "page.css"), (_REPORT, "live.css"), (_PAGE, "workbench.css"))
_SCRIPTS = (
    (_PAGE, "begin.js"), (_REPORT, "live_plot.js"), (_PAGE, "columns.js"), (_PAGE, "files.js"),
    (_PAGE, "search.js"), (_PAGE, "workbench.js"),
)  # fmt: skip
#: The door's only script: what follows comes from the page itself, and the token is in no address.
_ENTER = "location.replace('/');"


def page(effects: Sequence[str]) -> str:
    """Return the page; `effects` are those that a person may leave out of the search."""
    told = {
        "effects": list(effects),
        "columns": {n: [u for q in c.quantities for u in units_of(q)] for n, c in COLUMNS.items()},
    }
    data = json.dumps(told).replace("<", "\\u003c")
    head = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Diagnose records</title><style>{_style()}</style></head>\n<body><main>\n"
    )
    return (
        head
        + _source(_PAGE, "workbench.html")
        + f"<footer>psa_casadi {escape(__version__)}. Nothing leaves this machine.</footer>\n"
        + f'<script type="application/json" id="told">{data}</script>\n</main>'
        + f"<script>{_script()}</script>\n</body></html>\n"
    )


def door() -> str:
    """Return what stands at the address with the token: it leads to the page itself."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Diagnose records'
        f"</title></head><body><p><a href='/'>Open the page</a></p><script>{_ENTER}</script>"
        "</body></html>\n"
    )


@cache
def _style() -> str:
    return "".join(_source(*place) for place in _STYLES)


@cache
def _script() -> str:
    return "\n".join(_source(*place) for place in _SCRIPTS)


def _source(package: str, name: str) -> str:
    return files(package).joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


#: What a browser is told to refuse: scripts and styles but the page's own, requests to others, a
#: frame around the page.
PAGE_POLICY = {
    "Content-Security-Policy": (
        f"default-src 'none'; script-src {_hash(_script())} {_hash(_ENTER)};"
        f" style-src {_hash(_style())}; img-src data:; connect-src 'self'; frame-src 'self';"
        " frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    )
}
#: A report is a page of its own that runs its scripts and can reach nothing here, not even by the
#: cookie; beside this its own policy holds.
REPORT_POLICY = {
    "Content-Security-Policy": "sandbox allow-scripts allow-downloads; frame-ancestors 'self'"
}
