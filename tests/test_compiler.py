"""Which C compiler is used, and what is said where there is none."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from psa_casadi.errors import InputError, MachineError
from psa_casadi.export.fmu.platforms import PLATFORMS, chosen_platforms, compile_library
from psa_casadi.export.fmu.platforms import host_platform as host
from psa_casadi.simulation import compiler

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
    commands: list[Sequence[str]] = []
    run_it = compiler.run_compiler

    def told(command: Sequence[str], directory: Path) -> None:
        commands.append(command)
        run_it(command, directory)

    monkeypatch.setattr(compiler, "run_compiler", told)
    monkeypatch.setenv("PSA_CASADI_CACHE", str(tmp_path / "cache"))
    made = []
    for flags in ("", "-O0 '-DWORDS=a b'"):
        monkeypatch.setenv("PSA_CASADI_CFLAGS", flags)
        made.append(compiler.shared_library({"a.c": "int a;"}, (), ("-O1",)))
    assert made[0] != made[1]
    at = commands[1].index("-O1")
    assert commands[1][at + 1 : at + 3] == ["-O0", "-DWORDS=a b"]
    assert "-O0" not in commands[0]
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
def test_without_zig_the_host_is_compiled_by_its_own_compiler(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    commands = []

    def compiled(command: list[str], directory: Path) -> None:
        commands.append(command)
        (directory / command[-1]).write_bytes(b"binary")

    monkeypatch.setenv("CC", "own-cc")
    monkeypatch.setattr("psa_casadi.export.fmu.platforms.run_compiler", compiled)
    assert compile_library({"model.c": "int a;"}, "psa", host()) == b"binary"
    assert commands[0][0] == "own-cc"
    assert "-target" not in commands[0]
