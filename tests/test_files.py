"""Files are written whole, and what a process makes for itself goes with it, however it ends."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from psa_casadi.common import files
from psa_casadi.common.children import run_child
from psa_casadi.common.errors import InputError, Problems, PsaError
from psa_casadi.common.files import (
    atomic_path,
    atomic_write,
    sweep,
    temporary_file,
    temporary_folder,
)
from tests.contract.helpers import PSA
from tests.tiers import posix


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "model.json"
    target.write_text("old")

    def write_half() -> None:
        with atomic_path(target) as path:
            path.write_text("half")
            raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        write_half()
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["model.json"]


def test_mode_of_an_old_file_and_the_target_of_a_link_are_kept(tmp_path: Path) -> None:
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    atomic_write(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_a_new_file_is_readable_by_the_umask(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    atomic_write(tmp_path / "ours", "")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


@posix
def test_a_umask_that_lets_nobody_read_leaves_no_folder(tmp_path: Path) -> None:
    before = os.umask(0o777)
    try:
        with temporary_folder(tmp_path) as folder:
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
            (folder / "x").touch()
    finally:
        os.umask(before)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/null").is_char_device(), reason="this system has no /dev/null")
def test_a_device_is_written_to_and_stays_a_device() -> None:
    atomic_write("/dev/null", "text")
    assert Path("/dev/null").is_char_device()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"is a directory; name a file in it\.$"):
        atomic_write(tmp_path, "")
    with pytest.raises(InputError, match=r"no/such.* does not exist; create it first\.$"):
        atomic_write(tmp_path / "no" / "such" / "file", "")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot write"):
        atomic_write(tmp_path / "file" / "below", "")


def test_an_input_error_states_one_problem_on_each_line() -> None:
    error = InputError(["first.", "second."])
    assert {PsaError, ValueError} < {*type(error).__mro__}
    assert error.problems == ("first.", "second.")
    assert str(error) == "first.\nsecond."
    assert InputError("only one.").problems == ("only one.",)


def test_problems_beyond_the_limit_are_counted() -> None:
    problems = Problems(limit=2)
    problems.raise_if_any()
    for k in range(5):
        problems.add(f"mistake {k}.")
    problems.add_uncounted(10)
    with pytest.raises(InputError) as caught:
        problems.raise_if_any()
    assert caught.value.problems == ("mistake 0.", "mistake 1.", "... and 13 more")


#: Makes a folder and a half-written file in a place, prints "ready", and waits to be killed.
HOLDS = """
import pathlib, sys, time
from psa_casadi.common.files import temporary_file, temporary_folder
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


def kill(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.communicate()


def swept_again(place: Path) -> list[str]:
    files._SWEPT.discard(place)
    sweep(place)
    return sorted(os.listdir(place))


@posix
def test_what_a_killed_process_left_goes_and_what_a_live_one_holds_stays(tmp_path: Path) -> None:
    dead, alive = holder(tmp_path), holder(tmp_path)
    (tmp_path / "model.json").write_text("old")
    kill(dead)
    assert len(os.listdir(tmp_path)) == 5
    kept = swept_again(tmp_path)
    assert len(kept) == 3
    assert swept_again(tmp_path) == kept
    kill(alive)
    files._SWEPT.discard(tmp_path)
    atomic_write(tmp_path / "other.json", "new")
    assert sorted(os.listdir(tmp_path)) == ["model.json", "other.json"]
    assert (tmp_path / "model.json").read_text() == "old"


@posix
def test_a_process_never_sweeps_its_files(tmp_path: Path) -> None:
    with temporary_folder(tmp_path) as folder, temporary_file(tmp_path, "x.fmu") as file:
        assert folder.stat().st_mode & 0o777 == 0o700
        assert file.suffix == ".fmu"
        assert swept_again(tmp_path) == sorted([folder.name, file.name])
    assert not os.listdir(tmp_path)


def test_without_locks_only_what_is_old_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_lock", lambda path: None)
    old, new = (tmp_path / f"{files.PREFIX}{name}" for name in ("old", "new"))
    old.mkdir()
    new.mkdir()
    week = time.time() - 8 * 86400
    os.utime(old, (week, week))
    assert swept_again(tmp_path) == [new.name]


@posix
def test_a_folder_that_a_sweeper_took_before_it_was_locked_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = files._lock
    taken: list[Path] = []

    def slow(path: Path) -> int | None:
        if not taken:
            taken.append(path)
            path.rmdir()
        return lock(path)

    monkeypatch.setattr(files, "_lock", slow)
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
        work = ["sh", "-c", "sleep 60 & echo $! > pid; wait"]
        with pytest.raises(KeyboardInterrupt):
            run_child(work, directory=tmp_path, environment=os.environ)
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
    work = f"sleep 60 & echo $! > {note}.new; mv {note}.new {note}; wait"
    interpreter.write_text(f"#!/bin/sh\n{work}\n")
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


#: Gets SIGTERM when its child runs, and `Popen` has not returned yet.
STARTS = """
import os, subprocess, sys
from psa_casadi.common.children import started
from psa_casadi.common.files import answer_requests_to_end
popen = subprocess.Popen
def ended_at_once(*arguments, **options):
    child = popen(*arguments, **options)
    print(child.pid, flush=True)
    os.kill(os.getpid(), 15)
    return child
subprocess.Popen = ended_at_once
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


#: Gets SIGTERM in a block that answers, or after it.
TERMINATED = """
import os, pathlib, sys
from psa_casadi.common.files import requests_to_end_answered, temporary_folder
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
    done = subprocess.run([sys.executable, "-c", TERMINATED, str(tmp_path), where], check=False)
    assert done.returncode == code
    assert len(os.listdir(tmp_path)) == left


def runs(pid: int) -> bool:
    """Whether a process runs; a zombie does not count."""
    state = Path(f"/proc/{pid}/stat")
    try:
        os.kill(pid, 0)
        return not (state.exists() and state.read_text().rsplit(")", 1)[1].split()[0] == "Z")
    except (ProcessLookupError, FileNotFoundError):
        return False


def ended(pid: int) -> bool:
    """Whether a process ends within two seconds."""
    for _ in range(200):
        if not runs(pid):
            return True
        time.sleep(0.01)
    return False


@posix
def test_any_command_sweeps_what_a_killed_one_left_in_the_cache(tmp_path: Path) -> None:
    room = tmp_path / "cache" / "models"
    room.mkdir(parents=True)
    kill(holder(room))
    assert os.listdir(room)
    cache = {**os.environ, "PSA_CASADI_CACHE": str(tmp_path / "cache")}
    subprocess.run([*PSA, "--version"], env=cache, check=True, stdout=subprocess.DEVNULL)
    assert os.listdir(room) == []
