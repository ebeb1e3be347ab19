"""Commands ended by a signal: whole files or none, nothing left behind, the right exit code."""

import json
import math
import os
import shutil
import signal
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

from psa_casadi.errors import PsaError
from psa_casadi.model.model_file import load_model
from tests.fuzz.commands import Around, Ended, left_files, misbehaved, psa
from tests.fuzz.target import HALF_WRITTEN, LEFT_OVER, WRONG_EXIT, Found, Target

ROOM = "kills"
_LIMIT_S = 300.0
#: How long the files that commands are given take to make [s].
_GIVEN_S = 3.0
_OLD = "what stood here before"


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
        ("simulate", "--model", "given.json", "--input", "small.csv", "-o", "o.csv"), ("o.csv",)
    ),
}  # fmt: skip
#: Time [s] in which Python starts, before the command can do anything about a signal.
_STARTING_S = 0.4
#: What is run after a kill, to see that it works and sweeps.
_AFTER = WORKS["export modelica"]
_CODES = {"SIGTERM": (0, 143), "SIGINT": (0, 130), "SIGKILL": (0, -9), "SIGHUP": (0, 129, -1)}


def small_record() -> str:
    """Return the text of a record that is fitted in a second."""
    rows = ["time [s],voltage [V],displacement [um]"]
    for k in range(400):
        turn = 0.016 * k
        rows.append(
            f"{0.002 * k:.4f},{50 - 50 * math.cos(turn):.4f},{5 - 5 * math.cos(turn - 0.1):.5f}"
        )
    return "\n".join(rows) + "\n"


@cache
def given_files() -> dict[str, bytes]:
    """Return the files that the commands are given."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "small.csv").write_text(small_record())
        fmu = ("export", "fmu", "--stack", "P-885.51", "-o", "s.fmu")
        for arguments in (fmu, ("identify", "small.csv", "-o", "given.json")):
            ended = psa(arguments, folder)
            if ended.code:
                raise RuntimeError(f"no file to begin with: {ended.err}")
        return {n: (folder / n).read_bytes() for n in ("small.csv", "s.fmu", "given.json")}


def given(folder: Path) -> None:
    """Put the files that the commands are given into a folder."""
    for name, content in given_files().items():
        (folder / name).write_bytes(content)


@cache
def _slowness() -> float:
    """Return how much longer this machine takes now than one that does nothing else."""
    begin = time.monotonic()
    given_files()
    return (time.monotonic() - begin) / _GIVEN_S


def _run(work: Work, folder: Path, stop: tuple[int, float] | None) -> Ended:
    around = Around({"PSA_CASADI_CACHE": str(folder / "cache")})
    return psa(work.arguments, folder, around, limit_s=_LIMIT_S, stop=stop)


def _case(rng: Random) -> bytes:
    case = {
        "command": rng.choice(
            ("identify", "diagnose", "diagnose", "export fmu", "check", "simulate")
        ),
        "signal": rng.choice(("SIGTERM", "SIGINT", "SIGKILL", "SIGTERM", "SIGINT", "SIGHUP")),
        "at": round(rng.uniform(0.02, 1.05), 3),  # share of the usual time
        "old": rng.random() < 0.5,
    }
    return json.dumps(case).encode()


def _kill(data: bytes, where: Path) -> Iterator[Found]:
    case = json.loads(data)
    folder = Path(tempfile.mkdtemp(dir=where))
    try:
        yield from _killed(case, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _killed(case: dict[str, object], folder: Path) -> Iterator[Found]:
    work, name = WORKS[str(case["command"])], str(case["signal"])
    given(folder)
    usual = work.usual_s * _slowness()
    for output in work.outputs:
        (folder / output).unlink(missing_ok=True)
        if case["old"]:
            (folder / output).write_text(_OLD)
    number, at = getattr(signal, name), float(str(case["at"])) * usual
    ended = _run(work, folder, (number, at))
    what = f"{case['command']} after {name}"
    begun = at > _STARTING_S * _slowness()  # before that Python itself is ended
    yield from misbehaved(ended, _CODES[name] if begun else (*_CODES[name], -int(number)), what)
    for output in work.outputs:
        if reason := not_whole(folder / output, missing=not case["old"] and ended.code != 0):
            yield Found(HALF_WRITTEN, f"{what}: {output} {reason}")
    if name == "SIGKILL":
        after = _run(_AFTER, folder, None)  # what a kill leaves may stay until the next command
        if after.code:
            yield Found(WRONG_EXIT, f"{what}: the next command fails: {after.err[-300:]}")
    yield from left_files(folder, what)
    yield from _beside(folder, work, what)


def _beside(folder: Path, work: Work, what: str) -> Iterator[Found]:
    """Yield files that are neither given nor written nor the cache's own."""
    known = {*given_files(), *work.outputs, *_AFTER.outputs, "out", "err", "tmp", "cache"}
    more = sorted(set(os.listdir(folder)) - known)
    if more:
        yield Found(LEFT_OVER, f"{what}: beside its outputs it leaves '{', '.join(more[:3])}'")
    cache_folder = folder / "cache" / "models"
    if cache_folder.is_dir() and (odd := [p.name for p in cache_folder.iterdir() if p.is_dir()]):
        yield Found(LEFT_OVER, f"{what}: folders of compilers in the cache: '{', '.join(odd[:3])}'")


def not_whole(path: Path, *, missing: bool) -> str:
    """Return what is wrong with an output: it is neither what stood there nor whole; else ""."""
    if not path.exists():
        return "" if missing else "is gone"
    if path.read_bytes() == _OLD.encode():
        return ""
    try:
        return _PARSERS[path.suffix](path)
    except (ValueError, OSError, PsaError, zipfile.BadZipFile) as error:
        return f"is not whole: {error}"


def _json(path: Path) -> str:
    tree = json.loads(path.read_text(encoding="utf-8"))
    if "model" in tree["format"]:
        load_model(path)
    return ""


def _text_ends(end: str) -> Callable[[Path], str]:
    def parse(path: Path) -> str:
        whole = path.read_text(encoding="utf-8").rstrip().endswith(end)
        return "" if whole else f"does not end with '{end}'"

    return parse


def _png(path: Path) -> str:
    data = path.read_bytes()
    return "" if data[:4] == b"\x89PNG" and data[-8:-4] == b"IEND" else "is no whole PNG"


def _zip(path: Path) -> str:
    with zipfile.ZipFile(path) as archive:
        bad = archive.testzip()
    return f"has a damaged entry {bad}" if bad else ""


def _csv(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").split("\n")
    return "" if len({line.count(",") for line in lines[:-1]}) == 1 and not lines[-1] else "is cut"


_PARSERS: dict[str, Callable[[Path], str]] = {
    ".json": _json, ".html": _text_ends("</html>"), ".png": _png, ".fmu": _zip, ".csv": _csv,
    ".mo": _text_ends(";"),
}  # fmt: skip

TARGETS = (Target("kills", ROOM, ".json", _case, _kill, 1.0, 4 * _LIMIT_S, None, _slowness),)
