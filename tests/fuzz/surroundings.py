"""Surroundings in which a command must work, or end with a sentence that names the cause."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from psa_casadi.errors import InputError
from tests.fuzz.commands import Around

_NO_OVERRIDE = {
    "PSA_CASADI_CACHE": None, "XDG_CACHE_HOME": None,
    "ZIG_GLOBAL_CACHE_DIR": None, "ZIG_LOCAL_CACHE_DIR": None,
}  # fmt: skip

Prepare = Callable[[Path], Around]


@dataclass(frozen=True)
class Surroundings:
    """How they are made in a folder; words of which a failure must say one, lower case.

    Without `words` the command must work. The command runs as a user who may not do everything.
    """

    prepare: Prepare
    words: tuple[str, ...] = ()
    output: str = ""  # folder of the output, below the one of the command


def _set(**environment: str | None) -> Prepare:
    return lambda _: Around({**_NO_OVERRIDE, **environment})


def _kept(**environment: str | None) -> Prepare:
    """Change the environment, with a cache that works."""
    return lambda folder: Around({"PSA_CASADI_CACHE": str(folder / "cache"), **environment})


def _place(variable: str, make: Callable[[Path], object]) -> Prepare:
    """Let a variable name a path that is made in some way."""

    def prepare(folder: Path) -> Around:
        path = folder / "place"
        make(path)
        cache = (
            {} if variable == "PSA_CASADI_CACHE" else {"PSA_CASADI_CACHE": str(folder / "cache")}
        )
        own = _NO_OVERRIDE if variable == "HOME" else cache
        return Around({**own, variable: str(path)})

    return prepare


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


def _output(make: Callable[[Path], None], name: str, **environment: str) -> Prepare:
    """Make the folder of the output in some way."""

    def prepare(folder: Path) -> Around:
        make(folder / name)
        return _kept(**environment)(folder)

    return prepare


def _limited(*limits: tuple[int, int]) -> Prepare:
    def first() -> None:
        for which, value in limits:
            resource.setrlimit(which, (value, value))

    return lambda folder: replace(_kept()(folder), first=first)


def _closed(stream: int) -> Prepare:
    return lambda folder: replace(_kept()(folder), first=lambda: os.close(stream))


def _written_to(name: str, path: str) -> Prepare:
    def prepare(folder: Path) -> Around:
        return replace(_kept()(folder), streams={name: os.open(path, os.O_RDWR)})

    return prepare


def _broken_pipe(folder: Path) -> Around:
    reads, writes = os.pipe()
    os.close(reads)
    return replace(_kept()(folder), streams={"stdout": writes})


def _gone(folder: Path) -> Around:
    """Start in a folder that is no more; files are named by their whole paths."""
    gone = folder / "gone"
    gone.mkdir(mode=0o777)
    gone.chmod(0o777)

    def first() -> None:
        os.chdir(gone)
        gone.rmdir()

    return replace(_kept()(folder), first=first)


def _compiler(text: str, where: str = "tools") -> Prepare:
    """Let CC name a program by its text."""

    def prepare(folder: Path) -> Around:
        path = folder / where / "cc"
        path.parent.mkdir()
        path.write_text(text)
        path.chmod(0o755)
        return _kept(CC=str(path))(folder)

    return prepare


_CACHE = ("cache", "psa_casadi_cache", "home", "place")
_TEMPORARY = ("temporary", "tmpdir", "place")
_DISK = ("space", "full", "place", "disk")


def _ignore() -> None:
    for which in (signal.SIGPIPE, signal.SIGCHLD, signal.SIGHUP):
        signal.signal(which, signal.SIG_IGN)


SURROUNDINGS: dict[str, Surroundings] = {
    "no HOME": Surroundings(_set(HOME=None), _CACHE),
    "HOME unwritable": Surroundings(_place("HOME", _unwritable), _CACHE),
    "HOME a file": Surroundings(_place("HOME", _file), _CACHE),
    "HOME empty": Surroundings(_set(HOME=""), _CACHE),
    "HOME missing": Surroundings(_set(HOME="/nowhere/at/all"), (*_CACHE, "/nowhere")),
    "HOME relative": Surroundings(_set(HOME="home"), _CACHE),
    "XDG_CACHE_HOME empty": Surroundings(_set(XDG_CACHE_HOME="", HOME="/nowhere"), _CACHE),
    "XDG_CACHE_HOME relative": Surroundings(_set(XDG_CACHE_HOME="here"), _CACHE),
    "cache a file": Surroundings(_place("PSA_CASADI_CACHE", _file), _CACHE),
    "cache unwritable": Surroundings(_place("PSA_CASADI_CACHE", _unwritable), _CACHE),
    "cache in /proc": Surroundings(_set(PSA_CASADI_CACHE="/proc/no/such"), (*_CACHE, "/proc")),
    "cache a link to nothing": Surroundings(
        _place("PSA_CASADI_CACHE", lambda p: p.symlink_to("/nowhere/x")), (*_CACHE, "/nowhere")
    ),
    "cache with spaces and unicode": Surroundings(
        lambda f: Around({"PSA_CASADI_CACHE": str(f / "mein käsch ➕ 'x'")})
    ),
    "cache on a full disk": Surroundings(_place("PSA_CASADI_CACHE", _full), (*_CACHE, *_DISK)),
    "TMPDIR missing": Surroundings(_kept(TMPDIR="/nowhere/at/all"), (*_TEMPORARY, "/nowhere")),
    "TMPDIR unwritable": Surroundings(_place("TMPDIR", _unwritable), _TEMPORARY),
    "TMPDIR a file": Surroundings(_place("TMPDIR", _file), _TEMPORARY),
    "TMPDIR on a full disk": Surroundings(_place("TMPDIR", _full), (*_TEMPORARY, *_DISK)),
    "output on a full disk": Surroundings(_output(_full, "place"), (*_DISK, "write"), "place"),
    "output folder unwritable": Surroundings(_output(_unwritable, "place"), ("write",), "place"),
    "output with spaces and unicode": Surroundings(_output(_open, "o ü ➕"), (), "o ü ➕"),
    "LC_ALL=C": Surroundings(_kept(LC_ALL="C", LANG=None)),
    "LC_ALL=POSIX without UTF-8": Surroundings(
        _kept(LC_ALL="POSIX", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", PYTHONIOENCODING="ascii")
    ),
    "unknown locale": Surroundings(_kept(LC_ALL="xx_YY.nonsense", LANG="tlh")),
    "unicode path without UTF-8": Surroundings(
        _output(_open, "ü", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", LC_ALL="C"), (), "ü"
    ),
    "PYTHONOPTIMIZE=2": Surroundings(_kept(PYTHONOPTIMIZE="2")),
    "stdin closed": Surroundings(_closed(0)),
    "stdout closed": Surroundings(_closed(1), ("output", "closed", "written", "descriptor")),
    "stderr closed": Surroundings(_closed(2)),
    "stdout a broken pipe": Surroundings(_broken_pipe, ("",)),
    "stdout on a full disk": Surroundings(_written_to("stdout", "/dev/full"), (*_DISK, "output")),
    "stderr on a full disk": Surroundings(_written_to("stderr", "/dev/full"), ("",)),
    "COLUMNS=1": Surroundings(_kept(COLUMNS="1", LINES="1")),
    "COLUMNS no number": Surroundings(_kept(COLUMNS="wide", TERM="dumb", NO_COLOR="1")),
    "unknown terminal": Surroundings(_kept(TERM="no-such-terminal", FORCE_COLOR="1")),
    "CC missing": Surroundings(_kept(CC="/nowhere/cc"), ("cc", "compiler")),
    "CC with a space": Surroundings(
        _compiler(f'#!/bin/sh\nexec "{sys.executable}" -m ziglang cc "$@"\n', "my tools"),
        ("cc", "compiler"),
    ),
    "CC fails": Surroundings(_compiler("#!/bin/sh\nexit 1\n"), ("cc", "compiler")),
    "CC is no program": Surroundings(_compiler("\0\1\2"), ("cc", "compiler")),
    "CC does nothing": Surroundings(_compiler("#!/bin/sh\nexit 0\n"), ("cc", "compiler")),
    "CC with quotes": Surroundings(_kept(CC="cc '-DX=\"a"), ("cc", "compiler")),
    "PATH empty": Surroundings(_kept(PATH="")),
    "little memory": Surroundings(_limited((resource.RLIMIT_AS, 700 << 20)), ("memory",)),
    "few open files": Surroundings(_limited((resource.RLIMIT_NOFILE, 16)), ("open files", "files")),
    "small files only": Surroundings(
        _limited((resource.RLIMIT_FSIZE, 4096)), ("large", "space", "write", "cache", "compiler")
    ),
    "no new processes": Surroundings(
        _limited((resource.RLIMIT_NPROC, 1)), ("process", "resource", "compiler")
    ),
    "directory gone": Surroundings(_gone, ("directory", "folder")),
    "umask 777": Surroundings(
        lambda f: replace(_kept()(f), first=lambda: (os.umask(0o777), None)[1]),
        (*_CACHE, *_TEMPORARY, "permission", "write"),
    ),
    "debugging": Surroundings(_kept(PSA_CASADI_DEBUG="1")),
    "SIGPIPE and SIGCHLD ignored": Surroundings(
        lambda f: replace(_kept()(f), first=_ignore)
    ),
    "odd numbers of threads": Surroundings(
        _kept(OPENBLAS_NUM_THREADS="0", OMP_NUM_THREADS="x", MKL_NUM_THREADS="-1")
    ),
}  # fmt: skip
