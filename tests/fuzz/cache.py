"""The cache of compiled libraries, damaged: the next command heals it and gives the same result."""

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from tests.fuzz.commands import Around, Ended, left_files, misbehaved, psa
from tests.fuzz.kills import WORKS, given
from tests.fuzz.target import FALSE_PASS, Draw, Found, Target

ROOM = "cache"
_LIMIT_S = 300.0
#: What is run, its output, and the folder of the cache that it uses.
_RUNS = {"simulate": ("o.csv", "models"), "export fmu": ("x.fmu", "binaries")}


def _changed(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        path.write_bytes(change(path.read_bytes()))

    return damage


def _flipped(place: float) -> Callable[[bytes], bytes]:
    def flip(data: bytes) -> bytes:
        at = int(place * (len(data) - 1))
        return data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]

    return flip


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()
    (path / "inside").write_text("x")


def _linked(target: str) -> Callable[[Path], None]:
    def link(path: Path) -> None:
        path.unlink()
        path.symlink_to(target)

    return link


def _other(path: Path) -> None:
    """Put a library of another kind in its place: it loads, but has none of the functions."""
    import math  # noqa: PLC0415 - for the place of its file

    shutil.copyfile(str(getattr(math, "__file__", shutil.which("true"))), path)


def _mode(bits: int) -> Callable[[Path], None]:
    return lambda path: path.chmod(bits)


def _whole_file(path: Path) -> None:
    """Put a file where the folder of the libraries is."""
    shutil.rmtree(path.parent)
    path.parent.write_text("x")


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


WAYS: dict[str, Callable[[Path], None]] = {
    "empty": _changed(lambda _: b""),
    "one byte": _changed(lambda data: data[:1]),
    "header only": _changed(lambda data: data[:64]),
    "half": _changed(lambda data: data[: len(data) // 2]),
    "nine tenths": _changed(lambda data: data[: 9 * len(data) // 10]),
    "last byte gone": _changed(lambda data: data[:-1]),
    "zeros": _changed(lambda data: bytes(len(data))),
    "zeros at the end": _changed(lambda data: data[: len(data) // 2] + bytes(len(data) // 2)),
    "text": _changed(lambda _: b"this is no library\n"),
    "bit in the header": _changed(_flipped(0.0005)),
    "bit in the first third": _changed(_flipped(0.3)),
    "bit in the middle": _changed(_flipped(0.5)),
    "bit in the last third": _changed(_flipped(0.75)),
    "more bytes": _changed(lambda data: data + bytes(4096)),
    "folder": _folder,
    "link to nothing": _linked("nowhere"),
    "link to itself": _linked("."),
    "link to a device": _linked("/dev/null"),
    "other library": _other,
    "not readable": _mode(0o000),
    "not executable": _mode(0o444),
    "folder is a file": _whole_file,
    "pipe": _pipe,
    "gone": Path.unlink,
}


@cache
def _sound(command: str) -> tuple[bytes, dict[str, bytes]]:
    """Return the output of a command, and the libraries that it leaves in an empty cache."""
    output, kept = _RUNS[command]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        given(folder)
        ended = _run(command, folder)
        if ended.code:
            raise RuntimeError(f"no output to compare with: {ended.err}")
        libraries = [p for p in (folder / "cache" / kept).iterdir() if p.is_file()]
        return (folder / output).read_bytes(), {p.name: p.read_bytes() for p in libraries}


def _run(command: str, folder: Path) -> Ended:
    around = Around({"PSA_CASADI_CACHE": str(folder / "cache")})
    return psa(WORKS[command].arguments, folder, around, limit_s=_LIMIT_S)


def _case(rng: Draw) -> bytes:
    names = list(WAYS)
    runs = list(_RUNS)
    turn = rng.turn // len(names)
    return json.dumps({"way": names[rng.turn % len(names)], "run": runs[turn % len(runs)]}).encode()


def _damage(data: bytes, where: Path) -> Iterator[Found]:
    case = json.loads(data)
    folder = Path(tempfile.mkdtemp(dir=where))
    output, kept = _RUNS[case["run"]]
    expected, libraries = _sound(case["run"])
    try:
        given(folder)
        (folder / "cache" / kept).mkdir(parents=True)
        for name, content in libraries.items():
            path = folder / "cache" / kept / name
            path.write_bytes(content)
            path.chmod(0o755)
        largest = max(libraries, key=lambda name: len(libraries[name]))  # beside it: checksums
        WAYS[case["way"]](folder / "cache" / kept / largest)
        what = f"psa {case['run']} with a library in the cache: {case['way']}"
        for turn in ("at first", "again"):
            yield from _same(
                _run(case["run"], folder), folder / output, expected, f"{what}, {turn}"
            )
        yield from left_files(folder, what)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _same(ended: Ended, output: Path, expected: bytes, what: str) -> Iterator[Found]:
    found = list(misbehaved(ended, (0,), what))
    yield from found
    if not found and output.read_bytes() != expected:
        yield Found(FALSE_PASS, f"{what}: the output differs")
    output.unlink(missing_ok=True)


TARGETS = (
    Target("cache", ROOM, ".json", _case, _damage, 1.0, 4 * _LIMIT_S, None,
           lambda: [_sound(command) for command in _RUNS]),
)  # fmt: skip
