"""Commands that run on small files, and are ended by a signal: what they leave and say.

Outputs are old, whole or none; nothing stays behind; the exit code is right.
"""

import contextlib
import ctypes
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from random import Random

from psa_casadi.common.errors import PsaError
from psa_casadi.export.importer.fmu_model import load_model
from tests.studies.fuzz.campaign import (
    CRASH,
    FOREIGN,
    HALF_WRITTEN,
    HANG,
    LEFT_OVER,
    WRONG_EXIT,
    Finding,
    Target,
)

#: How long a command may take [s].
LIMIT_S = 300.0
#: Root of the checkout, from which the package can be imported.
_ROOT = Path(__file__).resolve().parents[3]
LIBC = ctypes.CDLL(None)
_END_WITH_PARENT = 1  # of Linux's prctl
_COMPILERS_OWN = Path(os.environ.get("PSA_CASADI_CACHE", Path.home() / ".cache/psa_casadi")) / "zig"
_FAULTS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL, signal.SIGFPE)
_OLD = "what stood here before"


@dataclass(frozen=True)
class Ended:
    """How a command ended; `hung` where it had to be killed, `left` its processes that go on."""

    code: int
    out: str
    err: str
    hung: bool
    left: tuple[int, ...]


@dataclass(frozen=True)
class Around:
    """Surroundings of a command: changes of the environment (None removes), and how it starts.

    `first` runs in the process before the command; `streams` replace standard input, output and
    error.
    """

    environment: Mapping[str, str | None] = field(default_factory=dict)
    first: Callable[[], None] = lambda: None
    streams: Mapping[str, int] = field(default_factory=dict)


def psa(
    arguments: Sequence[str | Path],
    folder: Path,
    around: Around = Around(),
    stop: tuple[int, float] | None = None,
) -> Ended:
    """Run a command with `folder/tmp` for what is temporary; `stop` is a signal and when [s]."""
    (folder / "tmp").mkdir(exist_ok=True)

    def begin() -> None:
        if sys.platform.startswith("linux"):
            LIBC.prctl(_END_WITH_PARENT, signal.SIGKILL, 0, 0, 0)
        around.first()

    hung = False
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        streams = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": err, **around.streams}
        running = subprocess.Popen(
            [sys.executable, "-m", "psa_casadi.cli", *map(str, arguments)],
            env=environment(folder, around), cwd=folder, start_new_session=True,
            preexec_fn=begin, **streams,  # type: ignore[call-overload]  # noqa: PLW1509
        )  # fmt: skip
        if stop is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                running.wait(stop[1])
            if running.returncode is None:
                running.send_signal(stop[0])
        try:
            running.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            hung = True
    for _ in range(20):  # what ends with its parent needs a moment
        if hung or not (left := _session(running.pid)):
            break
        time.sleep(0.05)
    left = _session(running.pid)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(running.pid, signal.SIGKILL)
    running.wait()
    out_text, err_text = (
        (folder / n).read_text(encoding="utf-8", errors="replace") for n in ("out", "err")
    )
    return Ended(running.returncode, out_text, err_text, hung, left)


def environment(folder: Path, around: Around) -> dict[str, str]:
    table: dict[str, str | None] = {
        **os.environ,
        "TMPDIR": str(folder / "tmp"),
        "PYTHONPATH": str(_ROOT),
        "OPENBLAS_NUM_THREADS": "1",
        "PSA_CASADI_CACHE": str(folder / "cache"),
        # what the compiler keeps for itself is not made anew for each empty cache
        "ZIG_GLOBAL_CACHE_DIR": str(_COMPILERS_OWN),
        **around.environment,
    }
    return {name: value for name, value in table.items() if value is not None}


def _session(number: int) -> tuple[int, ...]:
    """Return the processes of a session that still run, where they can be listed."""
    numbers = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            words = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            if int(words[3]) == number and words[0] != "Z":
                numbers.append(int(entry.name))
    return tuple(numbers)


