"""Commands in odd surroundings, and many at once.

In each a command works, or ends with a sentence that names the cause.
"""

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from psa_casadi.common.errors import InputError
from tests.studies.fuzz.campaign import LEFT_OVER, WRONG_EXIT, Draw, Finding, Target
from tests.studies.fuzz.commands import (
    LIBC,
    LIMIT_S,
    WORKS,
    Around,
    environment,
    half_written,
    input_files,
    left_files,
    misbehaved,
    place,
    psa,
)

#: Of Linux's prctl: drop a capability, such as root's to write anywhere.
_DROP, _RIGHTS = 24, (1, 2, 3, 24)
#: A cache in its usual place, below the folder of the user.
_USUAL = {
    "PSA_CASADI_CACHE": None, "XDG_CACHE_HOME": None,
    "ZIG_GLOBAL_CACHE_DIR": None, "ZIG_LOCAL_CACHE_DIR": None,
}  # fmt: skip


@dataclass(frozen=True)
class Odd:
    """Unusual surroundings: their set-up, and words of which a failure's message has one.

    Without `words` the command must work. The command runs as a user who may not do everything.
    `place` is made in the command's folder, `variable` names it, and `output` is written there;
    `first` is called with the folder in the process before the command starts; `streams` are
    standard input, output and error by the files that take their place.
    """

    words: tuple[str, ...] = ()
    environment: Mapping[str, str | None] = field(default_factory=dict)
    place: Callable[[Path], object] | None = None
    variable: str = ""
    name: str = "place"
    output: bool = False
    first: Callable[[Path], object] = lambda _: None
    streams: Mapping[str, str] = field(default_factory=dict)

    def around(self, folder: Path) -> Around:
        """Make them for a command in a folder."""
        if self.place is not None:
            self.place(folder / self.name)
        named = {self.variable: str(folder / self.name)} if self.variable else {}
        streams = {n: _opened(path) for n, path in self.streams.items()}
        first = lambda: (self.first(folder), None)[1]  # noqa: E731
        return Around({**self.environment, **named}, first, streams)


def _opened(path: str) -> int:
    """Return the descriptor of a file, or of a pipe that nobody reads."""
    if path != "a broken pipe":
        return os.open(path, os.O_RDWR)
    reads, writes = os.pipe()
    os.close(reads)
    return writes


def _unwritable(path: Path) -> None:
    path.mkdir()
    path.chmod(0o555)


def _file(path: Path) -> None:
    path.write_text("a file")


def _full(path: Path) -> None:
    """Make a file system of 64 KiB, which is small enough to be full soon."""
    path.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=64k,mode=0777", "tmpfs", str(path)]
    if os.geteuid() or subprocess.run(mounted, capture_output=True, check=False).returncode:
        raise InputError("A small file system cannot be mounted here; this is left out.")


def _open(path: Path) -> None:
    path.mkdir()
    path.chmod(0o777)


def _leave(folder: Path) -> None:
    """Start in a folder that is no more."""
    os.chdir(folder / "gone")
    (folder / "gone").rmdir()


def _ignore(_: Path) -> None:
    for which in (signal.SIGPIPE, signal.SIGCHLD, signal.SIGHUP):
        signal.signal(which, signal.SIG_IGN)


def _limited(which: int, value: int, *words: str) -> Odd:
    return Odd(words, first=lambda _: resource.setrlimit(which, (value, value)))


def _compiler(text: str, folder: str = "tools") -> Odd:
    """Let CC name a program by its text."""

    def make(path: Path) -> None:
        path.parent.mkdir()
        path.write_text(text)
        path.chmod(0o755)

    return Odd(_CC, {}, make, "CC", f"{folder}/cc")


