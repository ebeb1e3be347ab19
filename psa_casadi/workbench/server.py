"""The local page's server: this machine only, whoever has the address, nothing from outside."""

import base64
import contextlib
import hashlib
import hmac
import json
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from jinja2 import Environment
from markupsafe import Markup

from psa_casadi.errors import InputError, MachineError
from psa_casadi.records.read.columns import COLUMNS
from psa_casadi.units import units_of
from psa_casadi.version import __version__
from psa_casadi.workbench.desk import BUSY, BusyError, Desk

#: The name of the machine for itself, as addresses have it.
HOST = "127.0.0.1"
#: What a browser says of a request that the page itself, or nobody else's page, has caused.
_OWN = ("same-origin", "none")


@dataclass(frozen=True)
class Gate:
    """What opens a page at a port: a token in the address, then a cookie.

    The cookie is no part of an address, no script can read it, and a browser sends it with nothing
    that another site has caused. The names of the machine are a fixed list, so that a name of
    somebody else which leads to this machine (DNS rebinding) opens nothing.
    """

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    _session: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    @property
    def address(self) -> str:
        """The address that opens the page."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """What a browser is given to keep."""
        return f"{self._name}={self._session}; HttpOnly; SameSite=Strict; Path=/"

    @property
    def _name(self) -> str:
        return f"psa_{self.port}"  # browsers have one set of cookies for all ports

    def opens(self, token: str) -> bool:
        """Whether an address's token is the right one."""
        return _same(token, self.token)

    def refused(self, method: str, headers: Mapping[str, str]) -> tuple[HTTPStatus, str] | None:
        """Return why a request is refused, before its cookie is looked at; None where it is not."""
        hosts = [f"{name}:{self.port}" for name in (HOST, "localhost")]
        host = headers.get("Host", "")
        if host not in hosts:
            return HTTPStatus.MISDIRECTED_REQUEST, "This page has another address."
        if method == "POST" and headers.get("Origin", "") != f"http://{host}":
            return HTTPStatus.FORBIDDEN, "Only the page itself may ask for this."
        return None

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Whether a request has the cookie and is not caused by another site."""
        if headers.get("Sec-Fetch-Site", "none") not in _OWN:
            return False
        try:
            found = SimpleCookie(headers.get("Cookie", "")).get(self._name)
        except CookieError:
            return False
        return found is not None and _same(found.value, self._session)


def _same(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())


_PAGE, _REPORT = "psa_casadi.workbench", "psa_casadi.report.page"
_STYLES = ((_REPORT, "page.css"), (_REPORT, "live.css"), (_PAGE, "workbench.css"))
_SCRIPTS = (
    (_PAGE, "begin.js"), (_PAGE, "columns.js"), (_PAGE, "files.js"),
    (_PAGE, "search.js"), (_PAGE, "workbench.js"),
)  # fmt: skip
#: What stands at the address with the token, and its only script: it leads to the page, which
#: asks for all that follows, so that the token is in no address.
_ENTER = "location.replace('/');"
_DOOR = (
    '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Diagnose records</title>'
    f"</head><body><p><a href='/'>Open the page</a></p><script>{_ENTER}</script></body></html>\n"
)


def page(effects: Sequence[str]) -> str:
    """Return the page; `effects` are those that a person may leave out of the search."""
    told = {
        "effects": list(effects),
        "columns": {n: [u for q in c.quantities for u in units_of(q)] for n, c in COLUMNS.items()},
    }
    return Environment(autoescape=True).from_string(_source(_PAGE, "workbench.html")).render(
        style=Markup(_style()), script=Markup(_script()), version=__version__,
        told=Markup(json.dumps(told).replace("<", "\\u003c")),
    )  # fmt: skip


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


#: The most bytes of a request that is not a file, and how long a connection may be silent [s].
_MOST_ASKED, _SILENT_S = 2**16, 60.0
_HTML, _JSON = "text/html; charset=utf-8", "application/json; charset=utf-8"
_KINDS = {".html": _HTML, ".json": _JSON, ".csv": "text/csv; charset=utf-8"}
_ALWAYS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Server(ThreadingHTTPServer):
    """Serves one desk at one port; a request has a thread of its own."""

    daemon_threads = True

    def __init__(self, port: int, desk: Desk) -> None:
        super().__init__((HOST, port), _Handler)
        self.desk, self.gate = desk, Gate(self.server_address[1])

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a browser that has gone."""


