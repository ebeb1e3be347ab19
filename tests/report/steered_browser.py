"""Headless Chromium that a test steers: files chosen, keys pressed, a page watched for minutes.

It speaks the DevTools protocol over two pipes, which needs no further package.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tests.report.browser import Browser

#: Starts a program with two descriptors as its third and fourth, where the browser looks for them.
_AS_3_AND_4 = (
    "import fcntl, os, sys; a, b = (fcntl.fcntl(int(n), fcntl.F_DUPFD, 20) for n in sys.argv[1:3]);"
    " os.dup2(a, 3); os.dup2(b, 4); os.execv(sys.argv[3], sys.argv[3:])"
)


class RefusedError(Exception):
    """The browser does not do what is requested, as where a page has just gone."""


class Steered:
    """One tab; `heard` are the events that it has reported: requests, messages on the console."""

    def __init__(self, read: int, write: int) -> None:
        self._read, self._write, self._rest, self._count = read, write, b"", 0
        self.heard: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)
        for room in ("Page", "Network", "Runtime", "Log", "DOM"):
            self.call(f"{room}.enable")

    _session: dict[str, str] | None = None

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._count += 1
        table = {"id": self._count, "method": method, "params": params, **(self._session or {})}
        os.write(self._write, json.dumps(table).encode() + b"\0")
        while True:
            output = self._next()
            if output.get("id") == self._count:
                if "error" in output:
                    raise RefusedError(output["error"])
                result: dict[str, Any] = output["result"]
                return result
            self.heard.append(output)

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            block = os.read(self._read, 2**16)
            assert block, "the browser has gone"
            self._rest += block
        row, self._rest = self._rest.split(b"\0", 1)
        table: dict[str, Any] = json.loads(row)
        return table

    def run(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, script: str, limit: float = 20.0) -> None:
        """Wait until an expression is true in the page."""
        end, result = time.monotonic() + limit, False
        while not result:
            with suppress(RefusedError):
                result = self.run(f"Boolean({script})")
            if not result:
                assert time.monotonic() < end, (script, self.run("document.body.innerText"))
                time.sleep(0.1)

    def choose(self, selector: str, *paths: Path) -> None:
        """Choose files in an input of the page."""
        self.until(f"document.readyState === 'complete' && document.querySelector('{selector}')")
        find = f"document.querySelector('{selector}')"
        node = self.call("Runtime.evaluate", expression=find)["result"]["objectId"]
        self.call("DOM.setFileInputFiles", objectId=node, files=[str(p) for p in paths])

    def press(self, key: str, code: int, text: str = "") -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            more = {"text": text} if text and kind == "keyDown" else {}
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key,
                      windowsVirtualKeyCode=code, **more)  # fmt: skip


@contextmanager
def steered(browser: Browser) -> Iterator[Steered]:
    """Start the browser with a tab, and end it afterwards."""
    ours_in, theirs_out = os.pipe()
    theirs_in, ours_out = os.pipe()
    command = [
        sys.executable, "-c", _AS_3_AND_4, str(theirs_in), str(theirs_out), browser.path,
        "--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe",
        "--no-first-run", f"--user-data-dir={browser.folder / 'steered'}",
    ]  # fmt: skip
    process = subprocess.Popen(command, pass_fds=(theirs_in, theirs_out), stderr=subprocess.DEVNULL)
    os.close(theirs_in)
    os.close(theirs_out)
    try:
        yield Steered(ours_in, ours_out)
    finally:
        process.kill()
        process.wait()
        os.close(ours_in)
        os.close(ours_out)
