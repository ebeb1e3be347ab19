"""Messages on what the machine refuses: the cause and the cure."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.cli.failures import guarded
from psa_casadi.common import cache
from psa_casadi.common.files import PREFIX, atomic_path, atomic_write
from psa_casadi.simulation import compiler
from tests.contract.helpers import refused
from tests.records.record_files import write
from tests.tiers import posix, slow_but

FAULT = "This is a fault of psa_casadi"
#: A locale of ASCII alone, which Python does not replace by UTF-8.
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def shell(line: str, **variables: str) -> "subprocess.CompletedProcess[str]":
    """Run a line of bash in which `psa` is the command."""
    start = f'psa() {{ "{sys.executable}" -m psa_casadi.cli "$@"; }}; set -o pipefail; '
    return subprocess.run(
        ["bash", "-c", start + line], capture_output=True, encoding="utf-8", check=False,
        env={**os.environ, **variables}, timeout=60,
    )  # fmt: skip


def program(path: Path, *lines: str) -> Path:
    """Write a shell script that can be run."""
    write(path, "#!/bin/sh", *lines).chmod(0o700)
    return path


STREAMS = {
    "nobody reads on": ("psa effects | true", 1, ""),
    "output closed": ("psa effects >&-", 0, ""),
    "all streams closed": ("psa --help <&- >&- 2>&-", 0, ""),
    "output on a full disk": ("psa effects >/dev/full", 1, "Failed: the disk is full"),
    "help on a full disk": ("psa --help >/dev/full", 1, "Failed: the disk is full"),
}


@posix
@pytest.mark.parametrize("case", slow_but([c for c in STREAMS if "output" not in c], STREAMS))
def test_output_that_cannot_be_written(case: str) -> None:
    line, code, statement = STREAMS[case]
    done = shell(line)
    assert done.returncode == code, done.stderr
    assert done.stderr.startswith(statement)
    assert len(done.stderr.splitlines()) == bool(statement), done.stderr


@posix
def test_letters_that_the_terminal_lacks_do_not_end_a_command() -> None:
    code = "from psa_casadi.cli.failures import prepare; prepare()"
    done = shell(
        f"""'{sys.executable}' -c '{code}; print("5 \\u00b5m, \\udcff.csv")'""",
        PYTHONIOENCODING="ascii", **ASCII,
    )  # fmt: skip
    assert done.stdout == "5 ?m, ?.csv\n", done.stderr


@posix
@pytest.mark.parametrize("end", ["", "os._exit(0)", "os.kill(os.getpid(), 15)"])
def test_temporary_files_of_other_packages_go_too(end: str, tmp_path: Path) -> None:
    """With the command that made them, or with the next."""
    code = "import os, tempfile; from psa_casadi.cli.failures import prepare; prepare()"
    for last in (end, ""):
        script = f"{code}; print(tempfile.mkdtemp(), os.environ['TMPDIR']); {last}"
        done = shell(f"'{sys.executable}' -uc '{script}'".replace("['", '["').replace("']", '"]'),
                     TMPDIR=str(tmp_path))  # fmt: skip
        assert all(p.startswith(f"{tmp_path}/{PREFIX}") for p in done.stdout.split()), done.stderr
        assert len(done.stdout.split()) == 2
        assert bool(os.listdir(tmp_path)) == ("_exit" in last)


def ended_by(error: BaseException) -> tuple[int, str]:
    """Return the exit code of a command that meets an error, and its message."""

    def command() -> None:
        raise error

    single = typer.Typer(pretty_exceptions_enable=False)
    single.command()(guarded(command))
    result = CliRunner().invoke(single, [])
    return result.exit_code, result.output


REFUSED: dict[str, tuple[BaseException, str]] = {
    "disk full": (OSError(errno.ENOSPC, "x", "/a/b"), "the disk is full (/a/b); free some space"),
    "read only": (OSError(errno.EROFS, "x"), "may only be read; choose a place"),
    "no access": (PermissionError(errno.EACCES, "x", "/a"), "denies access (/a); change"),
    "too many files": (OSError(errno.EMFILE, "x"), "too many files are open; raise"),
    "name too long": (OSError(errno.ENAMETOOLONG, "x"), "name is too long; choose"),
    "memory": (MemoryError(), "too little memory; close"),
    "memory of C++": (RuntimeError("std::bad_alloc"), "too little memory; close"),
    "threads": (RuntimeError("can't start new thread"), "no more threads may be started"),
    "no temporary folder": (
        FileNotFoundError(errno.ENOENT, "No usable temporary directory in ['/tmp']"),
        "set TMPDIR to one",
    ),
    "package missing": (
        ModuleNotFoundError("No module named 'casadi'", name="casadi"),
        "the installation is not complete (No module named 'casadi'); install",
    ),
    "compiler": (
        psa.MachineError("The C compiler x cannot be started."),
        "The C compiler x cannot",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_the_machine_refuses_is_no_fault_of_the_package(case: str) -> None:
    error, statement = REFUSED[case]
    code, output = ended_by(error)
    assert code == 1
    assert output.startswith("Failed: ")
    assert statement in output
    assert "fault" not in output


FAULTS = (KeyError("x"), ValueError("x"), FileNotFoundError(errno.ENOENT, "x"))


@pytest.mark.parametrize("error", [*FAULTS, ImportError("x", name="psa_casadi.common.files")])
def test_a_fault_of_the_package_is_called_one(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PSA_CASADI_DEBUG", raising=False)
    code, output = ended_by(error)
    assert code == 1
    assert f"an unexpected {type(error).__name__} ({error}). {FAULT}" in output
    assert len(output.splitlines()) == 1
    monkeypatch.setenv("PSA_CASADI_DEBUG", "1")
    assert ended_by(error) == (1, "")


@posix
def test_a_working_folder_that_was_removed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    output = refused("simulate", "--stack", "demo", "--input", "v.csv", "-o", "out.csv")
    assert "The folder that this runs in is not there any more; change to another" in output


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PSA_CASADI_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "_REFUSED", set())
    return tmp_path / "cache"


COMPILERS = {
    "nothing-of-this-name": r"The C compiler nothing-of-this-name cannot be started .*unset",
    "/": r"The C compiler / cannot be started \(Permission denied\)",
    "cc '": r"CC is \"cc '\", which is no command",
    "false": r"(?s)C compiler failed \(false .*Set CC",
    "true": r"The C compiler true wrote no library; set CC",
    "sh -c 'kill -9 $$'": r"failed .*killed by signal 9; too little memory",
}


@posix
@pytest.mark.parametrize("command", COMPILERS)
def test_a_compiler_that_does_not_work(
    command: str, empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", command)
    with pytest.raises(psa.MachineError, match=COMPILERS[command]):
        compiler.shared_library({"a.c": "int a;"}, ())
    assert not list(empty_cache.rglob("*.so"))


@posix
def test_a_compiler_may_have_arguments_and_spaces(
    tmp_path: Path, empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = program(tmp_path / "my cc", 'echo "$@" > ../../arguments; exec cc "$@"')
    monkeypatch.setenv("CC", str(script))
    compiler.shared_library({"a.c": "int a;"}, ())
    monkeypatch.setenv("CC", f"'{script}' -D'X=\"a b\"'")
    compiler.shared_library({"a.c": "int a;"}, ())
    assert '-DX="a b" -std' in (empty_cache / "arguments").read_text()


@posix
def test_a_compiler_on_a_full_disk_is_no_broken_one(
    tmp_path: Path, empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = program(tmp_path / "full", "echo 'x: No space left on device' >&2; exit 1")
    monkeypatch.setenv("CC", str(script))
    with pytest.raises(OSError, match="No space left"):
        compiler.shared_library({"a.c": "int a;"}, ())
    assert not list(empty_cache.rglob("*.so"))


def test_files_that_cannot_be_written_are_named(tmp_path: Path) -> None:
    fits, too_long = tmp_path / ("n" * 246 + ".json"), tmp_path / ("n" * 251 + ".json")
    atomic_write(fits, "text")
    assert fits.read_text() == "text"
    atomic_write(tmp_path / ("µ" * 120 + ".json"), "text")
    with pytest.raises(psa.InputError, match="File name too long"):
        atomic_write(too_long, "text")
    assert "File name too long" in refused("export", "fmu", "--stack", "demo", "-o", too_long)


@posix
def test_a_disk_that_fills_up_while_a_file_is_written(tmp_path: Path) -> None:
    with pytest.raises(psa.InputError, match=r"No space left on device.*choose another place"):
        atomic_write("/dev/full", "text")

    def fill() -> None:
        with atomic_path(tmp_path / "x.fmu") as path:
            path.write_text("half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "x.fmu").write_text("old")
    with pytest.raises(psa.InputError, match=r"x\.fmu: cannot write \(No space left"):
        fill()
    assert (tmp_path / "x.fmu").read_text() == "old"
    assert os.listdir(tmp_path) == ["x.fmu"]
