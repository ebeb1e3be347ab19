"""The local page's server: this machine only, whoever has the address, nothing from outside."""

import contextlib
import hmac
import json
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

from markupsafe import Markup

from psa_casadi.cli.workbench.desk import BusyError, Desk
from psa_casadi.cli.workbench.previews import Subject
from psa_casadi.common.errors import InputError, MachineError
from psa_casadi.report.page.document import environment, script_hash, source
from psa_casadi.version import __version__

#: The name of the machine for itself, as addresses have it.
HOST = "127.0.0.1"
#: Sec-Fetch-Site of a request that the page itself, or no other page, has caused.
_SAME_SITE = ("same-origin", "none")
_PAGE_ALONE = "Only the page itself may ask for this."


_PAGE = files("psa_casadi.cli.workbench")
_STYLE = Markup(
    source("page.css") + source("live.css") + _PAGE.joinpath("workbench.css").read_text("utf-8")
)
_SCRIPT = Markup(
    "\n".join(
        _PAGE.joinpath(f"{name}.js").read_text("utf-8")
        for name in ("begin", "columns", "files", "search", "workbench")
    )
)
#: The page at the address with the token, and its only script: it leads to the page, which
#: asks for all that follows, so that the token is in no address.
_ENTER = "location.replace('/');"
_DOOR = (
    '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>Diagnose records</title>'
    f"</head><body><p><a href='/'>Open the page</a></p><script>{_ENTER}</script></body></html>\n"
)
#: What a browser must refuse: scripts and styles other than the page's, requests to others, a
#: frame around the page.
_PAGE_POLICY = {
    "Content-Security-Policy": (
        f"default-src 'none'; script-src {script_hash(_SCRIPT)} {script_hash(_ENTER)};"
        f" style-src {script_hash(_STYLE)}; img-src data:; connect-src 'self'; frame-src 'self';"
        " frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    )
}
#: A report is a separate page that runs its scripts and can reach nothing here, not even by the
#: cookie; in addition its policy holds.
_REPORT_POLICY = {
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


def page(effects: Sequence[str], subject: Subject) -> str:
    """Return the page; `effects` are those that a person may leave out of the search."""
    outputs = [subject.units[name] for name in subject.outputs]
    unit = "m" if not outputs else outputs[0] if len(outputs) == 1 else ""
    setup_data = {"effects": list(effects), "columns": subject.columns, "unit": unit}
    template = environment().from_string(_PAGE.joinpath("workbench.html").read_text("utf-8"))
    setup = Markup(json.dumps(setup_data).replace("<", "\\u003c"))
    return template.render(
        style=_STYLE, script=_SCRIPT, version=__version__, setup=setup, stack=not outputs
    )


class Server(ThreadingHTTPServer):
    """Serves one desk at one port to who has the address; each request has its thread.

    A token in the address opens the page, then a cookie does. The cookie is no part of an address,
    no script can read it, and a browser sends it with nothing that another site has caused. The
    names of the machine are a fixed list, so that a name of somebody else which leads to this
    machine (DNS rebinding) opens nothing.
    """

    daemon_threads = True

    def __init__(self, port: int, desk: Desk) -> None:
        super().__init__((HOST, port), _Handler)
        self.desk, self.port = desk, self.server_address[1]
        self.token, self.session = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
        self.cookie = f"psa_{self.port}"  # browsers have one set of cookies for all ports

    @property
    def address(self) -> str:
        """The address that opens the page."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

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


class _RefusedError(Exception):
    """A request that is not answered as it asks: the status, and why."""

    def __init__(self, status: HTTPStatus, why: str) -> None:
        super().__init__(why)
        self.status = status


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
            self._look_at_origin()
            work()
        except _RefusedError as refused:
            self._refuse(refused.status, str(refused))
        except BusyError as error:
            self._refuse(HTTPStatus.CONFLICT, str(error))
        except InputError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        except MachineError as error:
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        except TimeoutError:
            self._refuse(HTTPStatus.REQUEST_TIMEOUT, "The request did not arrive whole.")
        except Exception:  # noqa: BLE001 - whatever it holds, it is not what the page asks
            self._refuse(HTTPStatus.BAD_REQUEST, "The request is not understood.")

    def _look_at_origin(self) -> None:
        """Refuse what goes to another name of the machine or comes from another page."""
        host = self.headers.get("Host", "")
        if host not in [f"{name}:{self.server.port}" for name in (HOST, "localhost")]:
            raise _RefusedError(HTTPStatus.MISDIRECTED_REQUEST, "This page has another address.")
        if self.command == "POST" and self.headers.get("Origin", "") != f"http://{host}":
            raise _RefusedError(HTTPStatus.FORBIDDEN, _PAGE_ALONE)

    def _look_at_cookie(self, why: str) -> None:
        """Refuse what has not the cookie, or is caused by another site."""
        cookie = None
        if self.headers.get("Sec-Fetch-Site", "none") in _SAME_SITE:
            with contextlib.suppress(CookieError):
                cookie = SimpleCookie(self.headers.get("Cookie", "")).get(self.server.cookie)
        if cookie is None or not _same(cookie.value, self.server.session):
            raise _RefusedError(HTTPStatus.FORBIDDEN, why)

    def _get(self) -> None:
        parts = urlsplit(self.path)
        table = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        server = self.server
        if parts.path == "/" and _same(table.get("token", ""), server.token):
            cookie = f"{server.cookie}={server.session}; HttpOnly; SameSite=Strict; Path=/"
            self._answer(_DOOR.encode(), _HTML, {"Set-Cookie": cookie, **_PAGE_POLICY})
            return
        self._look_at_cookie("Open the address that the command `psa web --diagnose` has printed.")
        if parts.path == "/":
            content = page(server.desk.effects, server.desk.subject)
            self._answer(content.encode(), _HTML, _PAGE_POLICY)
        elif parts.path == "/state":
            known = (_whole(table, name) for name in ("version", "run", "seen"))
            self._answer(json.dumps(server.desk.state(*known)).encode(), _JSON)
        elif parts.path == "/report":
            self._send_file("report.html", _REPORT_POLICY)
        elif parts.path.startswith("/files/"):
            name = unquote(parts.path.removeprefix("/files/"))
            self._send_file(name, {"Content-Disposition": f'attachment; filename="{name}"'})
        else:
            raise _RefusedError(HTTPStatus.NOT_FOUND, "There is nothing here.")

    def _post(self) -> None:
        self._look_at_cookie(_PAGE_ALONE)
        path, desk = urlsplit(self.path).path, self.server.desk
        length = self.headers.get("Content-Length", "")
        if not length.isascii() or not length.isdecimal():
            raise _RefusedError(
                HTTPStatus.LENGTH_REQUIRED, "The request does not say how long it is."
            )
        size = int(length)
        if size > (desk.limits.one if path == "/files" else _MOST_ASKED):
            what = "file is larger than may be" if path == "/files" else "request is too long"
            raise _RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"The {what}.")
        if path == "/files":
            # what is not read to its end must not be taken for the next request
            self.close_connection = True
            desk.add(unquote(self.headers.get("X-Name", "")), self.rfile, size)
            self.close_connection = False
        else:
            content: Any = None
            with contextlib.suppress(ValueError, RecursionError):
                content = json.loads(self.rfile.read(size) or b"{}")
            if not isinstance(content, dict):
                raise InputError("The request is not understood.")
            acts: dict[str, Callable[[], None]] = {
                "/remove": lambda: desk.remove(_whole(content, "key")),
                "/hold": lambda: desk.hold(_whole(content, "key"), content.get("held") is True),
                "/settings": lambda: desk.set(content),
                "/start": desk.start,
                "/stop": desk.stop,
                "/export": desk.export,
            }
            if path not in acts:
                raise _RefusedError(HTTPStatus.NOT_FOUND, "There is nothing here.")
            acts[path]()
        self._answer(b"{}", _JSON)

    def _send_file(self, name: str, more: dict[str, str]) -> None:
        path = self.server.desk.result(name)
        try:
            content = path.read_bytes() if path is not None else None
        except OSError:
            content = None
        if content is None:
            raise _RefusedError(HTTPStatus.NOT_FOUND, "There is no such file.")
        self._answer(content, _KINDS.get(Path(name).suffix, "application/octet-stream"), more)

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.close_connection = True  # a body may be on its way that nobody reads
        kind = "text/plain; charset=utf-8"
        self._answer(why.encode(), kind, {"Connection": "close"}, status)

    def _answer(
        self,
        data: bytes,
        kind: str,
        more: Mapping[str, str] | None = None,
        status: HTTPStatus = HTTPStatus.OK,
    ) -> None:
        self.send_response(status)
        for name, value in {**_ALWAYS, "Content-Type": kind, **(more or {})}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


def _same(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())


def _whole(table: Mapping[str, Any], name: str) -> int:
    text = str(table.get(name, ""))
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 10 else 0
