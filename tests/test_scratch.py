"""What a process makes for itself goes with it, however it ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from psa_casadi import scratch
from psa_casadi.children import run_child
from psa_casadi.files import atomic_write
from psa_casadi.scratch import abandon, sweep, temporary_file, temporary_folder

posix = pytest.mark.skipif(sys.platform == "win32", reason="signals and locks of POSIX")

#: Makes a folder and a half-written file in a place, tells so, and waits to be killed.
HOLDS = """
import pathlib, sys, time
from psa_casadi.scratch import temporary_file, temporary_folder
place = pathlib.Path(sys.argv[1])
with temporary_folder(place) as folder, temporary_file(place, "model.json") as file:
    (folder / "inner").mkdir()
    (folder / "inner" / "a.o").write_text("half")
    file.write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""


def holder(place: Path) -> "subprocess.Popen[str]":
    child = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(place)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    return child


def swept_again(place: Path) -> list[str]:
    scratch._SWEPT.discard(place)
    sweep(place)
    return sorted(os.listdir(place))


@posix
def test_what_a_killed_process_left_goes_and_what_a_live_one_holds_stays(tmp_path: Path) -> None:
    dead, alive = holder(tmp_path), holder(tmp_path)
    (tmp_path / "model.json").write_text("old")
    dead.kill()
    dead.communicate()
    assert len(os.listdir(tmp_path)) == 5
    kept = swept_again(tmp_path)
    assert len(kept) == 3
    assert swept_again(tmp_path) == kept
    alive.kill()
    alive.communicate()
    scratch._SWEPT.discard(tmp_path)
    atomic_write(tmp_path / "other.json", "new")
    assert sorted(os.listdir(tmp_path)) == ["model.json", "other.json"]
    assert (tmp_path / "model.json").read_text() == "old"


@posix
def test_a_process_never_sweeps_its_own(tmp_path: Path) -> None:
    with temporary_folder(tmp_path) as folder, temporary_file(tmp_path, "x.fmu") as file:
        assert folder.stat().st_mode & 0o777 == 0o700
        assert file.suffix == ".fmu"
        assert swept_again(tmp_path) == sorted([folder.name, file.name])
    assert not os.listdir(tmp_path)


def test_a_link_that_looks_like_a_leftover_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / f"{scratch.PREFIX}12345678").symlink_to(tmp_path / "precious")
    assert len(swept_again(tmp_path)) == 2


def test_without_locks_only_what_is_old_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scratch, "_lock", lambda path: None)
    old, new = (tmp_path / f"{scratch.PREFIX}{name}" for name in ("old", "new"))
    old.mkdir()
    new.mkdir()
    week = time.time() - 8 * 86400
    os.utime(old, (week, week))
    assert swept_again(tmp_path) == [new.name]


@posix
def test_a_folder_that_a_sweeper_took_before_it_was_locked_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = scratch._lock
    taken: list[Path] = []

    def slow(path: Path) -> int | None:
        if not taken:
            taken.append(path)
            path.rmdir()
        return lock(path)

    monkeypatch.setattr(scratch, "_lock", slow)
    with temporary_folder(tmp_path) as folder:
        assert folder.is_dir()
        assert folder != taken[0]


@posix
def test_a_child_that_is_not_waited_for_dies_with_its_children(tmp_path: Path) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupted)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(KeyboardInterrupt):
            run_child(
                ["sh", "-c", "sleep 60 & echo $! > pid; wait"],
                directory=tmp_path,
                environment=os.environ,
            )
    finally:
        signal.signal(signal.SIGALRM, before)
    assert ended(int((tmp_path / "pid").read_text()))


#: Reads an HDF5 file by an interpreter that notes its number and never ends.
READS = """
import sys
from psa_casadi.cli.failures import prepare
from psa_casadi.records import read_record
prepare()
sys.executable = sys.argv[1]
read_record(sys.argv[2])
"""


@posix
def test_a_request_to_end_ends_the_python_that_reads_a_file_too(tmp_path: Path) -> None:
    interpreter, note = tmp_path / "python", tmp_path / "pid"
    interpreter.write_text(
        f"#!/bin/sh\nsleep 60 & echo $! > {note}.new; mv {note}.new {note}; wait\n"
    )
    interpreter.chmod(0o755)
    (tmp_path / "f.mat").write_bytes(b"nothing")
    reading = subprocess.Popen(
        [sys.executable, "-c", READS, str(interpreter), str(tmp_path / "f.mat")],
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )
    while reading.poll() is None and not note.exists():
        time.sleep(0.01)
    reading.terminate()
    assert reading.wait(10) == 128 + signal.SIGTERM
    assert ended(int(note.read_text()))
    assert sorted(os.listdir(tmp_path)) == ["f.mat", "pid", "python"]


#: Is told to end when its child runs, and `Popen` has not come back with it yet.
STARTS = """
import os, subprocess, sys
from psa_casadi.children import started
from psa_casadi.scratch import answer_requests_to_end
popen = subprocess.Popen
def told(*given, **options):
    child = popen(*given, **options)
    print(child.pid, flush=True)
    os.kill(os.getpid(), 15)
    return child
subprocess.Popen = told
answer_requests_to_end()
with started(["sleep", "60"]):
    print("goes on")
"""


@posix
def test_a_child_that_is_just_being_started_is_ended_too() -> None:
    done = subprocess.run(
        [sys.executable, "-c", STARTS], stdout=subprocess.PIPE, text=True, check=False
    )
    assert done.returncode == 128 + signal.SIGTERM
    assert ended(int(done.stdout))


#: Is told to end in a block that answers, or after it.
TOLD = """
import os, pathlib, sys
from psa_casadi.scratch import requests_to_end_answered, temporary_folder
with requests_to_end_answered(), temporary_folder(pathlib.Path(sys.argv[1])):
    if sys.argv[2] == "inside":
        os.kill(os.getpid(), 15)
with temporary_folder(pathlib.Path(sys.argv[1])):
    os.kill(os.getpid(), 15)
"""


@posix
@pytest.mark.parametrize(("where", "code", "left"), [("inside", 143, 0), ("after", -15, 1)])
def test_requests_to_end_are_answered_in_the_block_alone(
    where: str, code: int, left: int, tmp_path: Path
) -> None:
    done = subprocess.run([sys.executable, "-c", TOLD, str(tmp_path), where], check=False)
    assert done.returncode == code
    assert len(os.listdir(tmp_path)) == left


def ended(pid: int) -> bool:
    """Whether a process ends within two seconds."""
    for _ in range(200):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        state = Path(f"/proc/{pid}/stat")
        if state.exists() and state.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return True
        time.sleep(0.01)
    return False


def test_to_abandon_removes_everything_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scratch, "_MADE", set())
    with temporary_folder(tmp_path) as folder, temporary_file(tmp_path, "a.csv") as file:
        (folder / "deep" / "deeper").mkdir(parents=True)
        file.write_text("half")
        abandon()
        assert not os.listdir(tmp_path)
    assert not scratch._MADE


@posix
def test_any_command_sweeps_what_a_killed_one_left_in_the_cache(tmp_path: Path) -> None:
    room = tmp_path / "cache" / "models"
    room.mkdir(parents=True)
    dead = holder(room)
    dead.kill()
    dead.communicate()
    assert os.listdir(room)
    subprocess.run(
        [sys.executable, "-m", "psa_casadi.cli", "--version"],
        env={**os.environ, "PSA_CASADI_CACHE": str(tmp_path / "cache")},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    assert os.listdir(room) == []