def misbehaved(
    ended: Ended, codes: Sequence[int], what: str, *, mute: bool = False
) -> Iterator[Finding]:
    """Yield what is wrong with an end: exit code, traceback, blame of the package, no reason.

    A `mute` process has no stream for a reason.
    """
    last = " ".join(ended.err.strip().rpartition("\n")[2].split())[:300] or "no message"
    if ended.hung:
        yield Finding(HANG, f"{what}: no end within the limit")
        return
    if "Traceback" in ended.err or "Traceback" in ended.out:
        yield Finding(FOREIGN, f"{what}: a traceback: {last}")
    elif "fault of psa_casadi" in ended.err:
        yield Finding(FOREIGN, f"{what}: it blames itself: {last}")
    elif ended.code not in codes:
        kind = CRASH if -ended.code in _FAULTS else WRONG_EXIT
        yield Finding(kind, f"{what}: exit code {ended.code}: {last}")
    elif 0 < ended.code < 128 and not mute and not ended.err.strip() and not ended.out.strip():
        yield Finding(WRONG_EXIT, f"{what}: exit code {ended.code} without a word")
    if ended.left:
        yield Finding(LEFT_OVER, f"{what}: {len(ended.left)} processes go on")


def left_files(folder: Path, what: str) -> Iterator[Finding]:
    """Yield what is left in the temporary folder."""
    if names := sorted(os.listdir(folder / "tmp")):
        yield Finding(LEFT_OVER, f"{what}: {len(names)} left in TMPDIR: {', '.join(names[:3])}")


@dataclass(frozen=True)
class Work:
    """A command on small files: its outputs, and how long it takes with an empty cache [s]."""

    arguments: tuple[str, ...]
    outputs: tuple[str, ...]
    usual_s: float = 1.0


WORKS: Mapping[str, Work] = {
    "identify": Work(
        ("identify", "small.csv", "-o", "m.json", "--report", "r.html"), ("m.json", "r.html"), 2.5
    ),
    "diagnose": Work(
        ("diagnose", "small.csv", "-o", "e.json", "--json", "d.json", "--report", "r.html",
         "--figure", "f.png"),
        ("e.json", "d.json", "r.html", "f.png"),
        4.5,
    ),
    "export fmu": Work(("export", "fmu", "--stack", "PTBS200", "-o", "x.fmu"), ("x.fmu",), 1.5),
    "export modelica": Work(
        ("export", "modelica", "--stack", "PTBS200", "-o", "x.mo"), ("x.mo",)
    ),
    "check": Work(("check", "s.fmu"), (), 2.5),
    "simulate": Work(
        ("simulate", "--model", "model.json", "--input", "small.csv", "-o", "o.csv"), ("o.csv",)
    ),
}  # fmt: skip


