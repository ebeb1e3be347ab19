"""The local page's rules: who may ask, how much is taken, one run at a time, an end for all."""

import base64
import http.client
import io
import json
import re
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

import psa_casadi as psa
from psa_casadi.cli import web
from psa_casadi.cli.inputs import Inputs
from psa_casadi.cli.workbench.desk import Desk, Limits, stored_name
from psa_casadi.cli.workbench.previews import Subject
from psa_casadi.cli.workbench.run import Run
from psa_casadi.cli.workbench.server import Server, served
from tests.contract.helpers import request
from tests.model.test_ode_model import RIPPLE, install
from tests.test_files import runs

SMALL = b"t (ms),U [V],pos\n" + b"".join(b"%d,%d,%d\n" % (k, k % 50, k % 50) for k in range(100))


class Tab:
    """A browser's tab, as the server sees it; `cookie` comes from the first page."""

    def __init__(self, server: Server) -> None:
        self.server, self.port = server, server.port
        self.cookie = ""

    def headers(self, method: str) -> dict[str, str]:
        table = {"Host": f"127.0.0.1:{self.port}", "Cookie": self.cookie}
        return table | ({"Origin": f"http://127.0.0.1:{self.port}"} if method == "POST" else {})

    def ask(
        self, method: str, path: str, body: Any = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        data = body if isinstance(body, bytes | None) else json.dumps(body).encode()
        sent = {n: v for n, v in {**self.headers(method), **headers}.items() if v}
        return request(f"127.0.0.1:{self.port}", method, path, data, **sent)

    def enter(self) -> "Tab":
        status, headers, _ = self.ask("GET", f"/?token={self.server.token}")
        assert status == 200
        assert "HttpOnly; SameSite=Strict" in headers["set-cookie"]
        self.cookie = headers["set-cookie"].split(";")[0]
        return self

    def post(self, path: str, body: Any = None, **headers: str) -> int:
        return self.ask("POST", path, {} if body is None else body, **headers)[0]

    def give(self, name: str, data: bytes) -> int:
        return self.post("/files", data, X_Name=quote(name))

    def state(self) -> dict[str, Any]:
        table: dict[str, Any] = json.loads(self.ask("GET", "/state")[2])
        return table

    def wait(
        self, there: Callable[[dict[str, Any]], object], limit_s: float = 60.0
    ) -> dict[str, Any]:
        value = time.monotonic()
        while time.monotonic() < value + limit_s:
            if there(state := self.state()):
                return state
            time.sleep(0.02)
        raise AssertionError(state)

    def until(self, status: str, limit_s: float = 60.0) -> dict[str, Any]:
        return self.wait(lambda state: state["run"]["status"] == status, limit_s)

    def searched(self) -> dict[str, Any]:
        table: dict[str, Any] = self.wait(lambda state: state["run"]["events"])["run"]
        return table


@pytest.fixture
def tab(tmp_path: Path) -> Iterator[Tab]:
    limits = Limits(one=5000, together=8000, files=3)
    desk = Desk(tmp_path, ["slow_creep"], limits=limits, module="tests.workbench.small_job")
    with served(0, desk) as server:
        yield Tab(server).enter()


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "psa.example:80"}, 421),
        ({"Host": "127.0.0.1"}, 421),
        ({"Origin": "http://psa.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": ""}, 403),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Sec_Fetch_Site": "same-site"}, 403),
    ],
)
def test_what_other_pages_cause_is_refused(tab: Tab, headers: dict[str, str], status: int) -> None:
    assert tab.post("/start", **headers) == status
    if "Origin" not in headers:
        assert tab.ask("GET", "/state", **headers)[0] == status


def test_a_file_is_read_and_its_columns_are_mapped(tab: Tab) -> None:
    assert tab.give("<img src=x onerror=alert(1)>.csv", SMALL) == 200
    item = tab.state()["items"][0]
    assert item["name"] == "<img src=x onerror=alert(1)>.csv"
    assert not set(item["stored"]) & set("<>=\"'/\\")
    observed = item["seen"]
    head = observed["head"]
    assert head["guess"] == {"time": [0, "ms"], "voltage": [1, "V"], "displacement": [2, "um"]}
    assert "'displacement' has no unit" in " ".join(observed["problems"])
    assert tab.post("/settings", {"columns": "displacement=pos:10um"}) == 200
    observed = tab.state()["items"][0]["seen"]
    assert observed["problems"] == []
    low, high, unit = observed["record"]["reached"]["displacement"]
    assert (low, high, unit) == (0.0, pytest.approx(49 * 10e-6), "m")
    assert base64.b64decode(observed["record"]["picture"]).startswith(b"\x89PNG")
    assert observed["record"]["seconds"] == pytest.approx(0.099)
    assert tab.post("/settings", {"columns": "displacement=pas:um"}) == 200
    assert "'pas'" in tab.state()["items"][0]["seen"]["problems"][0]


