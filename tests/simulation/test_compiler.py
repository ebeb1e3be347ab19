"""Which C compiler is used, the message without one, and the cache of its results."""

import ctypes
import errno
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import pytest

from psa_casadi.common import cache, files
from psa_casadi.common.errors import InputError, MachineError
from psa_casadi.common.files import replace_durably
from psa_casadi.export.fmu.platforms import PLATFORMS, chosen_platforms, compile_library
from psa_casadi.export.fmu.platforms import host_platform as host
from psa_casadi.model.components import BASE
from psa_casadi.model.compose import compose
from psa_casadi.simulation import compiler
from psa_casadi.simulation.compiler import generate_c
from psa_casadi.simulation.stepper import SOURCES

ZIG = [sys.executable, "-m", "ziglang", "cc"]


@pytest.fixture
def no_zig(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ziglang", None)


def _machine(
    monkeypatch: pytest.MonkeyPatch, *, system: str = "Linux", cc: str | None = None
) -> None:
    """Make this machine one of a system that has a `cc` or has none."""
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("platform.system", lambda: system)
    monkeypatch.setattr("shutil.which", lambda _: cc)


def test_the_systems_compiler_comes_before_zig(monkeypatch: pytest.MonkeyPatch) -> None:
    _machine(monkeypatch, cc="/usr/bin/cc")
    assert compiler.compiler_command() == ["/usr/bin/cc"]
    _machine(monkeypatch)
    assert compiler.compiler_command() == ZIG
    monkeypatch.setenv("CC", "clang -m64")
    assert compiler.compiler_command() == ["clang", "-m64"]


def test_flags_of_the_environment_come_last(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    recorder = Mock(wraps=compiler.run_compiler)
    monkeypatch.setattr(compiler, "run_compiler", recorder)
    monkeypatch.setenv("PSA_CASADI_CACHE", str(tmp_path / "cache"))
    made = []
    for flags in ("", "-O0 '-DWORDS=a b'"):
        monkeypatch.setenv("PSA_CASADI_CFLAGS", flags)
        made.append(compiler.shared_library({"a.c": "int a;"}, (), ("-O1",)))
    assert made[0] != made[1]
    plain, extended = (call.args[0] for call in recorder.call_args_list)
    at = extended.index("-O1")
    assert extended[at + 1 : at + 3] == ["-O0", "-DWORDS=a b"]
    assert "-O0" not in plain
    monkeypatch.setenv("PSA_CASADI_CFLAGS", "'-O0")
    with pytest.raises(MachineError, match=r"PSA_CASADI_CFLAGS is .*no row of flags.*-Og"):
        compiler.shared_library({"a.c": "int a;"}, ())


@pytest.mark.parametrize("installed", [True, False])
def test_a_mac_without_developer_tools_uses_zig(
    installed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its `cc` only opens a window that offers to install them."""
    compiler._only_asks_for_tools.cache_clear()
    _machine(monkeypatch, system="Darwin", cc="/usr/bin/cc")
    answer = subprocess.CompletedProcess[str](["xcode-select"], 0 if installed else 2)
    monkeypatch.setattr("subprocess.run", lambda *_, **__: answer)
    assert compiler.compiler_command() == (["/usr/bin/cc"] if installed else ZIG)
    compiler._only_asks_for_tools.cache_clear()


@pytest.mark.usefixtures("no_zig")
def test_without_any_compiler_both_ways_out_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    _machine(monkeypatch)
    with pytest.raises(MachineError, match=r"psa-casadi\[compiler\].*apt install.*CC") as caught:
        compiler.compiler_command()
    assert "xcode-select" in str(caught.value)


@pytest.mark.usefixtures("no_zig")
def test_binaries_for_other_platforms_need_the_extra() -> None:
    assert [p.name for p in chosen_platforms(["host"])] == [host().name]
    other = next(n for n in PLATFORMS if n != host().name)
    for names in ([other], ["all"], ["host", other]):
        with pytest.raises(InputError, match=rf"{other}.*psa-casadi\[compiler\]"):
            chosen_platforms(names)
    with pytest.raises(InputError, match="systems like this one"):
        chosen_platforms([host().name])  # by its name: for old systems too


@pytest.mark.usefixtures("no_zig")
def test_without_zig_the_host_compiler_is_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    commands = []

    def compiled(command: list[str], directory: Path) -> None:
        commands.append(command)
        (directory / command[-1]).write_bytes(b"binary")

    monkeypatch.setenv("CC", "user-cc")
    monkeypatch.setattr("psa_casadi.export.fmu.platforms.run_compiler", compiled)
    assert compile_library({"model.c": "int a;"}, "psa", host()) == b"binary"
    assert commands[0][0] == "user-cc"
    assert "-target" not in commands[0]


EXPORTED = '__attribute__((visibility("default")))'
posix = pytest.mark.skipif(sys.platform == "win32", reason="owners and permissions of POSIX")


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders that the compiler was run in; the caches, kept and private, are new."""
    made: list[Path] = []
    run_it = compiler.run_compiler

    def counted(command: list[str], directory: Path) -> None:
        made.append(directory)
        run_it(command, directory)

    monkeypatch.setenv("PSA_CASADI_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(compiler, "run_compiler", counted)
    monkeypatch.setattr(cache, "_REFUSED", set())
    monkeypatch.setattr(cache, "_private", lambda: tmp_path / "private")
    (tmp_path / "private").mkdir(mode=0o700)
    return made


def library(number: int = 42) -> Path:
    """Return a library with a function f() that returns the number."""
    text = f"{EXPORTED} double f(void) {{ return {number}; }}"
    return compiler.shared_library({"a.c": text}, ())


def value(path: Path) -> float:
    loaded = ctypes.CDLL(str(path))
    loaded.f.restype = ctypes.c_double
    return float(loaded.f())


def checksum(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def rewrite(path: Path, content: bytes) -> None:
    """Write another file of the name; the loaded library stays in this process."""
    path.unlink()
    path.write_bytes(content)
    path.chmod(0o700)


def flipped(content: bytes) -> bytes:
    """Return content with a bit in the middle changed."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


def replaced_by(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        path.unlink()
        make(path)

    return damage


def full_folder(path: Path) -> None:
    path.mkdir()
    (path / "inside").write_text("text")


def other_library(path: Path) -> None:
    """With its checksum, as if the files had been renamed."""
    other = library(7)
    rewrite(path, other.read_bytes())
    rewrite(checksum(path), checksum(other).read_bytes())


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda p: rewrite(p, b""),
    "the header only": lambda p: rewrite(p, p.read_bytes()[:64]),
    "a bit in the middle": lambda p: rewrite(p, flipped(p.read_bytes())),
    "text": lambda p: rewrite(p, b"not a library\n"),
    "another library": other_library,
    "gone": lambda p: p.unlink(),
    "a folder with a file": replaced_by(full_folder),
    "a link to another library": replaced_by(lambda p: p.symlink_to(library(7))),
    "a link to nothing": replaced_by(lambda p: p.symlink_to("nowhere")),
    "a link to itself": replaced_by(lambda p: p.symlink_to(p.name)),
    "a pipe": replaced_by(os.mkfifo),
    "others may write": lambda p: p.chmod(0o666),
    "no checksum": lambda p: checksum(p).unlink(),
    "binary checksum": lambda p: rewrite(checksum(p), b"\xff\0" * 32),
}


@posix
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_library_is_made_again(damage: str, calls: list[Path]) -> None:
    path = library()
    DAMAGES[damage](path)
    calls.clear()
    assert library() == path
    assert len(calls) == 1
    assert value(path) == 42
    library()
    assert len(calls) <= 1
    assert sorted(p.name for p in path.parent.iterdir() if p.name.startswith(path.name)) == [
        path.name,
        checksum(path).name,
    ]
    assert path.parent.stat().st_mode & 0o777 == 0o700


def test_threads_that_want_one_model_compile_it_once(calls: list[Path]) -> None:
    both, text = threading.Barrier(2), generate_c(compose(BASE).structure, sensitivities=True)

    def wanted(_: int) -> Path:
        both.wait()
        return compiler.shared_library(text, SOURCES)

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(wanted, range(2))
    assert first == second
    assert len(calls) == 1


@posix
def test_what_killed_runs_left_in_the_cache_goes(calls: list[Path]) -> None:
    room = cache.cache_directory() / "models"
    (room / f"{files.PREFIX}0123abcd").mkdir(parents=True)
    (room / f"{files.PREFIX}0123abcd" / "model.c").write_text("half")
    (room / f"{files.PREFIX}89abcdef-x.so").write_text("half")
    room.chmod(0o700)
    path = library()
    assert sorted(room.iterdir()) == sorted([path, checksum(path)])
    assert len(calls) == 1


def _file(place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text("")


def _shared(place: Path) -> None:
    place.mkdir(parents=True)
    place.chmod(0o777)


def _stranger(place: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    place.mkdir(parents=True)
    os.chown(place, 12345, -1)


def _dangling(place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to("nowhere/at/all")


UNUSABLE: dict[str, tuple[Callable[[Path], object], str]] = {
    "a file": (_file, "File exists|Not a directory"),
    "others may write": (_shared, "others may write"),
    "of another user": (_stranger, "another user"),
    "a dangling link": (_dangling, "No such file|File exists"),
}


@posix
@pytest.mark.parametrize("level", ["cache", "models"])
@pytest.mark.parametrize("case", UNUSABLE)
def test_a_cache_that_cannot_be_trusted_is_left_alone(
    case: str, level: str, tmp_path: Path, calls: list[Path], caplog: pytest.LogCaptureFixture
) -> None:
    if (case, level) == ("a dangling link", "cache"):
        pytest.skip("the folder that the link names is made")
    wanted = tmp_path / "cache"
    make, reasons = UNUSABLE[case]
    make(wanted if level == "cache" else wanted / "models")
    with caplog.at_level(logging.WARNING, "psa_casadi"):
        first, second = library(), library(7)
        assert library() == first
    assert [value(first), value(second)] == [42, 7]
    assert len(calls) == 2
    assert first.is_relative_to(tmp_path / "private")
    assert len(caplog.records) == 1, caplog.text
    assert caplog.records[0].getMessage().startswith("The cache folder ")
    assert any(word in caplog.text for word in reasons.split("|")), caplog.text


@posix
def test_a_library_of_another_user_is_not_loaded(calls: list[Path]) -> None:
    path = library()
    _ = os.geteuid() == 0 or pytest.skip("only root can give a file away")
    for file in (path, checksum(path)):
        os.chown(file, 12345, -1)
        calls.clear()
        assert library() == path
        assert len(calls) == 1
        assert {path.stat().st_uid, checksum(path).stat().st_uid} == {0}


@posix
def test_a_shared_place_with_separate_copies_is_used(tmp_path: Path, calls: list[Path]) -> None:
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(0o1777)  # as /tmp is
    assert library().is_relative_to(tmp_path / "cache")
    assert len(calls) == 1


@posix
def test_a_full_disk_is_tried_once(
    tmp_path: Path, calls: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(source: Path, target: Path) -> None:
        if target.is_relative_to(tmp_path / "cache"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace_durably(source, target)

    monkeypatch.setattr("psa_casadi.common.cache.replace_durably", full)
    assert [value(library(n)) for n in (1, 2, 3)] == [1, 2, 3]
    assert len(calls) == 4
    assert not list((tmp_path / "cache" / "models").iterdir())


def test_a_folder_that_lets_no_program_run_is_an_error(
    tmp_path: Path, calls: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    load, noexec = ctypes.CDLL, [tmp_path / "cache"]

    def refused(name: str) -> ctypes.CDLL:
        if any(Path(name).is_relative_to(folder) for folder in noexec):
            raise OSError(f"{name}: failed to map segment from shared object")
        return load(name)

    monkeypatch.setattr("ctypes.CDLL", refused)
    assert library().is_relative_to(tmp_path / "private")
    assert len(calls) == 2
    noexec.append(tmp_path)
    with pytest.raises(MachineError, match=r"cannot be loaded .*noexec.*set PSA_CASADI_CACHE"):
        library()


@pytest.mark.skipif(sys.platform != "linux", reason="the rules of the desktop's specification")
@pytest.mark.parametrize("variable", ["", "relative/path", "."])
def test_an_empty_or_relative_cache_variable_counts_as_unset(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PSA_CASADI_CACHE", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", variable)
    assert cache.cache_directory() == tmp_path / ".cache" / "psa_casadi"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_directory() == tmp_path / "xdg" / "psa_casadi"


def test_a_user_without_a_home_has_a_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("PSA_CASADI_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert cache.writable_room("zig").is_dir()