_CACHE = ("cache", "psa_casadi_cache", "home", "place")
_TEMPORARY = ("temporary", "tmpdir", "place")
_DISK = ("space", "full", "place", "disk")
_CC = ("cc", "compiler")
_ASCII = {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
_KEPT_IN = "PSA_CASADI_CACHE"

SURROUNDINGS: dict[str, Odd] = {
    "no HOME": Odd(_CACHE, {**_USUAL, "HOME": None}),
    "HOME unwritable": Odd(_CACHE, _USUAL, _unwritable, "HOME"),
    "HOME a file": Odd(_CACHE, _USUAL, _file, "HOME"),
    "HOME empty": Odd(_CACHE, {**_USUAL, "HOME": ""}),
    "HOME missing": Odd((*_CACHE, "/nowhere"), {**_USUAL, "HOME": "/nowhere/at/all"}),
    "HOME relative": Odd(_CACHE, {**_USUAL, "HOME": "home"}),
    "XDG_CACHE_HOME empty": Odd(_CACHE, {**_USUAL, "XDG_CACHE_HOME": "", "HOME": "/no"}),
    "XDG_CACHE_HOME relative": Odd(_CACHE, {**_USUAL, "XDG_CACHE_HOME": "here"}),
    "cache a file": Odd(_CACHE, {}, _file, _KEPT_IN),
    "cache unwritable": Odd(_CACHE, {}, _unwritable, _KEPT_IN),
    "cache in /proc": Odd((*_CACHE, "/proc"), {_KEPT_IN: "/proc/no/such"}),
    "cache a link to nothing": Odd(
        (*_CACHE, "/nowhere"), {}, lambda p: p.symlink_to("/nowhere/x"), _KEPT_IN
    ),
    "cache with spaces and unicode": Odd((), {}, None, _KEPT_IN, "mein käsch ➕ 'x'"),
    "cache on a full disk": Odd((*_CACHE, *_DISK), {}, _full, _KEPT_IN),
    "TMPDIR missing": Odd((*_TEMPORARY, "/nowhere"), {"TMPDIR": "/nowhere/at/all"}),
    "TMPDIR unwritable": Odd(_TEMPORARY, {}, _unwritable, "TMPDIR"),
    "TMPDIR a file": Odd(_TEMPORARY, {}, _file, "TMPDIR"),
    "TMPDIR on a full disk": Odd((*_TEMPORARY, *_DISK), {}, _full, "TMPDIR"),
    "output on a full disk": Odd((*_DISK, "write"), {}, _full, output=True),
    "output folder unwritable": Odd(("write",), {}, _unwritable, output=True),
    "output with spaces and unicode": Odd((), {}, _open, name="o ü ➕", output=True),
    "unicode path without UTF-8": Odd((), {**_ASCII, "LC_ALL": "C"}, _open, "", "ü", True),
    "LC_ALL=C": Odd((), {"LC_ALL": "C", "LANG": None}),
    "POSIX without UTF-8": Odd((), {"LC_ALL": "POSIX", "PYTHONIOENCODING": "ascii", **_ASCII}),
    "unknown locale": Odd((), {"LC_ALL": "xx_YY.nonsense", "LANG": "tlh"}),
    "PYTHONOPTIMIZE=2": Odd((), {"PYTHONOPTIMIZE": "2"}),
    "stdin closed": Odd(first=lambda _: os.close(0)),
    "stdout closed": Odd(("output", "closed", "written", "descriptor"),
                          first=lambda _: os.close(1)),
    "stderr closed": Odd(first=lambda _: os.close(2)),
    "stdout a broken pipe": Odd(("",), streams={"stdout": "a broken pipe"}),
    "stdout on a full disk": Odd((*_DISK, "output"), streams={"stdout": "/dev/full"}),
    "stderr on a full disk": Odd(("",), streams={"stderr": "/dev/full"}),
    "COLUMNS=1": Odd((), {"COLUMNS": "1", "LINES": "1"}),
    "COLUMNS no number": Odd((), {"COLUMNS": "wide", "TERM": "dumb", "NO_COLOR": "1"}),
    "unknown terminal": Odd((), {"TERM": "no-such-terminal", "FORCE_COLOR": "1"}),
    "CC missing": Odd(_CC, {"CC": "/nowhere/cc"}),
    "CC with a space": _compiler(
        f'#!/bin/sh\nexec "{sys.executable}" -m ziglang cc "$@"\n', "my tools"
    ),
    "CC fails": _compiler("#!/bin/sh\nexit 1\n"),
    "CC is no program": _compiler("\0\1\2"),
    "CC does nothing": _compiler("#!/bin/sh\nexit 0\n"),
    "CC with quotes": Odd(_CC, {"CC": "cc '-DX=\"a"}),
    "PATH empty": Odd((), {"PATH": ""}),
    "little memory": _limited(resource.RLIMIT_AS, 700 << 20, "memory"),
    "few open files": _limited(resource.RLIMIT_NOFILE, 16, "open files", "files"),
    "small files only": _limited(
        resource.RLIMIT_FSIZE, 4096, "large", "space", "write", "cache", "compiler"
    ),
    "no new processes": _limited(resource.RLIMIT_NPROC, 1, "process", "resource", "compiler"),
    "directory gone": Odd(("directory", "folder"), {}, _open, name="gone", first=_leave),
    "umask 777": Odd((*_CACHE, *_TEMPORARY, "permission", "write"),
                      first=lambda _: os.umask(0o777)),
    "debugging": Odd((), {"PSA_CASADI_DEBUG": "1"}),
    "SIGPIPE and SIGCHLD ignored": Odd(first=_ignore),
    "odd numbers of threads": Odd(
        (), {"OPENBLAS_NUM_THREADS": "0", "OMP_NUM_THREADS": "x", "MKL_NUM_THREADS": "-1"}
    ),
}  # fmt: skip


#: What is run; the first needs a compiler, a cache and a temporary folder, and so does the second.
_RUNS = ("simulate", "export fmu", "identify", "check")


def _surroundings_case(rng: Draw) -> bytes:
    names = list(SURROUNDINGS)
    turn = rng.turn // len(names) + rng.turn % len(names) * (rng.turn >= len(names))
    run = _RUNS[turn % len(_RUNS)]
    return json.dumps({"surroundings": names[rng.turn % len(names)], "run": run}).encode()


def _surround(data: bytes, where: Path) -> Iterator[Finding]:
    """Run a command in odd surroundings, as a user without rights: it works or names the cause."""
    case = json.loads(data)
    chosen, work = SURROUNDINGS[case["surroundings"]], WORKS[case["run"]]
    with place(where) as folder:
        around = chosen.around(folder)

        def first() -> None:
            for right in () if os.geteuid() else _RIGHTS:
                LIBC.prctl(_DROP, right, 0, 0, 0)
            around.first()

        target = folder / chosen.name if chosen.output else folder
        places = {n: folder / n for n in input_files()} | {n: target / n for n in work.outputs}
        named = [places.get(a, a) for a in work.arguments]  # whole paths: the folder may be gone
        what = f"{case['surroundings']}: psa {case['run']}"
        ended = psa(named, folder, replace(around, first=first))
        for stream in around.streams.values():
            os.close(stream)
        mute = "stderr" in around.streams
        yield from misbehaved(ended, (0, 1, 2) if chosen.words else (0,), what, mute=mute)
        words = (ended.err + ended.out).lower()
        if ended.code in (1, 2) and not any(word in words for word in chosen.words):
            tail = " ".join(ended.err.split())[-200:]
            yield Finding(WRONG_EXIT, f"{what}: the failure does not name its cause: {tail}")
        yield from half_written(target, work, what, may_miss=ended.code != 0)
        yield from left_files(folder, what)


def _many(data: bytes, where: Path) -> Iterator[Finding]:
    """Run many commands at once on one empty cache; all give the same."""
    count = json.loads(data)["commands"]
    with place(where) as folder:
        command = [sys.executable, "-m", "psa_casadi.cli", *WORKS["simulate"].arguments[:-1]]
        running = [
            subprocess.Popen([*command, f"{k}.csv"], env=environment(folder, Around()), cwd=folder,
                             stderr=subprocess.PIPE)
            for k in range(count)
        ]  # fmt: skip
        what = f"{count} commands on an empty cache"
        for process in running:
            _, err = process.communicate()
            if process.returncode:
                yield Finding(WRONG_EXIT, f"{what}: the error of one is {err.decode()[-200:]}")
        if (n := len({(folder / f"{k}.csv").read_bytes() for k in range(count)})) != 1:
            yield Finding(WRONG_EXIT, f"{what} give {n} results")
        if left := [p.name for p in (folder / "cache" / "models").iterdir() if p.is_dir()]:
            yield Finding(LEFT_OVER, f"{what} leave folders: {', '.join(left[:3])}")


TARGETS = (
    Target("environments", "environments", ".json", _surroundings_case, _surround, 5.0,
           2 * LIMIT_S, None, input_files),
    Target("many-at-once", "environments", ".json", lambda _: b'{"commands": 20}', _many, 1.0,
           2 * LIMIT_S, None, input_files),
)  # fmt: skip