def test_too_much_is_refused(tab: Tab) -> None:
    assert tab.give("large.csv", b"x" * 5001) == 413
    assert tab.give("a.csv", SMALL[:900]) == 200
    assert tab.give("b.csv", b"a,\0" * 1250) == 200
    assert "binary" in tab.state()["items"][1]["seen"]["problems"][0]
    assert tab.give("c.csv", b"x" * 3500) == 400
    assert tab.give("d.csv", b"x") == 200
    assert tab.give("e.csv", b"x") == 400
    assert tab.post("/settings", b'{"columns": "' + b"x" * 2**16 + b'"}') == 413
    assert tab.post("/settings", {"stiffness": "-1"}) == 400
    assert tab.post("/settings", {"leave_out": ["--model"]}) == 400
    assert tab.post("/settings", b"[1") == 400
    assert [i["name"] for i in tab.state()["items"]] == ["a.csv", "b.csv", "d.csv"]


def test_a_second_tab_sees_the_same_run_and_starts_no_other(tab: Tab) -> None:
    assert tab.post("/start") == 400  # no record yet
    tab.give("a.csv", SMALL)
    tab.give("b.csv", SMALL)
    assert tab.post("/hold", {"key": 2, "held": True}) == 200
    assert tab.post("/settings", {"leave_out": ["slow_creep"], "hysteresis": "best"}) == 200
    other = Tab(tab.server).enter()
    assert tab.post("/start") == 200
    for refused in ("/start", "/export", "/remove", "/hold", "/settings"):
        assert other.post(refused, {"key": 1}) == 409
    assert other.give("c.csv", SMALL) == 409
    run = other.searched()
    assert run["number"] == 1
    assert run["events"][0]["causes"] == []
    assert "--holdout records/b.csv --hysteresis=best --leave-out=slow_creep -o" in run["command"]
    (tab.server.desk.folder / "let_go").touch()
    state = other.until("done")
    assert state["result"]["verdict"] == "adequate"
    assert set(state["files"]) == {"extended.json", "diagnosis.json", "report.html"}
    status, headers, _ = tab.ask("GET", "/report")
    assert status == 200
    assert headers["content-security-policy"].startswith("sandbox allow-scripts allow-downloads;")
    assert tab.ask("GET", "/files/extended.json")[0] == 200
    for name in ("a.csv", "events.jsonl", "..%2Fwords.txt", "words.txt"):
        assert tab.ask("GET", f"/files/{name}")[0] == 404, name
    assert tab.post("/export") == 200
    tab.wait(lambda state: "extended.fmu" in state["files"])
    assert tab.ask("GET", "/files/extended.fmu")[2] == b"PK"


def test_a_stopped_run_keeps_what_it_has_and_can_restart(tab: Tab) -> None:
    tab.give("a.csv", SMALL)
    tab.post("/start")
    tab.searched()
    assert tab.post("/stop") == 200
    state = tab.until("stopped")
    assert set(state["files"]) == {"extended.json"}
    assert state["run"]["messages"][-1] == "Interrupted: kept."
    assert tab.post("/start") == 200
    assert tab.until("running")["run"]["number"] == 2


def test_a_run_ends_with_the_server(tmp_path: Path) -> None:
    desk = Desk(tmp_path, [], module="tests.workbench.small_job")
    with served(0, desk) as server:
        tab = Tab(server).enter()
        tab.give("a.csv", SMALL)
        tab.post("/start")
        tab.until("running")
        tab.searched()
        pid = desk.running()[0].pid
        assert pid is not None
        assert runs(pid)
    assert not runs(pid)
    with pytest.raises(ConnectionError):
        tab.ask("GET", "/state")


@pytest.mark.parametrize(
    ("name", "stored"),
    [
        ("../../etc/passwd", "passwd"),
        ("C:\\data\\loop 1.csv", "loop 1.csv"),
        ("-o.csv", "o.csv"),
        ("", "record"),
        ("...", "record"),
        ("a\nb\x1b[2J.csv", "a_b__2J.csv"),
        ("taken.csv", "taken_2.csv"),
        ("x" * 300 + ".csv", "x" * 80 + ".csv"),
    ],
)
def test_a_stored_name_has_no_path_and_no_mark(name: str, stored: str) -> None:
    assert stored_name(name, ["Taken.csv"]) == stored


@pytest.mark.parametrize("name", ["extended_run.csv", "extended.json", "records", "report.html"])
def test_no_name_of_a_file_is_one_of_a_result(name: str, tab: Tab) -> None:
    desk = tab.server.desk
    if name != "records":
        (desk.folder / name).write_text("a result")
    assert tab.give(name, SMALL) == 200
    assert tab.give(name, SMALL) == 200
    stem, dot, ending = name.partition(".")
    assert [i["stored"] for i in tab.state()["items"]] == [name, f"{stem}_2{dot}{ending}"]
    if name != "records":
        assert (desk.folder / name).read_text() == "a result"


