"""The command in this process, its page, and records of an independent stack."""

import http.client
import io
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from contextvars import copy_context
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.cli import main
from psa_casadi.common.units import FloatArray

Floats = FloatArray
DATA = Path(psa.__file__).parent / "data"
#: The command as a process.
PSA = [sys.executable, "-m", "psa_casadi.cli"]
SIGNALS = [getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n)]


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code and output."""

    code: int
    out: str
    err: str

    @property
    def words(self) -> str:
        """The whole output, with single spaces."""
        return " ".join((self.out + " " + self.err).split())


def command(*words: str | Path) -> Ended:
    """Run `psa` in this process."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with _restored_process(["psa", *map(str, words)]), redirect_stdout(out), redirect_stderr(err):
        try:
            copy_context().run(main)  # which keeps what was typed
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else int(bool(ended.code))
    return Ended(code, out.getvalue(), err.getvalue())


@contextmanager
def _restored_process(argv: list[str]) -> Iterator[None]:
    """Put back what a command changes of its process."""
    before, folder, kept = sys.argv, tempfile.tempdir, os.environ.get("TMPDIR")
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    sys.argv = argv
    try:
        with patch.object(os, "_exit", sys.exit):  # as a command that was interrupted ends
            yield
    finally:
        sys.argv, tempfile.tempdir = before, folder
        for number, handler in handlers.items():
            signal.signal(number, handler)
        os.environ.pop("TMPDIR", None)
        if kept is not None:
            os.environ["TMPDIR"] = kept


def done(*words: str | Path) -> Ended:
    """Run a command that must work."""
    ended = command(*words)
    assert ended.code == 0, ended.words
    assert "Traceback" not in ended.words
    return ended


def refused(*words: str | Path, code: int = 2, folder: Path | None = None) -> str:
    """Run a command that must fail without a traceback and leave a folder unchanged."""
    before = _content(folder)
    ended = command(*words)
    assert ended.code == code, ended.words
    assert ended.out == ""
    assert "Traceback" not in ended.err
    assert _content(folder) == before
    return " ".join(ended.err.split())


def _content(folder: Path | None) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} if folder else {}


def table(path: Path) -> dict[str, Floats]:
    """Read a CSV file by plain means: every column by its header."""
    head, *rows = path.read_text("utf-8").splitlines()
    columns = zip(*(row.split(",") for row in rows), strict=True)
    return {
        name: np.array([float(x) if x else np.nan for x in column])
        for name, column in zip(head.replace('"', "").split(","), columns, strict=True)
    }


def rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def off(result: Floats, expected: Floats) -> float:
    """Return the largest difference over the range."""
    return float(np.max(np.abs(result - expected)) / np.ptp(expected))


def samples(**columns: Any) -> Any:
    """Return columns (n,) as the structured array that fmpy takes as input; the first is time."""
    rows = list(zip(*columns.values(), strict=True))
    return np.array(rows, [(name, float) for name in columns])


def write(path: Path, columns: dict[str, Floats]) -> Path:
    """Write a CSV file by plain means."""
    lines = [",".join(columns)]
    lines += [",".join(f"{x:.12g}" for x in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@cache
def reference_run(
    stack: str = "P-885.51", stop: float = 0.06, samples: int = 301
) -> tuple[Floats, Floats, reference.Trajectory]:
    """Return times, a voltage of loops that shrink, and what the independent model makes of it."""
    values = psa.stack_model(stack).values
    time = np.linspace(0.0, stop, samples)
    swing = np.cos(4.0 * np.pi * time / stop) * (1.0 - 0.3 * time / stop)
    voltage = 0.4 * values["u_rated"] * (1.0 - swing)
    return time, voltage, on_reference(values, time, voltage)


def on_reference(values: Mapping[str, float], t: Floats, v: Floats) -> reference.Trajectory:
    """Return the run of the independent model under a voltage that is linear between samples."""
    return reference.simulate(values, reference.from_samples(t, v), t, breakpoints=list(t))


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, str]]:
    """Serve the page that diagnoses; yield host and port, and the token in its address.

    It works in a folder, of which nothing is left when it is interrupted.
    """
    running = subprocess.Popen(
        [*PSA, "web", "--diagnose", "--no-browser"], cwd=folder, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1", "TMPDIR": str(folder)},
    )  # fmt: skip
    assert running.stdout is not None
    try:
        pattern = re.compile(r"http://(127\.0\.0\.1:\d+)/\?token=(\S+)")
        address = next(filter(None, map(pattern.search, running.stdout)), None)
        assert address, "no address was printed"
        yield address[1], address[2]
    finally:
        running.send_signal(signal.SIGINT)
        output, _ = running.communicate(timeout=30)
    assert (running.returncode, "Ended" in output) == (0, True), output
    assert list(folder.iterdir()) == []


def request(
    place: str, method: str, path: str, body: bytes | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    line = http.client.HTTPConnection(place, timeout=30)
    try:
        line.request(method, path, body, {n.replace("_", "-"): v for n, v in headers.items()})
        answer = line.getresponse()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    finally:
        line.close()
