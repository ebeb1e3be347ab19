"""Commands in odd surroundings, by a user who may not do everything; twenty commands at once."""

import ctypes
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from tests.fuzz.commands import Around, Ended, misbehaved, psa
from tests.fuzz.kills import WORKS, given, given_files, not_whole
from tests.fuzz.surroundings import SURROUNDINGS, Surroundings
from tests.fuzz.target import HALF_WRITTEN, LEFT_OVER, WRONG_EXIT, Draw, Found, Target

ROOM = "environments"
_LIMIT_S = 300.0
#: What lets root write where nobody may: a command has it not. (Linux: prctl and capabilities.)
_DROP, _ALL_FILES, _READ_ALL, _OWNER, _ALL_RESOURCES = 24, 1, 2, 3, 24
#: What is run; the first needs a compiler, a cache and a temporary folder, and so does the second.
_RUNS = ("simulate", "export fmu", "identify", "check")
_LIBC = ctypes.CDLL(None)


def _case(rng: Draw) -> bytes:
    names = list(SURROUNDINGS)
    turn = rng.turn // len(names) + rng.turn % len(names) * (rng.turn >= len(names))
    run = _RUNS[turn % len(_RUNS)]
    return json.dumps({"surroundings": names[rng.turn % len(names)], "run": run}).encode()


def _surround(data: bytes, where: Path) -> Iterator[Found]:
    case = json.loads(data)
    chosen = SURROUNDINGS[case["surroundings"]]
    where.parent.chmod(0o755)
    where.chmod(0o777)
    folder = Path(tempfile.mkdtemp(dir=where))
    try:
        yield from _surrounded(chosen, case, folder)
    finally:
        subprocess.run(["umount", "-q", str(folder / "place")], capture_output=True, check=False)
        shutil.rmtree(folder, ignore_errors=True)


def _surrounded(chosen: Surroundings, case: dict[str, str], folder: Path) -> Iterator[Found]:
    folder.chmod(0o777)
    given(folder)
    for name in given_files():
        (folder / name).chmod(0o644)
    (folder / "tmp").mkdir()
    (folder / "tmp").chmod(0o777)
    around = chosen.prepare(folder)
    work, what = WORKS[case["run"]], f"{case['surroundings']}: psa {case['run']}"
    ended = _run(work.arguments, work.outputs, folder, chosen.output, around)
    for stream in around.streams.values():
        os.close(stream)
    mute = "stderr" in around.streams
    yield from misbehaved(ended, (0, 1, 2) if chosen.words else (0,), what, mute=mute)
    said = (ended.err + ended.out).lower()
    if ended.code in (1, 2) and not any(word in said for word in chosen.words):
        tail = " ".join(ended.err.split())[-200:]
        yield Found(WRONG_EXIT, f"{what}: the failure does not name its cause: {tail}")
    for output in work.outputs:
        if reason := not_whole(folder / chosen.output / output, missing=ended.code != 0):
            yield Found(HALF_WRITTEN, f"{what}: {output} {reason}")
    left = [p.name for p in (folder / "tmp").iterdir()]
    if left:
        yield Found(LEFT_OVER, f"{what}: {len(left)} left in TMPDIR: {', '.join(left[:3])}")


def _run(
    arguments: tuple[str, ...], outputs: tuple[str, ...], folder: Path, where: str, around: Around
) -> Ended:
    """Run a command as a user without rights, with all files named by their whole paths."""
    files = {*given_files(), *outputs}
    named = [
        str(folder / (where if a in outputs else "") / a) if a in files else a for a in arguments
    ]
    first = around.first

    def as_anybody() -> None:
        if not os.geteuid():
            for right in (_ALL_FILES, _READ_ALL, _OWNER, _ALL_RESOURCES):
                _LIBC.prctl(_DROP, right, 0, 0, 0)
        if first is not None:
            first()

    return psa(named, folder, replace(around, first=as_anybody), limit_s=_LIMIT_S)


def _many(data: bytes, where: Path) -> Iterator[Found]:
    """Run twenty commands at once on one empty cache; all give the same."""
    count = json.loads(data)["commands"]
    folder = Path(tempfile.mkdtemp(dir=where))
    try:
        given(folder)
        running = []
        for k in range(count):
            (folder / str(k)).mkdir()
            command = [
                *Around().program, "simulate", "--model", str(folder / "given.json"), "--input",
                str(folder / "small.csv"), "-o", str(folder / str(k) / "o.csv"), "-q",
            ]  # fmt: skip
            environment = {**os.environ, "PSA_CASADI_CACHE": str(folder / "cache")}
            running.append(subprocess.Popen(command, env=environment, stderr=subprocess.PIPE))
        for process in running:
            _, err = process.communicate()
            if process.returncode:
                yield Found(WRONG_EXIT, f"one of {count} on an empty cache: {err.decode()[-200:]}")
        texts = {p.read_bytes() for p in folder.glob("*/o.csv")}
        if len(texts) != 1:
            yield Found(WRONG_EXIT, f"{count} commands on an empty cache give {len(texts)} results")
        left = [p.name for p in (folder / "cache" / "models").iterdir() if p.is_dir()]
        if left:
            yield Found(
                LEFT_OVER, f"{count} on an empty cache leave folders: {', '.join(left[:3])}"
            )
    finally:
        shutil.rmtree(folder, ignore_errors=True)


TARGETS = (
    Target("environments", ROOM, ".json", _case, _surround, 5.0, 2 * _LIMIT_S, None, given_files),
    Target("many-at-once", ROOM, ".json", lambda _: b'{"commands": 20}', _many, 1.0, 2 * _LIMIT_S,
           None, given_files),
)  # fmt: skip