def test_what_is_promised_and_does_not_come_takes_no_room(tab: Tab) -> None:
    silent = []
    for _ in range(3):  # as many files as there may be, and more bytes
        line = http.client.HTTPConnection("127.0.0.1", tab.port, timeout=20)
        line.putrequest("POST", "/files", skip_host=True)
        for name, text in tab.headers("POST").items():
            line.putheader(name, text)
        line.putheader("Content-Length", "5000")
        line.endheaders()
        silent.append(line)
    time.sleep(0.2)
    assert tab.give("a.csv", b"x" * 4000) == 200
    for line in silent:
        line.close()


def test_what_arrives_takes_room(tmp_path: Path) -> None:
    desk = Desk(tmp_path, [], limits=Limits(one=5000, together=8000))

    class Slow(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            if self.tell():
                with pytest.raises(psa.InputError, match="with the other files"):
                    desk.add("second.csv", io.BytesIO(b"x" * 4000), 4000)
            return super().read(4500)

    desk.add("first.csv", Slow(b"x" * 5000), 5000)
    assert [p.name for p in (tmp_path / "records").iterdir()] == ["first.csv"]


@pytest.mark.parametrize(
    ("line", "body", "headers"),
    [
        ("GET http://[ HTTP/1.1", b"", {}),
        ("POST http://[ HTTP/1.1", b"", {}),
        ("GET /state HTTP/1.1", b"GET / HTTP/1.1\r\n\r\n", {"Host": "127.0.0.1"}),
        ("POST /start HTTP/1.1", b"", {"Content-Length": "9" * 5000}),
        ("POST /settings HTTP/1.1", b'{"leave_out": [[], 1]}', {}),
        ("POST /settings HTTP/1.1", b'{"columns": {"a": "\xff\xfe"}}', {}),
        ("POST /settings HTTP/1.1", b"5\r\nhello\r\n0\r\n\r\n", {"Content-Length": ""}),
        ("POST /hold HTTP/1.1", b"null", {}),
        ("PUT / HTTP/1.1", b"", {}),
        ("nonsense", b"", {}),
    ],
)
def test_every_request_is_answered(
    line: str, body: bytes, headers: dict[str, str], tab: Tab
) -> None:
    all_ = {**tab.headers("POST"), "Content-Length": str(len(body)), **headers}
    text = "".join(f"{n}: {t}\r\n" for n, t in all_.items())
    with socket.create_connection(("127.0.0.1", tab.port), timeout=20) as way:
        way.sendall(f"{line}\r\n{text}\r\n".encode() + body)
        answers = b"".join(iter(lambda: way.recv(65536), b""))
    assert len(re.findall(rb"HTTP/1.1 (4|501)|Error code: 400", answers)) == 1, answers
    assert tab.ask("GET", "/state")[0] == 200


def test_a_fault_of_the_page_is_an_answer(tab: Tab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tab.server.desk, "state", lambda *_: 1 / 0)
    assert tab.ask("GET", "/state")[0] == 400
    monkeypatch.setattr(tab.server.desk, "start", lambda: 1 / 0)
    assert tab.post("/start") == 400


def test_uploaded_files_run_in_no_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "desk"
    folder.mkdir()
    install(tmp_path / "site", "try:\n    import ruled\nexcept ImportError: pass\n" + RIPPLE)
    monkeypatch.syspath_prepend(tmp_path / "site")
    ran = tmp_path / "ran"
    desk = Desk(folder, [])
    for name in ("gratings", "ruled", "numpy", "matplotlibrc"):
        data = f"open({str(ran)!r}, 'w')".encode()
        desk.add(f"{name}.py", io.BytesIO(data), len(data))
    run = Run(["effects", "encoder_ripple", "--effects=gratings"], folder, lambda: None)
    while run.status == "running":
        time.sleep(0.05)
    assert (run.status, ran.exists()) == ("done", False), run.state()
    assert sorted(p.name for p in folder.iterdir()) == ["records"]


def test_commands_of_the_page_look_for_modules_where_they_were_named_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    there: list[list[str]] = []

    def no_server(port: int, desk: Desk) -> None:
        there.append([*sys.path])
        raise psa.InputError("no server")

    monkeypatch.setattr("psa_casadi.cli.workbench.server.served", no_server)
    (tmp_path / "gratings.py").write_text(RIPPLE)
    for first in ("", str(tmp_path)):
        for modules in ([], ["gratings"]):
            monkeypatch.setattr(sys, "path", [first, *sys.path])
            with pytest.raises(psa.InputError, match="no server"):
                web._serve(0, True, Subject(), Inputs(effects=modules))
            here = [k for k, p in enumerate(there[-1], 1) if p in ("", str(tmp_path))]
            assert here == ([len(there[-1])] if modules else [])