@cache
def input_files() -> dict[str, bytes]:
    """Return the files that the commands read; the record is fitted in a second."""
    rows = ["time [s],voltage [V],displacement [um]"]
    for k in range(400):
        u, y = 50 - 50 * math.cos(0.016 * k), 5 - 5 * math.cos(0.016 * k - 0.1)
        rows.append(f"{0.002 * k:.4f},{u:.4f},{y:.5f}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "small.csv").write_text("\n".join(rows) + "\n")
        fmu = ("export", "fmu", "--stack", "P-885.51", "-o", "s.fmu")
        for arguments in (fmu, ("identify", "small.csv", "-o", "model.json")):
            if (ended := psa(arguments, folder)).code:
                raise RuntimeError(f"no file to begin with: {ended.err}")
        return {n: (folder / n).read_bytes() for n in ("small.csv", "s.fmu", "model.json")}


@contextmanager
def place(where: Path) -> Iterator[Path]:
    """Yield a folder with the files of `input_files`, which anybody may write to, and remove it."""
    where.parent.chmod(0o755)
    where.chmod(0o777)
    folder = Path(tempfile.mkdtemp(dir=where))
    (folder / "tmp").mkdir()
    for name, content in input_files().items():
        (folder / name).write_bytes(content)
    for path in (folder, folder / "tmp"):
        path.chmod(0o777)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-q", str(folder / "place")], capture_output=True, check=False)
        shutil.rmtree(folder, ignore_errors=True)


def half_written(folder: Path, work: Work, what: str, *, may_miss: bool) -> Iterator[Finding]:
    for output in work.outputs:
        if reason := _not_whole(folder / output, may_miss=may_miss):
            yield Finding(HALF_WRITTEN, f"{what}: {output} {reason}")


def _not_whole(path: Path, *, may_miss: bool) -> str:
    """Return what is wrong with an output: it is neither what stood there nor whole; else ""."""
    if not path.exists():
        return "" if may_miss else "is gone"
    data = path.read_bytes()
    if data == _OLD.encode():
        return ""
    try:
        match path.suffix:
            case ".json":
                whole = bool(json.loads(data)["format"])
                if "model" in json.loads(data)["format"]:
                    load_model(path)
            case ".fmu":
                with zipfile.ZipFile(path) as archive:
                    whole = archive.testzip() is None
            case ".csv":
                whole = (
                    data.endswith(b"\n") and len({r.count(b",") for r in data.splitlines()}) == 1
                )
            case ".png":
                whole = data[:4] == b"\x89PNG" and data[-8:-4] == b"IEND"
            case _:
                whole = data.rstrip().endswith((b"</html>", b";"))
    except (ValueError, OSError, PsaError, zipfile.BadZipFile) as error:
        return f"is not whole: {error}"
    return "" if whole else "is cut off"


#: Time [s] in which Python starts, before the command can do anything about a signal.
_STARTING_S = 0.4
_CODES = {"SIGTERM": (0, 143), "SIGINT": (0, 130), "SIGKILL": (0, -9), "SIGHUP": (0, 129, -1)}


@cache
def _slowness() -> float:
    """Return the present slowdown of this machine, relative to an idle one."""
    begin = time.monotonic()
    input_files()
    return (time.monotonic() - begin) / 3.0


def _kill_case(rng: Random) -> bytes:
    runs = ("identify", "diagnose", "diagnose", "export fmu", "check", "simulate")
    case = {
        "command": rng.choice(runs),
        "signal": rng.choice(("SIGTERM", "SIGINT", "SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")),
        "at": round(rng.uniform(0.02, 1.05), 3),  # share of the usual time
        "old": rng.random() < 0.5,
    }
    return json.dumps(case).encode()


def _kill(data: bytes, where: Path) -> Iterator[Finding]:
    """End a command: its files are whole or none, and nothing is left."""
    case = json.loads(data)
    work, name = WORKS[case["command"]], case["signal"]
    number, at = int(getattr(signal, name)), case["at"] * work.usual_s * _slowness()
    with place(where) as folder:
        for output in work.outputs if case["old"] else ():
            (folder / output).write_text(_OLD)
        ended = psa(work.arguments, folder, stop=(number, at))
        what = f"{case['command']} after {name}"
        started = at > _STARTING_S * _slowness()  # before that Python itself is ended
        yield from misbehaved(ended, _CODES[name] + (() if started else (-number,)), what)
        yield from half_written(folder, work, what, may_miss=not case["old"] and ended.code != 0)
        after = WORKS["export modelica"]
        if name == "SIGKILL" and (then := psa(after.arguments, folder)).code:
            yield Finding(WRONG_EXIT, f"{what}: the next command fails: {then.err[-300:]}")
        yield from left_files(folder, what)
        known = {*input_files(), *work.outputs, *after.outputs, "out", "err", "tmp", "cache"}
        others = {*os.listdir(folder)} - known
        others |= {p.name for p in folder.glob("cache/models/*") if p.is_dir()}
        if others:
            yield Finding(LEFT_OVER, f"{what}: it leaves '{', '.join(sorted(others)[:3])}'")


TARGETS = (Target("kills", "kills", ".json", _kill_case, _kill, 1.0, 4 * LIMIT_S, None, _slowness),)