@contextmanager
def served(port: int, desk: Desk) -> Iterator[Server]:
    """Serve a desk while the block runs, at a free port for 0; end its runs afterwards.

    Raises:
        InputError: the port is taken, or may not be used.
    """
    try:
        server = Server(port, desk)
    except OSError as error:
        raise InputError(
            f"--port {port}: cannot be used ({error.strerror}); choose another one, or leave it out"
            " for one that is free."
        ) from error
    thread = threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
        desk.close()


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "psa", ""
    timeout = _SILENT_S

    def log_message(self, format: str, *args: Any) -> None:
        """Write no log: addresses have the token."""

    def do_GET(self) -> None:
        self._guarded(self._get)

    def do_POST(self) -> None:
        self._guarded(self._post)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Answer a request, also one that nobody has thought of."""
        if "Transfer-Encoding" in self.headers or (
            self.command == "GET" and "Content-Length" in self.headers
        ):
            self.close_connection = True  # a body that nobody reads is no request
        try:
            work()
        except BusyError:
            self._refuse(HTTPStatus.CONFLICT, BUSY)
        except InputError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        except MachineError as error:
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        except TimeoutError:
            self._refuse(HTTPStatus.REQUEST_TIMEOUT, "The request did not arrive whole.")
        except Exception:  # noqa: BLE001 - whatever it holds, it is not what the page asks
            self._refuse(HTTPStatus.BAD_REQUEST, "The request is not understood.")

    def _get(self) -> None:
        parts = urlsplit(self.path)
        asked = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        refused = self.server.gate.refused("GET", dict(self.headers))
        if refused is not None:
            self._refuse(*refused)
        elif parts.path == "/" and self.server.gate.opens(asked.get("token", "")):
            self._send(_DOOR, _HTML, {"Set-Cookie": self.server.gate.cookie, **PAGE_POLICY})
        elif not self.server.gate.knows(dict(self.headers)):
            self._refuse(
                HTTPStatus.FORBIDDEN,
                "Open the address that the command `psa web --diagnose` has printed.",
            )
        elif parts.path == "/":
            self._send(page(self.server.desk.effects), _HTML, PAGE_POLICY)
        elif parts.path == "/state":
            known = (_whole(asked, name) for name in ("version", "run", "seen"))
            told = self.server.desk.state(*known)
            self._send(json.dumps(told), _JSON)
        elif parts.path == "/report":
            self._send_file("report.html", REPORT_POLICY)
        elif parts.path.startswith("/files/"):
            name = unquote(parts.path.removeprefix("/files/"))
            self._send_file(name, {"Content-Disposition": f'attachment; filename="{name}"'})
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "There is nothing here.")

    def _post(self) -> None:
        gate, size = self.server.gate, self.headers.get("Content-Length", "")
        refused = gate.refused("POST", dict(self.headers))
        if refused is None and not gate.knows(dict(self.headers)):
            refused = HTTPStatus.FORBIDDEN, "Only the page itself may ask for this."
        if refused is None and (not size.isascii() or not size.isdecimal()):
            refused = HTTPStatus.LENGTH_REQUIRED, "The request does not say how long it is."
        if refused is not None:
            self._refuse(*refused)
            return
        self._do(urlsplit(self.path).path, int(size))

    def _do(self, path: str, size: int) -> None:
        desk = self.server.desk
        if path == "/files":
            if size > desk.limits.one:
                self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "The file is larger than may be.")
                return
            # what is not read to its end must not be taken for the next request
            self.close_connection = True
            desk.add(unquote(self.headers.get("X-Name", "")), self.rfile, size)
            self.close_connection = False
        else:
            if size > _MOST_ASKED:
                self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "The request is too long.")
                return
            given = _object(self.rfile.read(size))
            acts: dict[str, Callable[[], None]] = {
                "/remove": lambda: desk.remove(_whole(given, "key")),
                "/hold": lambda: desk.hold(_whole(given, "key"), given.get("held") is True),
                "/settings": lambda: desk.set(given),
                "/start": desk.start,
                "/stop": desk.stop,
                "/export": desk.export,
            }
            if path not in acts:
                self._refuse(HTTPStatus.NOT_FOUND, "There is nothing here.")
                return
            acts[path]()
        self._send("{}", _JSON)

    def _send(self, text: str, kind: str, more: dict[str, str] | None = None) -> None:
        self._answer(HTTPStatus.OK, text.encode(), kind, more or {})

    def _send_file(self, name: str, more: dict[str, str]) -> None:
        path = self.server.desk.result(name)
        content = None
        with contextlib.suppress(OSError):
            content = path.read_bytes() if path is not None else None
        if content is None:
            self._refuse(HTTPStatus.NOT_FOUND, "There is no such file.")
        else:
            kind = _KINDS.get(Path(name).suffix, "application/octet-stream")
            self._answer(HTTPStatus.OK, content, kind, more)

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.close_connection = True  # a body may be on its way that nobody reads
        self._answer(status, why.encode(), "text/plain; charset=utf-8", {"Connection": "close"})

    def _answer(self, status: HTTPStatus, data: bytes, kind: str, more: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {**_ALWAYS, "Content-Type": kind, **more}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


def _whole(given: dict[str, Any], name: str) -> int:
    text = str(given.get(name, ""))
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 10 else 0


def _object(data: bytes) -> dict[str, Any]:
    try:
        found = json.loads(data or b"{}")
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise InputError("The request is not understood.")
    return found
